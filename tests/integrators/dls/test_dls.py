"""DLS: an objective that never rises in any mode, its limits, its options, and what it refuses."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from tests.helpers import MASKS, random_field, seeded, sparse_solve
from torchdls import (
    DLS,
    DLSResult,
    Exact,
    FixedDictionary,
    LeastSquares,
    Patches,
    Proximal,
    SoupDIL,
    add_noise,
    dls_objective,
    edge_slopes,
    mean_angular_error,
    noise_level,
    rmse,
)
from torchdls.noise import averaging_error
from torchdls.surfaces import tent

SMALL: dict[str, Any] = {"patch_size": 4, "stride": 2, "n_atoms": 16, "n_iter": 6, "tol": 0.0}
H, W = 19, 17


def field(n=1, noise=0.3, h=H, w=W):
    """Slopes of a roof-like surface with noise; each surface of the batch is another."""
    y, x = torch.meshgrid(torch.arange(h, dtype=torch.float64), torch.arange(w, dtype=torch.float64), indexing="ij")
    one = torch.stack([torch.sign(w / 2 - x), 0.5 * torch.sign(h / 3 - y)])
    return torch.stack([one * (1 + i) for i in range(n)]) + noise * random_field(n, 2, h, w, seed=4)


def inputs(n, *kinds):
    """Optional arguments of the named kinds."""
    known = {
        "mask": {"mask": MASKS["ring_and_islands"](H, W)},
        "sieve": {"mask": MASKS["sieve"](H, W)},
        "weight": {"weight": torch.rand(n, 2, H, W, dtype=torch.float64, generator=seeded(1)) * 2},
        "anchor": {
            "anchor": 3 * random_field(n, 1, H, W, seed=2),
            "anchor_weight": (torch.rand(n, 1, H, W, dtype=torch.float64, generator=seeded(3)) < 0.05).double(),
        },
    }
    return {key: value for kind in kinds for key, value in known[kind].items()}


def assert_monotone(objective):
    """No rise, but for the rounding of a sum; and a real descent from the start."""
    rise = objective.diff(dim=-1).amax()
    assert rise <= 1e-9 * objective.amax(), f"rises by {rise:.2e} of {objective.amax():.2e}"
    assert (objective[..., -1] < objective[..., 0]).all()


GIVEN = [(), ("mask",), ("sieve",), ("weight",), ("anchor",), ("sieve", "weight", "anchor")]


@pytest.mark.parametrize("given", GIVEN, ids=lambda g: "+".join(g) or "plain")
@pytest.mark.parametrize("height_step", [Exact(1e-10), Proximal()], ids=repr)
@pytest.mark.parametrize("learn", ["each", "shared", "fixed"])
@pytest.mark.parametrize("order", ["atom", "block"])
def test_objective_never_rises(order, learn, height_step, given):
    learner = FixedDictionary() if (learn, order) == ("fixed", "block") else SoupDIL(order)
    dls = DLS(**SMALL, lam=0.7, mu=0.5, learner=learner, learn=learn, height_step=height_step)
    objective = dls.solve(field(2), **inputs(2, *given)).objective
    assert objective.shape == (2, 7)
    assert_monotone(objective.sum(0) if learn == "shared" else objective)


@pytest.mark.parametrize("given", GIVEN, ids=lambda g: "+".join(g) or "plain")
@pytest.mark.parametrize(
    "options",
    [
        {"learner": SoupDIL(n_sweeps=3)},
        {"height_step": Proximal(4)},
        {"learner": SoupDIL(bound=2.0)},
        {"learner": SoupDIL(bound=0.3, n_sweeps=2)},
        {"learner": SoupDIL(unused="keep"), "mu": 3.0},
        {"learner": FixedDictionary("soft", bound=1.0, n_sweeps=2)},
        {"stride": 4},
        {"patch_size": (3, 5), "stride": (2, 3), "n_atoms": 20},
        {"pixel_size": (0.5, 3.0)},
        {"lam": 50.0},
        {"lam": 1e-3, "mu": 1e-3},
        {"lam": torch.tensor([0.1, 5.0]), "mu": torch.tensor([1.0, 0.2])},
    ],
    ids=str,
)
def test_objective_never_rises_whatever_the_options(options, given):
    dls = DLS(**{**SMALL, "lam": 0.7, "mu": 0.5, "height_step": Exact(1e-10), **options})
    assert_monotone(dls.solve(field(2), **inputs(2, *given)).objective)


def test_objective_never_rises_where_hardly_a_pixel_of_a_patch_is_valid():
    """The first sweep fits what continues the surface outside, which the objective does not count."""
    for seed in range(60):
        draw = seeded(seed)
        mask = torch.rand(1, 1, 10, 8, generator=draw) < 0.04 + 0.2 * torch.rand((), generator=draw)
        mask[..., 3:5, 2] = mask[..., 2:4, 6] = True
        g = 3 + 0.3 * torch.randn(1, 2, 10, 8, dtype=torch.float64, generator=draw)
        mu = float(10 ** (1.5 * torch.rand((), generator=draw) - 1))
        dls = DLS(mu=mu, n_iter=2, tol=0.0, learn="fixed", height_step=Exact(1e-9))
        anchors = {"anchor": torch.zeros_like(g[:, :1]), "anchor_weight": mask.double()}  # the constants stay
        result = dls.solve(g, mask, **anchors)
        objective = result.objective[0]
        assert objective.diff().max() <= 1e-9 * objective.max()
        z, D, B = result.height, result.dictionary, result.codes
        cost = dls_objective(z, g, D, B, result.lam, result.mu, patches=dls.patches, mask=mask)
        torch.testing.assert_close(objective[-1:], cost + 0.5 * z.square().sum((-3, -2, -1)))


@pytest.mark.parametrize("learn", ["each", "shared", "fixed"])
def test_objective_never_rises_once_surfaces_settle(learn):
    """A calm surface stops early next to a wild one."""
    g = torch.cat([field(1, noise=0.01), field(1, noise=2.0), torch.zeros(1, 2, H, W, dtype=torch.float64)])
    dls = DLS(**{**SMALL, "n_iter": 25, "tol": 0.02}, mu=0.5, learn=learn)
    result = dls.solve(g)
    assert result.converged.any()
    assert len(result.dictionary) == (3 if learn == "each" else 1)
    assert (result.objective.sum(0) if learn == "shared" else result.objective).diff(dim=-1).amax() <= 1e-9
    height, D, B = result.height, result.dictionary, result.codes
    expected = dls_objective(height, g, D, B, result.lam, result.mu, patches=dls.patches)
    torch.testing.assert_close(result.objective[:, -1], expected, rtol=1e-3, atol=1e-9)


def test_objective_is_the_cost_of_what_is_returned():
    """The returned height differs from the last iterate by its free constant, so anchor it."""
    g, given = field(2), inputs(2, "sieve", "weight")
    dls = DLS(**SMALL, lam=0.7, mu=0.5)
    result = dls.solve(g, **given, anchor=torch.zeros(2, 1, H, W).double(), anchor_weight=0.5)
    expected = dls_objective(
        result.height, g, result.dictionary, result.codes, result.lam, result.mu, patches=dls.patches, **given
    )
    anchors = 0.25 * (result.height.square() * given["mask"]).sum((-3, -2, -1))
    torch.testing.assert_close(result.objective[:, -1], expected + anchors)
    # The same by loops, on the first surface.
    error = averaging_error(g, given["mask"], given["weight"])
    v, w = edge_slopes(g, given["mask"], given["weight"], error=error)
    z, inside = result.height[0, 0], given["mask"][0, 0]
    slopes = torch.zeros(2, H, W, dtype=z.dtype)
    slopes[0, :, :-1], slopes[1, :-1] = z.diff(dim=1), z.diff(dim=0)
    cost = 0.5 * (w[0] * (slopes - v[0]).square()).sum()
    corners = itertools.product([*range(0, H - 4, 2), H - 4], [*range(0, W - 4, 2), W - 4])
    for j, (r, c) in enumerate(corners):
        approximation = (result.dictionary[0] @ result.codes[0, :, j]).view(4, 4)
        misfit = (z[r : r + 4, c : c + 4] - approximation)[inside[r : r + 4, c : c + 4]]
        cost += 0.7 * (misfit.square().sum() + 0.25 * (result.codes[0, :, j] != 0).sum())
    torch.testing.assert_close(expected[0], cost)


# Limits


@pytest.mark.parametrize("given", GIVEN, ids=lambda g: "+".join(g) or "plain")
@pytest.mark.parametrize("height_step", [Exact(1e-11), Proximal()], ids=repr)
def test_without_patches_it_is_least_squares(height_step, given):
    """lam = 0: the patches have no say, every height is the least-squares one."""
    g, given = field(2), inputs(2, *given)
    expected = LeastSquares(tol=1e-11)(g, **given)
    dls = DLS(**SMALL, lam=0.0, mu=0.5, height_step=height_step, data_term=LeastSquares(tol=1e-11))
    torch.testing.assert_close(dls(g, **given), expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(DLS(**{**SMALL, "n_iter": 0})(g, **given), LeastSquares()(g, **given))


@pytest.mark.parametrize("mu", [1e3, 1e30, math.inf])
@pytest.mark.parametrize("mask", [None, "ring_and_islands"])
def test_a_huge_threshold_leaves_only_the_pull_of_the_patches(mask, mu):
    """No code survives: least squares with every patch pulling its pixels to 0, r = 2 lam c."""
    g = field(2).float()
    inside = None if mask is None else MASKS[mask](H, W)
    result = DLS(**SMALL, lam=0.7, mu=mu).solve(g, inside)
    assert (result.codes == 0).all()
    assert result.objective.isfinite().all()
    r = 1.4 * Patches(4, 2).coverage((H, W), dtype=torch.float64)
    r = r if inside is None else r * inside
    v, w = edge_slopes(g.double(), inside)
    z = torch.from_numpy(np.stack([sparse_solve(v[n], None if w is None else w[0], None, r[0]) for n in range(2)]))[
        :, None
    ]
    if inside is None:
        torch.testing.assert_close(result.height.double(), z - z.mean((-2, -1), keepdim=True), rtol=0, atol=1e-4)
    else:
        slopes = result.height.double().diff(dim=-1) - z.diff(dim=-1)
        assert slopes[inside.expand(2, -1, -1, -1)[..., 1:] & inside[..., :-1]].abs().max() < 1e-4


def test_all_codes_kept_is_least_squares_too():
    """mu = 0 with an orthonormal dictionary: the patches are met exactly and pull nowhere, and atoms stay."""
    g = field(2)
    for learner in ("fixed", SoupDIL("block")):
        z = DLS(**SMALL, mu=0.0, learner=learner)(g)
        torch.testing.assert_close(z, LeastSquares()(g), rtol=0, atol=1e-5)


def test_a_clean_plane_is_exact_with_mu_from_its_noise():
    for shape, slopes in [((16, 16), (0.3, -0.7)), ((13, 18), (5.0, 0.0))]:
        g = torch.tensor(slopes, dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, *shape)
        torch.testing.assert_close(DLS(**SMALL, learner=SoupDIL("block"))(g), LeastSquares()(g), rtol=0, atol=1e-5)


def test_auto_follows_the_scale_of_the_slopes_and_the_pixels():
    g = field(1)
    z = DLS(**SMALL)(g)
    torch.testing.assert_close(DLS(**SMALL)(1e3 * g), 1e3 * z, rtol=0, atol=1e-3)
    torch.testing.assert_close(DLS(**SMALL, pixel_size=0.1)(g), 0.1 * z)


def test_it_beats_least_squares_on_the_noisy_tent():
    surface = tent(64, dtype=torch.float32)
    g = add_noise(surface.gradient, 1.0, generator=seeded(0))
    ls, dls = LeastSquares()(g), DLS(n_iter=20)(g)
    assert rmse(dls, surface.height) < 0.9 * rmse(ls, surface.height)
    assert mean_angular_error(dls, surface.height) < 0.6 * mean_angular_error(ls, surface.height)


# Results


@pytest.mark.parametrize("learn", ["each", "shared", "fixed"])
@pytest.mark.parametrize("n", [1, 3])
def test_shapes_of_the_result(n, learn):
    dls = DLS(patch_size=(4, 3), stride=(3, 1), n_atoms=15, n_iter=2, learn=learn)
    result = dls.solve(field(n).float())
    L = math.prod(dls.patches.grid((H, W)))
    assert isinstance(result, DLSResult)
    assert result.height.shape == (n, 1, H, W)
    assert result.dictionary.shape == (n if learn == "each" else 1, 12, 15)
    assert result.codes.shape == (n, 15, L)
    assert result.objective.shape == (n, 3)
    assert all(getattr(result, name).shape == (n,) for name in ("noise", "lam", "mu", "converged"))
    assert result.converged.dtype == torch.bool
    torch.testing.assert_close(result.dictionary.norm(dim=1), torch.ones_like(result.dictionary[:, 0]))
    torch.testing.assert_close(dls(field(n).float()), result.height, rtol=0, atol=0)


def test_a_single_field_is_a_batch_of_one():
    dls, g = DLS(**SMALL), field(1)
    for a, b in zip(dls.solve(g[0]), dls.solve(g), strict=True):
        assert torch.equal(a, b)
    assert dls(g[0]).shape == (1, H, W)


def test_codes_and_dictionary_describe_the_height_in_its_unit():
    """Patches of the height, in millimetres too, are D B up to what was thresholded."""
    g = field(1, noise=0.0)
    for pixel_size in (1.0, 0.2):
        dls = DLS(**SMALL, mu=1e-3, pixel_size=pixel_size)
        result = dls.solve(g)
        P = dls.patches.extract(result.height)
        assert (P - result.dictionary @ result.codes).abs().max() < 0.02 * pixel_size


def test_noise_lam_and_mu_are_reported():
    g = field(2)
    result = DLS(**SMALL).solve(g)
    torch.testing.assert_close(result.noise, noise_level(g))
    assert result.lam.tolist() == [0.5, 0.5]
    assert (result.mu / result.noise).std() < 1e-12
    result = DLS(**SMALL, lam=torch.tensor([0.1, 0.2]), mu=3).solve(g)
    torch.testing.assert_close(result.lam, torch.tensor([0.1, 0.2], dtype=g.dtype))
    assert result.mu.tolist() == [3.0, 3.0]


def test_callback_sees_every_iteration():
    seen = []
    result = DLS(**SMALL).solve(field(2), callback=lambda i, objective: seen.append((i, objective)))
    assert [i for i, _ in seen] == [1, 2, 3, 4, 5, 6]
    torch.testing.assert_close(torch.stack([o for _, o in seen], 1), result.objective[:, 1:])
    assert not any(o.requires_grad for _, o in seen)
    seen.clear()
    early = DLS(**{**SMALL, "n_iter": 50, "tol": 0.05}).solve(field(), callback=lambda i, o: seen.append(i))
    assert early.converged.all()
    assert 0 < len(seen) < 50
    assert early.objective.shape == (1, 51)
    assert (early.objective[:, len(seen) :] == early.objective[:, -1:]).all()


@pytest.mark.parametrize("learn", ["each", "fixed"])
def test_a_batch_is_its_surfaces_one_by_one(learn):
    g = torch.cat([field(1, noise=0.05), field(1, noise=1.0)])
    dls = DLS(**{**SMALL, "n_iter": 30, "tol": 0.01}, learn=learn)
    together = dls.solve(g)
    for i in range(2):
        alone = dls.solve(g[i : i + 1])
        torch.testing.assert_close(together.height[i : i + 1], alone.height, rtol=0, atol=1e-8)
        torch.testing.assert_close(together.codes[i : i + 1], alone.codes, rtol=0, atol=1e-8)


@pytest.mark.parametrize("given", [{}, {"anchor": 0.5}], ids=["free", "anchored"])
def test_patches_side_by_side_need_no_iterative_solve(given, monkeypatch):
    """Every pixel is then in one patch, and the height is one direct solve: the one that iterations find, too."""
    g = random_field(2, 2, 24, 16)
    fields = {}
    if given:
        fields = {"anchor": random_field(2, 1, 24, 16, seed=1), "anchor_weight": given["anchor"]}
    dls = DLS(patch_size=4, stride=4, n_atoms=16, lam=0.05, mu=0.3, n_iter=3, tol=0.0, height_step=Exact(1e-12))
    assert not Patches(4, 4).even((24, 15))
    with monkeypatch.context() as patch:
        patch.setattr(Patches, "even", lambda *_: False)
        expected = dls.solve(g, **fields)
    with monkeypatch.context() as patch:
        patch.setattr("torchdls.solvers.poisson.conjugate_gradients", None)
        found = dls.solve(g, **fields)
    torch.testing.assert_close(found.height, expected.height, rtol=0, atol=1e-8)
    torch.testing.assert_close(found.objective, expected.objective)


@pytest.mark.parametrize("learner", ["soup_dil", "unitary", "dino_kat", "fixed"])
def test_without_a_threshold_it_is_least_squares(learner):
    """Patches that are codes of their dictionary cost nothing, so nothing draws the height from the data term."""
    plane = torch.tensor([0.3, -0.7], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, 20, 24)
    for g in (plane, random_field(1, 2, 20, 24)):
        torch.testing.assert_close(DLS(mu=0.0, learner=learner)(g), LeastSquares()(g), atol=1e-12, rtol=0)
