"""The solve (*) against SciPy's sparse factorisation, and its derivatives against finite differences."""

import numpy as np
import pytest
import torch

from tests.helpers import (
    MASKS,
    assert_gradients,
    assert_unchanged,
    normal_equations,
    random_field,
    seeded,
    sparse_solve,
)
from torchdls import ConvergenceWarning, SolveResult, edge_slopes, solve
from torchdls.solvers import conjugate_gradients, direct, harmonic_extension, integrate_direct, solve_direct

SHAPES = [(1, 1), (1, 7), (6, 1), (2, 2), (9, 8), (70, 66)]
PIXELS = [(1.0, 1.0), (0.5, 3.0)]


def assert_solves(z, v, w, anchor=None, r=None, pixel_size=(1.0, 1.0), atol=1e-7):
    """Each surface of z is the minimiser that SciPy finds."""
    for n in range(len(v)):
        one = [None if t is None else t[min(n, len(t) - 1)] for t in (w, anchor, r)]
        expected = sparse_solve(v[n], *one, pixel_size=pixel_size)
        np.testing.assert_allclose(z[n, 0].detach().numpy(), expected, atol=atol * (1 + np.abs(expected).max()))


@pytest.mark.parametrize("pixel_size", PIXELS, ids=str)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_rectangles_are_solved_directly(shape, pixel_size):
    v, _ = edge_slopes(random_field(2, 2, *shape))
    result = solve(v, pixel_size=pixel_size)
    assert isinstance(result, SolveResult)
    assert result.height.shape == (2, 1, *shape)
    assert result.converged.tolist() == [True, True]
    assert result.iterations.tolist() == [0, 0]
    assert_solves(result.height, v, None, pixel_size=pixel_size, atol=1e-11)


@pytest.mark.parametrize("pixel_size", PIXELS, ids=str)
def test_one_anchor_weight_per_surface_is_solved_directly(pixel_size):
    v, _ = edge_slopes(random_field(3, 2, 9, 8))
    anchor = random_field(3, 1, 9, 8, seed=1)
    r = torch.tensor([0.0, 1e-3, 5.0], dtype=torch.float64)[:, None, None, None]
    result = solve(v, None, anchor, r, pixel_size=pixel_size)
    assert result.iterations.sum() == 0
    assert_solves(result.height, v, None, anchor, r.expand_as(anchor), pixel_size, atol=1e-10)
    by_number = solve(v, None, anchor, 5.0, pixel_size=pixel_size).height
    torch.testing.assert_close(by_number[2], result.height[2])
    by_scalar_tensor = solve(v, None, anchor, torch.tensor(5.0, dtype=v.dtype), pixel_size=pixel_size).height
    torch.testing.assert_close(by_scalar_tensor, by_number)


@pytest.mark.parametrize("pixel_size", PIXELS, ids=str)
@pytest.mark.parametrize("anchored", ["free", "points", "firm"])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS.keys())
def test_masks_weights_and_anchors(mask, weighted, anchored, pixel_size):
    h, w = 24, 21
    inside = mask(h, w).expand(2, -1, -1, -1)
    weight = torch.rand(2, 2, h, w, dtype=torch.float64, generator=seeded(2)) + 0.01 if weighted else None
    v, w_e = edge_slopes(random_field(2, 2, h, w), inside, weight)
    anchor = r = None
    if anchored != "free":
        anchor = random_field(2, 1, h, w, seed=3)
        r = inside.double() * 16
        if anchored == "points":  # on a few pixels, and none at all on the second surface
            r = 1e4 * r * (torch.rand(2, 1, h, w, generator=seeded(4)) < 0.02)
            r[1] = 0
    result = solve(v, w_e, anchor, r, tol=1e-11, pixel_size=pixel_size)
    assert result.converged.all()
    assert (result.residual <= 1e-11).all()
    assert_solves(result.height, v, w_e, anchor, r, pixel_size)
    assert (result.height[~inside] == 0).all()


def test_weights_that_jump_by_orders_of_magnitude():
    weight = 10 ** (6 * torch.rand(1, 1, 20, 20, dtype=torch.float64, generator=seeded(0)) - 3)
    v, w = edge_slopes(random_field(1, 2, 20, 20), None, weight)
    assert_solves(solve(v, w, tol=1e-12, max_iter=2000).height, v, w, atol=1e-6)


@pytest.mark.parametrize("dtype, tol", [(torch.float32, 1e-5), (torch.float64, 1e-10)], ids=str)
@pytest.mark.parametrize("mask", ["full", "disk"])
def test_random_weights_cost_few_iterations(mask, dtype, tol):
    """Followed pixel by pixel, such weights would make the preconditioner worse than none: hundreds of iterations."""
    h, w = 100, 90
    inside = torch.ones(1, 1, h, w, dtype=torch.bool) if mask == "full" else MASKS[mask](h, w)
    weight = 0.1 + 0.9 * torch.rand(1, 1, h, w, dtype=torch.float64, generator=seeded(1))
    v, w_e = edge_slopes(random_field(1, 2, h, w), inside, weight)
    result = solve(v.to(dtype), w_e.to(dtype), tol=tol)
    assert int(result.iterations) < 50
    assert result.height.dtype == dtype
    assert_solves(result.height.double(), v, w_e, atol=1e-3 if dtype == torch.float32 else 1e-8)


@pytest.mark.parametrize("scale", [1e-60, 1e60])
def test_the_scale_of_the_weights_does_not_matter(scale):
    """Not even beyond what single precision can hold, in which the preconditioner works."""
    inside = MASKS["disk"](80, 70)
    weight = 0.1 + torch.rand(1, 1, 80, 70, dtype=torch.float64, generator=seeded(1))
    v, w = edge_slopes(random_field(1, 2, 80, 70), inside, weight)
    expected, found = solve(v, w, tol=1e-10), solve(v, scale * w, tol=1e-10)
    assert abs(int(found.iterations) - int(expected.iterations)) <= 1
    torch.testing.assert_close(found.height, expected.height, rtol=0, atol=1e-7)


def test_weights_that_change_slowly_by_orders_of_magnitude():
    y, x = torch.meshgrid(torch.linspace(0, 3, 80), torch.linspace(0, 3, 70), indexing="ij")
    weight = (10 ** (2 * torch.sin(x) * torch.cos(y)))[None, None].double()
    v, w = edge_slopes(random_field(1, 2, 80, 70), None, weight)
    result = solve(v, w, tol=1e-10)
    assert int(result.iterations) < 80
    assert_solves(result.height, v, w)


def test_weights_of_zero_cut_the_surface_apart():
    weight = torch.ones(1, 1, 12, 14, dtype=torch.float64)
    weight[..., 6:8] = 0  # two columns: the edges between them are dead, the outer ones are one-sided
    v, w = edge_slopes(random_field(1, 2, 12, 14), None, weight)
    z = solve(v, w, tol=1e-12).height
    assert_solves(z, v, w)
    assert abs(float(z[..., :7].mean())) < 1e-12
    assert abs(float(z[..., 7:].mean())) < 1e-12


def test_explicit_unit_weights_equal_the_direct_solve():
    v, _ = edge_slopes(random_field(2, 2, 30, 25))
    result = solve(v, torch.ones_like(v), tol=1e-12)
    torch.testing.assert_close(result.height, solve(v).height)
    assert (result.iterations <= 2).all(), "the preconditioner is then the inverse"


def test_residual_iterations_and_warm_start_are_reported_truly():
    inside = MASKS["disk"](40, 40)
    v, w = edge_slopes(random_field(1, 2, 40, 40), inside)
    cold = solve(v, w, tol=1e-8)
    H, b = normal_equations(v[0], w[0], None, None)
    true = np.linalg.norm(b - H @ cold.height.numpy().ravel()) / np.linalg.norm(b)
    assert float(cold.residual) == pytest.approx(true, rel=1e-3)
    warm = solve(v, w, tol=1e-8, z0=cold.height + 3.0)
    assert int(warm.iterations) <= 1
    assert 5 < int(cold.iterations) < 40
    assert int(solve(v, w, tol=1e-3).iterations) < int(cold.iterations)


def test_a_warm_start_cannot_spoil_a_zero_field():
    """The surface is then exactly 0, and the goal tol * ||b|| = 0 cannot be met by iterating."""
    v, w = edge_slopes(torch.zeros(2, 2, 8, 8, dtype=torch.float64), MASKS["disk"](8, 8))
    result = solve(v, w, z0=random_field(2, 1, 8, 8))
    assert result.converged.all()
    assert (result.height == 0).all()


def test_too_few_iterations_warn_once_and_name_the_figures():
    v, w = edge_slopes(random_field(2, 2, 30, 30), MASKS["sieve"](30, 30))
    v[1] = 0
    with pytest.warns(ConvergenceWarning, match="1 of 2 surfaces stopped after 3 iterations .* tol=1.0e-10") as caught:
        result = solve(v, w, tol=1e-10, max_iter=3)
    assert len(caught) == 1
    assert result.converged.tolist() == [False, True]
    assert result.iterations.tolist() == [3, 0]


def test_the_warning_points_at_the_line_that_called():
    v, w = edge_slopes(random_field(1, 2, 30, 30), MASKS["sieve"](30, 30))
    with pytest.warns(ConvergenceWarning) as caught:
        solve(v, w, max_iter=1)
    assert caught[0].filename == __file__


def test_surfaces_of_a_batch_do_not_touch_each_other():
    inside = torch.cat([MASKS["disk"](20, 20), MASKS["sieve"](20, 20), torch.ones(1, 1, 20, 20, dtype=torch.bool)])
    inside[..., :1, :2] = inside[..., -1:, -2:] = True  # each reaches the corners: the same window, together or alone
    g = random_field(3, 2, 20, 20) * torch.tensor([1e-6, 1.0, 1e6], dtype=torch.float64)[:, None, None, None]
    v, w = edge_slopes(g, inside)
    together = solve(v, w, tol=1e-6)
    for n in range(3):
        alone = solve(v[n : n + 1], w[n : n + 1], tol=1e-6)
        assert int(together.iterations[n]) == int(alone.iterations)
        scale = float(alone.height.abs().max())
        torch.testing.assert_close(together.height[n : n + 1], alone.height, rtol=0, atol=1e-9 * scale)


def test_a_larger_window_of_the_batch_changes_nothing_beyond_the_tolerance():
    inside = torch.zeros(2, 1, 30, 24, dtype=torch.bool)
    inside[0, :, 3:9, 12:20] = True
    inside[1, :, 20:29, 2:11] = True
    v, w = edge_slopes(random_field(2, 2, 30, 24), inside)
    together = solve(v, w, tol=1e-12)
    for n in range(2):
        alone = solve(v[n : n + 1], w[n : n + 1], tol=1e-12)
        torch.testing.assert_close(together.height[n : n + 1], alone.height, rtol=0, atol=1e-10)
    assert bool((together.height[~inside] == 0).all())


def test_float32_converges_to_its_precision():
    inside = MASKS["ring_and_islands"](60, 60)
    g = random_field(1, 2, 60, 60)
    v, w = edge_slopes(g.float(), inside)
    result = solve(v, w, tol=1e-6)
    assert result.height.dtype == torch.float32
    assert result.converged.all()
    v, w = edge_slopes(g, inside)
    torch.testing.assert_close(result.height.double(), solve(v, w, tol=1e-12).height, rtol=0, atol=1e-4)


def test_inputs_are_left_alone():
    inside = MASKS["disk"](12, 12)
    v, w = edge_slopes(random_field(1, 2, 12, 12), inside)
    anchor, r, z0 = random_field(1, 1, 12, 12), inside.double(), random_field(1, 1, 12, 12, seed=1)
    with assert_unchanged(v, w, anchor, r, z0):
        solve(v, w, anchor, r, z0=z0)
        solve(v, None, anchor, 0.5)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"v": torch.zeros(2, 8, 8)}, r"v \(2, 8, 8\)"),
        ({"v": torch.zeros(1, 3, 8, 8)}, r"v \(1, 3, 8, 8\)"),
        ({"w": torch.ones(1, 2, 8, 7)}, r"w \(1, 2, 8, 7\) .* v \(2, 2, 8, 8\)"),
        ({"anchor": torch.ones(1, 2, 8, 8), "anchor_weight": 1.0}, r"anchor \(1, 2, 8, 8\)"),
        ({"anchor": torch.ones(2, 1, 8, 8), "anchor_weight": torch.ones(2, 1, 7, 8)}, r"anchor_weight \(2, 1, 7, 8\)"),
        ({"z0": torch.ones(2, 1, 8, 9)}, r"z0 \(2, 1, 8, 9\)"),
        ({"tol": 0.0}, "tol"),
        ({"max_iter": 0}, "max_iter"),
        ({"pixel_size": -1.0}, "pixel_size"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        solve(**{"v": torch.zeros(2, 2, 8, 8)} | arguments)


@pytest.mark.parametrize("anchored", [False, True])
def test_derivatives_are_exact(anchored):
    """First in both modes, and second, with respect to slopes, weights, anchors and their weights."""
    inside = torch.ones(1, 1, 3, 3, dtype=torch.bool)
    inside[..., 1, 1] = inside[..., 0, 2] = False
    inputs = [random_field(1, 2, 3, 3), random_field(1, 2, 3, 3, seed=1).exp()]
    if anchored:
        inputs += [random_field(1, 1, 3, 3, seed=2), random_field(1, 1, 3, 3, seed=3).exp()]

    def height(g, t, *anchors):
        v, w = edge_slopes(g, inside, t)
        return solve(v, w, *anchors, tol=1e-13).height

    assert_gradients(height, *inputs, second=True, forward=True)


def test_derivatives_of_the_direct_solve():
    r = torch.tensor([0.3, 2.0], dtype=torch.float64)[:, None, None, None]
    inputs = random_field(2, 2, 3, 4), random_field(2, 1, 3, 4, seed=1), r
    assert_gradients(lambda v, a, r: solve(v, None, a, r).height, *inputs, second=True)


def test_vmap_and_jacobians_equal_a_loop():
    inside = MASKS["disk"](5, 5)
    g = random_field(3, 1, 2, 5, 5)

    def height(g):
        v, w = edge_slopes(g, inside)
        return solve(v, w, tol=1e-13).height

    torch.testing.assert_close(torch.func.vmap(height)(g), torch.stack([height(x) for x in g]))
    torch.testing.assert_close(torch.func.jacrev(height)(g[0]), torch.func.jacfwd(height)(g[0]))


@pytest.mark.parametrize("taped", [False, True])
@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("shape", [*SHAPES, (128, 3), (129, 5), (4, 130), (131, 140)], ids=str)
def test_full_rectangles_by_products_and_by_transforms(shape, n, taped):
    """One surface and several, small and large, recorded or not: each takes another way to the same minimiser."""
    g = random_field(n, 2, *shape)
    with assert_unchanged(g):
        z = integrate_direct(g.requires_grad_(taped), (0.5, 3.0)).detach()
    assert z.shape == (n, 1, *shape)
    assert_solves(z, edge_slopes(g.detach())[0], None, pixel_size=(0.5, 3.0), atol=1e-10)
    assert z.mean((1, 2, 3)).abs().max() < 1e-12 * (1 + z.abs().max())
    if taped:
        probe = random_field(n, 1, *shape, seed=1)
        (slope,) = torch.autograd.grad((integrate_direct(g, (0.5, 3.0)) * probe).sum(), g)
        change = random_field(n, 2, *shape, seed=2)
        torch.testing.assert_close((slope * change).sum(), (probe * integrate_direct(change, (0.5, 3.0))).sum())


def test_solve_direct_inverts_the_shifted_laplacian():
    b = random_field(2, 1, 6, 5)
    H, _ = normal_equations(
        torch.zeros(2, 6, 5).double(), None, None, torch.full((1, 6, 5), 0.7, dtype=b.dtype), (2.0, 1.0)
    )
    x = solve_direct(b, 0.7, (2.0, 1.0))
    np.testing.assert_allclose(H @ x.numpy().reshape(2, -1).T, b.numpy().reshape(2, -1).T, atol=1e-12)


@pytest.mark.parametrize("taped", [False, True])
def test_large_batches_are_integrated_a_few_at_a_time(taped, monkeypatch):
    """The parts come out in order, whether a derivative is recorded or not."""
    monkeypatch.setattr(direct, "_IN_CACHE", 2 * 70 * 66)
    g = random_field(5, 2, 70, 66).requires_grad_(taped)
    z = integrate_direct(g, (0.5, 3.0))
    assert_solves(z, edge_slopes(g.detach())[0], None, pixel_size=(0.5, 3.0), atol=1e-11)
    if taped:
        c = random_field(5, 1, 70, 66, seed=1)
        (slope,) = torch.autograd.grad((c * z).sum(), g)
        e = random_field(5, 2, 70, 66, seed=2)
        torch.testing.assert_close((slope * e).sum(), (c * integrate_direct(e, (0.5, 3.0))).sum())


def test_conjugate_gradients_on_dense_systems():
    M = random_field(3, 10, 10)
    H = M @ M.mT + torch.eye(10, dtype=torch.float64)
    b = random_field(3, 10, 1, 1, seed=1)
    result = conjugate_gradients(
        lambda x: (H @ x.flatten(1)[..., None])[..., None], lambda x: x, b, None, tol=1e-12, max_iter=100
    )
    assert result.converged.all()
    torch.testing.assert_close(result.x.flatten(1), torch.linalg.solve(H, b.flatten(1)), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("pixel_size", PIXELS, ids=str)
def test_harmonic_extension_is_the_smoothest_one(pixel_size):
    inside = MASKS["ring_and_islands"](20, 18)
    z = torch.where(inside, random_field(1, 1, 20, 18), torch.nan)
    with assert_unchanged(z, inside):
        u = harmonic_extension(z, inside, tol=1e-11, pixel_size=pixel_size)
    assert torch.equal(u[inside], z[inside])
    H, _ = normal_equations(torch.zeros(2, 20, 18).double(), None, None, None, pixel_size)
    outside = ~inside.numpy().ravel()
    np.testing.assert_allclose((H @ u.numpy().ravel())[outside], 0, atol=1e-8)


def test_weights_that_jump_by_many_orders_are_solved_exactly(generator):
    """Curves cut by 1e-8 through a mask: far too much for the cosine preconditioner; against SciPy's sparse solve."""
    n = 48
    y, x = torch.meshgrid(torch.linspace(-1, 1, n), torch.linspace(-1, 1, n), indexing="ij")
    mask = (x.square() + y.square() < 0.95)[None, None]
    side = (torch.sin(7 * x) + torch.cos(5 * y + x) > 0)[None, None]
    w = edge_slopes(mask.double().expand(-1, 2, -1, -1), mask)[1]
    cut = torch.zeros_like(w, dtype=torch.bool)
    cut[:, 0, :, :-1] = (side[..., 1:] ^ side[..., :-1])[:, 0]
    cut[:, 1, :-1] = (side[:, :, 1:] ^ side[:, :, :-1])[:, 0]
    w = torch.where(cut, 1e-8 * w, w)
    v = torch.randn(1, 2, n, n, generator=generator, dtype=torch.float64)
    found = solve(v, w, tol=1e-9)
    assert bool(found.converged.all())
    assert int(found.iterations) <= 3  # with the factor
    assert_solves(found.height, v, w, atol=1e-6)


def relief(n=64):
    """A quadratic far from 0, and its exact slopes at the pixels."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    z = 0.01 * (x - 32).square() - 0.02 * (y - 64 / 3).square() + 0.3 * x + 500
    return z, torch.stack([0.02 * (x - 32) + 0.3, -0.04 * (y - 64 / 3)])[None]


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("weight", [1e-9, 1e-5, 1.0, 1e4, 1e6, 1e12])
def test_anchors_of_any_weight_and_offset_do_not_swallow_the_tolerance(weight, offset):
    z, g = relief()
    r = torch.zeros(1, 1, 64, 64, dtype=torch.float64)
    r[..., 0] = weight
    found = solve(edge_slopes(g)[0], None, (z + offset)[None, None], r)
    assert bool(found.converged.all())
    assert float((found.height - offset - z).abs().max()) < 1e-5 * float(z.max() - z.min())


@pytest.mark.parametrize("weight", [1e-3, 1.0, 1e4, 1e12])
def test_firm_anchors_in_single_precision(weight):
    z, g = relief()
    r = torch.zeros(1, 1, 64, 64)
    r[..., 0] = weight
    found = solve(edge_slopes(g)[0].float(), None, (z - 500)[None, None].float(), r)
    assert float((found.height.double() + 500 - z).abs().max()) < 1e-5 * float(z.max() - z.min())


def test_one_weak_anchor_fixes_the_constant(generator):
    v = edge_slopes(torch.randn(1, 2, 40, 40, generator=generator, dtype=torch.float64))[0]
    r = torch.zeros(1, 1, 40, 40, dtype=torch.float64)
    r[0, 0, 7, 9] = 1e-5
    found = solve(v, None, torch.ones_like(r), r)
    expected = sparse_solve(v[0], None, torch.ones(40, 40, dtype=torch.float64), r[0])
    np.testing.assert_allclose(found.height[0, 0], expected, atol=1e-5 * np.ptp(expected))
    assert abs(float(found.height[0, 0, 7, 9]) - 1) < 1e-5


def test_the_derivative_in_a_firm_anchor_far_from_zero(generator):
    z, g = relief(12)
    r = torch.zeros(1, 1, 12, 12, dtype=torch.float64)
    r[..., 0] = 1e6
    probe = torch.randn(1, 1, 12, 12, generator=generator, dtype=torch.float64)
    v = edge_slopes(g)[0]

    def height(anchor, v):
        return (solve(v, None, anchor, r).height * probe).sum()

    anchor = (z + 1e3)[None, None]
    slopes = torch.autograd.functional.jacobian(height, (anchor, v))
    for i, direction in enumerate((torch.randn_like(anchor), torch.randn_like(v))):
        up, down = ([anchor, v], [anchor, v])
        up[i], down[i] = up[i] + direction, down[i] - direction
        expected = (height(*up) - height(*down)) / 2  # linear in both
        torch.testing.assert_close((slopes[i] * direction).sum(), expected, rtol=1e-4, atol=1e-4)
