"""What DLS reads from its data and settings: the noise, the initial dictionary; and what it refuses."""

import inspect

import pytest
import torch
from torch import nn

from tests.helpers import MASKS, assert_unchanged, random_field, seeded
from tests.integrators.dls.test_dls import SMALL, H, W, field
from torchdls import (
    DLS,
    KSVD,
    SURFACES,
    DinoKat,
    Exact,
    FixedDictionary,
    GradientOperator,
    Implicit,
    LeastSquares,
    LineIntegral,
    Proximal,
    SoupDIL,
    TotalVariation,
    Unitary,
    add_noise,
    dct_dictionary,
    edge_slopes,
    noise_level,
    rmse,
)
from torchdls.integrators.dls.iteration import iterate, objective, start, update_height


def test_noise_is_that_of_the_surface_on_oblong_pixels():
    """With dx far from dy the curl of a surface vanishes only if the spacings count."""
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    phase = x * 0.5 / 6 + y * 2.0 / 6
    g = torch.stack([torch.cos(phase), torch.cos(phase)])[None] + 0.05 * random_field(1, 2, 40, 40, dtype=torch.float32)
    noise = DLS(n_iter=0, pixel_size=(0.5, 2.0)).solve(g).noise
    torch.testing.assert_close(noise, noise_level(g, pixel_size=(0.5, 2.0)))
    assert abs(float(noise) - 0.05) < 0.01


def test_noise_knows_the_weights():
    """Samples of weight 0 are no evidence, and a common factor of all weights is none either."""
    g = field(1, h=40, w=40)
    weight = torch.ones(1, 1, 40, 40, dtype=g.dtype)
    weight[..., 10:14, 10:30] = 0
    spoilt = torch.where(weight == 0, 1e3, g)
    options = {**SMALL, "n_iter": 0}
    clean = DLS(**options).solve(g, weight=weight).noise
    torch.testing.assert_close(DLS(**options).solve(spoilt, weight=weight).noise, clean)
    torch.testing.assert_close(DLS(**options).solve(g, weight=7 * weight).noise, clean)
    assert abs(float(clean) - 0.3) < 0.05


def test_a_mask_without_complete_cells_tells_no_noise():
    """There is no closed loop to read it from: a number mu does without, and "auto" is least squares."""
    line = torch.zeros(1, 1, H, W, dtype=torch.bool)
    line[..., 5, :] = True
    z = DLS(**SMALL, mu=0.5).solve(field(), line)
    assert z.height.isfinite().all()
    assert z.noise.isnan().all()
    found = DLS(**SMALL).solve(field(), line)
    torch.testing.assert_close(found.height, LeastSquares()(field(), line))
    assert found.noise.isnan().all()
    assert (found.lam == 0).all()
    both = torch.cat([line, torch.ones_like(line)])  # beside a surface that tells its noise
    beside = DLS(**SMALL)(field(2), both)
    torch.testing.assert_close(beside[:1], LeastSquares()(field(2)[:1], line), rtol=0, atol=1e-3)
    torch.testing.assert_close(beside[1:], DLS(**SMALL)(field(2)[1:], both[1:]), rtol=0, atol=1e-3)


def test_initial_dictionary_is_normalised_kept_or_trained():
    g, atoms = field(2), random_field(16, 20)
    with assert_unchanged(atoms):
        dls = DLS(**SMALL, mu=0.5, dictionary=atoms, learn="fixed")
        result = dls.solve(g)
    torch.testing.assert_close(result.dictionary[0], atoms / atoms.norm(dim=0))
    assert not list(dls.parameters())
    assert set(dls.state_dict()) == {"dictionary"}
    scaled = DLS(**SMALL, mu=0.5, dictionary=3 * atoms, learn="fixed")(g)
    torch.testing.assert_close(scaled, result.height)
    trained = DLS(**SMALL, mu=0.5, dictionary=nn.Parameter(atoms), learn="fixed", derivative="unroll")
    trained(g).square().sum().backward()
    assert trained.dictionary.grad.isfinite().all()
    assert trained.dictionary.grad.abs().max() > 0


def test_one_dictionary_for_each_surface():
    g, atoms = field(2), torch.stack([dct_dictionary(4), random_field(16, 16, dtype=torch.float32)])
    both = DLS(**SMALL, mu=0.5, dictionary=atoms)(g)
    for i in range(2):
        torch.testing.assert_close(both[i : i + 1], DLS(**SMALL, mu=0.5, dictionary=atoms[i])(g[i : i + 1]))


def test_low_rank_atoms_have_the_shape_of_the_patch():
    dls = DLS(patch_size=(4, 8), n_atoms=32, learner="dino_kat", n_iter=2, mu=0.5)
    result = dls.solve(field(1))
    kept = DLS(patch_size=(4, 8), n_atoms=32, learner=DinoKat(), n_iter=2, mu=0.5)(field(1))
    assert (torch.linalg.matrix_rank(result.dictionary[0].mT.unflatten(1, (4, 8)), rtol=1e-6) == 1).all()
    torch.testing.assert_close(kept, result.height, rtol=0, atol=0)


def test_shared_dictionary_of_one_surface_is_its_own():
    g = field(1)
    torch.testing.assert_close(DLS(**SMALL, learn="shared")(g), DLS(**SMALL, learn="each")(g), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"patch_size": 0}, "size: 0 given"),
        ({"patch_size": 4, "stride": 5}, "stride: .* uncovered"),
        ({"n_atoms": 0}, "n_atoms: 0 given"),
        ({"lam": -1.0}, "lam=-1.0"),
        ({"lam": float("nan")}, "lam=nan"),
        ({"lam": float("inf")}, "lam=inf"),
        ({"lam": "much"}, "lam='much'"),
        ({"lam": None}, "lam is a NoneType"),
        ({"lam": torch.tensor([1.0, -1.0])}, "lam"),
        ({"mu": -0.1}, "mu=-0.1"),
        ({"mu": float("nan")}, "mu=nan"),
        ({"mu": "none"}, "mu='none'"),
        ({"n_iter": -1}, "n_iter=-1"),
        ({"n_iter": 2.5}, "n_iter=2.5"),
        ({"mu": [1.0, 0.5]}, "mu has 2 values for n_iter=50 iterations"),
        ({"mu": [1.0, -0.5], "n_iter": 2}, "a schedule of numbers of at least 0 is needed"),
        ({"mu": [1.0, 0.5], "n_iter": 2, "select": True}, "does not go with a schedule"),
        ({"lam": [1.0, 0.5]}, "lam is a list"),
        ({"height_step": "fast"}, "height_step='fast' is unknown; choose from 'exact', 'proximal', or make a Exact"),
        ({"height_step": 3}, "height_step=3 is unknown"),
        ({"derivative": "backward"}, "derivative='backward' is unknown; choose from 'auto', 'unroll', 'implicit'"),
        ({"learn": "none"}, "learn='none'"),
        ({"tol": -1e-3}, "tol=-0.001"),
        ({"data_term": "tv"}, "data_term is a str"),
        ({"data_term": LineIntegral()}, "data_term LineIntegral is not built on the weighted solve"),
        ({"dictionary": [[1.0]]}, "dictionary is a list"),
        ({"dictionary": torch.ones(16, 4)}, r"dictionary \(16, 4\) given, .* n = 64"),
        ({"dictionary": torch.ones(64)}, r"dictionary \(64,\)"),
        ({"dictionary": torch.zeros(64, 4)}, "atom that is zero or not finite"),
        ({"dictionary": torch.full((64, 4), torch.nan)}, "atom that is zero or not finite"),
        ({"pixel_size": 0}, "pixel_size: 0 given"),
        ({"learner": SoupDIL("block"), "learn": "fixed"}, "order='block', .* have no effect with learn='fixed'"),
        ({"learner": "fixed", "learn": "shared"}, "learn='shared' does not go with a fixed dictionary"),
    ],
    ids=str,
)
def test_bad_settings_are_named(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        DLS(**options)


@pytest.mark.parametrize(
    "options, shape, message",
    [
        ({"lam": torch.ones(3)}, (2, 2, 16, 16), r"lam \(3,\) does not fit 2 surfaces"),
        ({"mu": torch.ones(3)}, (2, 2, 16, 16), r"mu \(3,\) does not fit 2 surfaces"),
        ({"dictionary": torch.rand(3, 64, 4)}, (2, 2, 16, 16), r"dictionary \(3, 64, 4\) does not fit 2 surfaces"),
        ({"dictionary": torch.rand(2, 64, 4), "learn": "shared"}, (2, 2, 16, 16), "learn='shared'"),
    ],
)
def test_fields_that_do_not_fit_the_settings_are_named(options, shape, message):
    with pytest.raises(ValueError, match=message):
        DLS(**options)(torch.zeros(shape))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: SoupDIL("row"), "SoupDIL: order='row' is unknown; choose from 'atom', 'block'"),
        (lambda: SoupDIL(unused="last"), "SoupDIL: unused='last'"),
        (lambda: SoupDIL(threshold="medium"), "SoupDIL: threshold='medium'"),
        (lambda: SoupDIL(bound=0.0), "SoupDIL: bound=0.0"),
        (lambda: SoupDIL(n_sweeps=0), "SoupDIL: n_sweeps=0"),
        (lambda: FixedDictionary("medium"), "FixedDictionary: threshold='medium'"),
        (lambda: KSVD(bound=-1.0), "KSVD: bound=-1.0"),
        (lambda: Unitary(bound=float("nan")), "Unitary: bound=nan"),
        (lambda: Exact(0.0), "Exact: tol=0.0"),
        (lambda: Implicit(-1.0), "Implicit: tol=-1.0"),
        (lambda: Proximal(0), "Proximal: steps=0"),
        (lambda: Proximal(accelerated=True), "accelerated=True has no effect with steps=1"),
    ],
)
def test_bad_settings_of_parts_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_it_has_at_most_sixteen_options():
    assert len(inspect.signature(DLS).parameters) <= 16


@pytest.mark.parametrize("given", [{}, {"mask": MASKS["ring_and_islands"](H, W)}], ids=["plain", "mask"])
def test_a_schedule_is_one_threshold_after_the_other(given):
    """Each iteration is that of a run with this threshold alone, from where the last one ended."""
    g, mus = field(2), [0.9, 0.6, 0.6, 0.3]
    found = DLS(**{**SMALL, "n_iter": 4}, lam=0.5, mu=mus, height_step=Exact(1e-12)).solve(g, **given)
    assert found.mu.tolist() == [0.3, 0.3]
    dls = DLS(**SMALL, lam=0.5, mu=1.0, height_step=Exact(1e-12))
    fields = dls._check_fields(g, **given)
    problem, settings = dls._problem(fields, noise_level(g, **given)), dls._settings
    state = start(problem, dls._initial_dictionary(fields), settings)
    costs = []
    for i, mu in enumerate(mus):
        problem = problem._replace(mu=torch.full((2,), mu, dtype=g.dtype))
        state = iterate(problem, state, settings, i)
        costs.append(objective(problem, state, settings))
    torch.testing.assert_close(found.objective[:, 1:], torch.stack(costs, 1))
    torch.testing.assert_close(found.codes, state.B)


def test_no_surface_stops_before_the_last_change_of_the_schedule():
    plane = torch.ones(1, 2, H, W, dtype=torch.float64)
    falling = DLS(**{**SMALL, "tol": 0.5, "n_iter": 6}, mu=[3.0, 2.0, 1.0, 1.0, 1.0, 1.0]).solve(plane)
    assert falling.iterations.tolist() == [3]
    assert falling.converged.all()


def test_accelerated_steps_are_those_of_nesterov():
    """Against the same recursion on the dense normal equations; and they get further than plain ones."""
    g = field()
    dls = DLS(**SMALL, lam=0.5, mu=0.5)
    problem, settings = dls._problem(dls._check_fields(g), noise_level(g)), dls._settings
    state = start(problem, dls._initial_dictionary(problem.fields), settings)
    a = GradientOperator()
    M = torch.func.jacrev(lambda z: a(z.view(1, 1, H, W)).flatten())(torch.zeros(H * W, dtype=g.dtype))
    v, _ = edge_slopes(g)
    r = problem.coverage.expand(1, 1, H, W).flatten()  # 2 lam c
    pull = r * state.z.flatten() / 2
    z = y = state.z.flatten()
    t, tau = 1.0, 1 / a.norm_bound**2
    for _ in range(3):
        new = (y - tau * M.T @ (M @ y - v.flatten()) + tau * pull) / (1 + tau * r)
        t, old = (1 + (1 + 4 * t * t) ** 0.5) / 2, t
        z, y = new, new + (old - 1) / t * (new - z)
    folded = problem.coverage * state.z / 2
    steps = settings._replace(height_step=Proximal(3, accelerated=True))
    torch.testing.assert_close(update_height(problem, state.z, folded, steps).flatten(), z)
    best = update_height(problem, state.z, folded, settings._replace(height_step=Exact(1e-12)))
    many = [
        update_height(problem, state.z, folded, settings._replace(height_step=Proximal(30, a))) for a in (False, True)
    ]
    plain, fast = ((z - best).norm() for z in many)
    assert fast < 0.5 * plain


def selected(surface, snr, **options):
    surface = SURFACES[surface](48, dtype=torch.float64)
    gradient = add_noise(surface.gradient, snr, seeded(2))
    return surface, gradient, DLS(select=True, n_iter=8, tol=0, height_step=Exact(1e-11), **options).solve(gradient)


@pytest.mark.slow
def test_select_takes_the_threshold_of_the_smaller_error():
    """On a strongly noisy Tent it raises the threshold, and gains by it."""
    surface, gradient, found = selected("tent", 1)
    assert found.mu > 1.2 * found.noise
    assert found.lam == 0.5
    plain, default = LeastSquares()(gradient), DLS(n_iter=8, tol=0)(gradient)
    errors = [float(rmse(z, surface.height)) for z in (found.height, default, plain)]
    assert errors == sorted(errors)
    torch.testing.assert_close(
        DLS(lam=0.5, mu=found.mu, n_iter=8, tol=0, height_step=Exact(1e-11))(gradient), found.height
    )


@pytest.mark.slow
def test_select_keeps_least_squares_where_nothing_is_to_gain_each_surface_for_itself():
    _, tent, first = selected("tent", 1)
    _, fractal, second = selected("fractal", 40)
    assert second.lam == 0
    torch.testing.assert_close(second.height, LeastSquares()(fractal), rtol=0, atol=1e-7)
    both = DLS(select=True, n_iter=8, tol=0, height_step=Exact(1e-11)).solve(torch.cat([tent, fractal]))
    torch.testing.assert_close(both.height, torch.cat([first.height, second.height]), rtol=0, atol=1e-7)
    assert both.lam.tolist() == [0.5, 0]


def test_select_sets_a_given_threshold_against_least_squares():
    _, _, harmful = selected("tent", 30, mu=5.0)
    assert harmful.lam == 0
    _, _, useful = selected("tent", 1, mu=1.5)
    assert useful.mu == 1.5
    assert useful.lam == 0.5


@pytest.mark.slow
def test_the_choice_is_held_fixed_in_the_derivative():
    _, gradient, found = selected("tent", 1)
    chosen = DLS(lam=0.5, mu=found.mu, n_iter=8, tol=0, height_step=Exact(1e-11))
    slopes = []
    for model in (DLS(select=True, n_iter=8, tol=0, height_step=Exact(1e-11)), chosen):
        point = gradient.clone().requires_grad_()
        model(point).square().sum().backward()
        slopes.append(point.grad)
    assert slopes[0].abs().max() > 0
    torch.testing.assert_close(*slopes)


def test_select_refuses_what_it_cannot_predict():
    g = field()
    mask = torch.ones(1, 1, H, W, dtype=torch.bool)
    DLS(**SMALL, select=True)(g, mask)
    mask[..., 3, 3] = False
    with pytest.raises(ValueError, match=r"full rectangles.*\(1, 2,"):
        DLS(**SMALL, select=True)(g, mask)
    line = torch.zeros_like(mask)
    line[..., 5, :] = True
    with pytest.raises(ValueError, match="full rectangles"):
        DLS(**SMALL, mu=0.5, select=True)(g, line)
    with pytest.raises(ValueError, match="shared"):
        DLS(**SMALL, select=True, learn="shared")
    with pytest.raises(ValueError, match="TotalVariation"):
        DLS(**SMALL, select=True, data_term=TotalVariation())
