"""The solve (*) at every scale of slopes, weights, anchors and pixels, against closed forms and SciPy."""

import numpy as np
import pytest
import torch

from tests.fuzz.values import field, firm, mask, rational_solve, trust
from tests.helpers import MASKS, random_field, seeded, sparse_solve, uniform_field
from torchdls import INTEGRATORS, ConvergenceWarning, LeastSquares, edge_slopes, solve
from torchdls.solvers import conjugate_gradients

DTYPES = [torch.float64, torch.float32]
# Those whose minimum for exact slopes of a quadratic is the quadratic itself.
EXACT = ["least_squares", "weighted_least_squares", "total_variation", "l1", "huber", "m_estimator", "slope_dls"]


def relief(n=64):
    """A quadratic, and its exact slopes at the pixels."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    z = 0.01 * (x - 32).square() - 0.02 * (y - 64 / 3).square() + 0.3 * x
    return z[None, None], torch.stack([0.02 * (x - 32) + 0.3, -0.04 * (y - 64 / 3)])[None]


def error(height, z, mask=None):
    """Largest difference by the relief of z."""
    difference = (height.double() - z).abs()
    return float((difference if mask is None else difference[mask]).max() / (z.max() - z.min()))


def rounding(dtype, z):
    """What the dtype loses where heights of this size are written down, by their relief."""
    return 4 * torch.finfo(dtype).eps * float(z.abs().max() / (z.max() - z.min()))


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_anchors_of_any_weight_and_offset_by_every_method(name, dtype):
    z, g = relief(32)
    for weight in (1e-9, 1.0, 1e6, 1e12):
        for offset in (0.0, 1e6):
            r = torch.zeros(1, 1, 32, 32, dtype=dtype)
            r[..., 0] = weight
            truth = z + offset
            height = INTEGRATORS[name]()(g.to(dtype), anchor=truth.to(dtype), anchor_weight=r)
            assert error(height, truth) < max(1e-5, rounding(dtype, truth)), (weight, offset)


@pytest.mark.parametrize("weight", [1e-30, 1e-9, 1e-5, 1.0, 1e4, 1e12, 1e30])
@pytest.mark.parametrize("offset", [0.0, 500.0, 1e6])
def test_anchors_in_single_precision(weight, offset):
    z, g = relief()
    r = torch.zeros(1, 1, 64, 64)
    r[..., 0] = weight
    found = solve(edge_slopes(g)[0].float(), None, (z + offset).float(), r)
    assert bool(found.converged.all())
    assert error(found.height, z + offset) < max(1e-5, rounding(torch.float32, z + offset))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_anchors_of_very_different_weights_at_once(dtype):
    z, g = relief()
    r = torch.zeros(1, 1, 64, 64, dtype=dtype)
    r[..., 0], r[..., -1], r[0, 0, 30, 30] = 1e6, 1e-6, 1e12
    assert error(solve(edge_slopes(g)[0].to(dtype), None, (z + 500).to(dtype), r).height, z + 500) < 1e-5


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("firm", [1e3, 1e8, 1e12])
def test_firm_anchors_where_every_pixel_is_held(firm, dtype):
    """As in the height step of DLS: what firm anchors weigh must not swallow the tolerance of the rest."""
    z, g = relief(32)
    r = torch.full_like(z, 0.5)
    r[..., 0] = firm
    anchor = z + random_field(1, 1, 32, 32, seed=3)
    height = solve(edge_slopes(g)[0].to(dtype), None, anchor.to(dtype), r.to(dtype)).height
    expected = torch.from_numpy(sparse_solve(edge_slopes(g)[0][0], None, anchor[0], r[0]))[None, None]
    assert error(height, expected) < 1e-5


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_metres(dtype):
    """Pixels of .01 mm, a surface .25 m away."""
    z, g = relief()
    truth = z * 1e-5 + 0.25
    r = torch.zeros(1, 1, 64, 64, dtype=dtype)
    r[..., 0] = 1.0
    height = solve(edge_slopes(g)[0].to(dtype), None, truth.to(dtype), r, pixel_size=1e-5).height
    assert error(height, truth) < max(1e-5, rounding(dtype, truth))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("anchored", [False, True])
@pytest.mark.parametrize("ratio", [1e-6, 1e6])
def test_each_component_keeps_the_tolerance_of_its_own_range(ratio, anchored, dtype):
    z, g = relief()
    inside = torch.ones(1, 1, 64, 64, dtype=torch.bool)
    inside[..., 30] = False
    scale = torch.ones(64, dtype=torch.float64)
    scale[31:] = ratio
    truth, r, anchor = z * scale, None, None
    if anchored:
        r = torch.zeros(1, 1, 64, 64, dtype=dtype)
        r[..., 0], r[..., -1], anchor = 1.0, 1e-6, truth.to(dtype)
    height = solve(*edge_slopes((g * scale).to(dtype), inside), anchor, r).height.double()
    for part in (slice(0, 30), slice(31, 64)):
        found, wanted = height[..., part], truth[..., part]
        if not anchored:
            wanted = wanted - wanted.mean()
        assert error(found, wanted) < 1e-5


@pytest.mark.parametrize(
    "dtype, scale",
    [(torch.float32, s) for s in (1e-38, 1e-24, 1e30)] + [(torch.float64, s) for s in (1e-300, 1e78, 1e300)],
    ids=str,
)
def test_slopes_and_weights_of_any_scale(dtype, scale):
    z, g = relief()
    inside = MASKS["disk"](64, 64)
    truth = z - z[inside].mean()
    v, w = edge_slopes(g.to(dtype), inside)
    assert error(solve(v, scale * w).height, truth, inside) < 1e-5
    assert error(solve(scale * v, w).height.double() / scale, truth, inside) < 1e-5
    r = torch.zeros(1, 1, 64, 64, dtype=dtype)
    r[..., 0] = scale
    assert error(solve(edge_slopes(g.to(dtype))[0], None, z.to(dtype), r).height, z) < 1e-5


@pytest.mark.parametrize("dtype, weight", [(torch.float32, 1e-42), (torch.float64, 1e-320)], ids=str)
def test_denormal_anchor_weights(dtype, weight):
    z, g = relief()
    r = torch.zeros(1, 1, 64, 64, dtype=dtype)
    r[..., 0] = weight
    assert error(solve(edge_slopes(g)[0].to(dtype), None, z.to(dtype), r).height, z) < 1e-5


@pytest.mark.parametrize("r", [1e-42, 1e-9, 1.0])
def test_one_weak_weight_for_a_whole_rectangle(r):
    """The mean is that of the anchors; so weak, they bend nothing."""
    z, g = relief()
    noise = random_field(1, 1, 64, 64)
    v = edge_slopes(g)[0]
    found = solve(v.float(), None, (z + noise).float(), r).height
    expected = solve(v, None, z + noise, r).height
    assert error(found, expected) < 1e-5
    assert float(found.double().mean()) == pytest.approx(float((z + noise).mean()), abs=1e-4)


@pytest.mark.parametrize("mask", ["disk", "sieve"])
def test_a_ripple_on_a_steep_tilt(mask):
    """What float32 can hold of it: two units in the last place of heights up to 3200."""
    y, x = torch.meshgrid(*(torch.arange(64, dtype=torch.float64),) * 2, indexing="ij")
    inside = MASKS[mask](64, 64)
    along, down = 0.5 * torch.cos(0.5 * x) * torch.cos(0.4 * y), -0.4 * torch.sin(0.5 * x) * torch.sin(0.4 * y)
    g = 5e-3 * torch.stack([along, down])
    v, w = edge_slopes(g[None], inside)
    ripple = solve(v, w, tol=1e-13).height
    tilt = torch.tensor([100.0, 0.0], dtype=torch.float64).view(1, 2, 1, 1) * (w > 0)
    plane = solve(tilt, w, tol=1e-13).height
    assert float((solve(v + tilt, w, tol=1e-9).height - plane - ripple).abs().max()) < 1e-5 * 5e-3
    single = (v + tilt).float()
    expected = solve(single.double(), w, tol=1e-13).height
    assert float((solve(single, w.float()).height - expected).abs().max()) < 5e-4


def test_a_height_beyond_its_dtype_raises():
    v, w = edge_slopes(torch.full((1, 2, 32, 32), 1e38), MASKS["disk"](32, 32))
    with pytest.raises(ValueError, match="solve: the height is not finite"):
        solve(v, w)
    with pytest.raises(ValueError, match="not finite"):
        LeastSquares()(torch.full((1, 2, 32, 32), 1e38))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_derivatives_in_weak_anchors(dtype):
    """With one anchor, heights follow it as a whole and do not depend on its weight."""
    v = edge_slopes(random_field(1, 2, 12, 12))[0].to(dtype).requires_grad_()
    r = torch.zeros(1, 1, 12, 12, dtype=dtype)
    r[0, 0, 3, 4] = 1e-9
    anchor = torch.ones_like(r).requires_grad_()
    probe = torch.rand(1, 1, 12, 12, dtype=torch.float64, generator=seeded(1)).to(dtype)
    (solve(v, None, anchor, r, tol=1e-7).height * probe).sum().backward()
    free = v.detach().clone().requires_grad_()
    height = solve(free).height
    ((height - height[0, 0, 3, 4]) * probe).sum().backward()
    assert float(anchor.grad[0, 0, 3, 4]) == pytest.approx(float(probe.sum()), rel=1e-5)
    torch.testing.assert_close(v.grad, free.grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype, limit", [(torch.float64, 2e-6), (torch.float32, 1e-5)], ids=str)
@pytest.mark.parametrize("orders", [1, 2, 3, 4])
def test_the_tolerance_holds_for_weights_that_vary(orders, dtype, limit):
    """Where residuals alone, met to 1e-6, left errors of .2 contrast tol: 1.2e-3 at 10^3.9."""
    for seed in range(4):
        u = uniform_field(1, 2, 4, 4, seed=seed)
        for exponent in (u[:, :, :1].expand(1, 2, 4, 4), (u < 0.5).double()):
            v, w = random_field(1, 2, 4, 4, seed=seed).to(dtype), (10 ** (-orders * exponent)).to(dtype)
            w[:, 0, :, -1] = w[:, 1, -1] = 0
            r = torch.zeros(1, 1, 4, 4, dtype=dtype)
            r[..., seed % 4, seed % 3] = 1.0
            for given in ((None, None), (torch.zeros_like(r), r)):
                exact = torch.from_numpy(sparse_solve(v[0], w[0], *(None if t is None else t[0] for t in given)))
                found = solve(v, w, *given)
                assert bool(found.converged.all())
                assert error(found.height[0, 0], exact) < limit, (seed, given)


@pytest.mark.parametrize("kind", ["mask", "weight", "anchor"])
def test_gradcheck_at_the_tolerance_that_is_documented(kind):
    inside = torch.ones(1, 1, 4, 4, dtype=torch.bool)
    inside[..., 0, 0] = inside[..., 2, 2] = False
    weight = None if kind == "mask" else random_field(1, 2, 4, 4, seed=1).exp()
    r = random_field(1, 1, 4, 4, seed=2).exp() * 1e-6 if kind == "anchor" else None
    anchor = None if r is None else random_field(1, 1, 4, 4, seed=3)
    given = [t.requires_grad_() for t in (random_field(1, 2, 4, 4), weight, anchor) if t is not None]

    def height(g, *rest):
        weight, anchor = (*rest, None, None)[:2]
        return LeastSquares(tol=1e-12)(g, inside, weight, anchor, r)

    assert torch.autograd.gradcheck(height, given)


def test_components_held_and_free_against_scipy():
    inside = MASKS["ring_and_islands"](40, 40)
    v, w = edge_slopes(random_field(1, 2, 40, 40), inside)
    r = (torch.rand(1, 1, 40, 40, generator=seeded(5)) < 0.01) * inside * 1e-4
    r = r.double()
    anchor = 100 + random_field(1, 1, 40, 40, seed=2)
    height = solve(v, w, anchor, r, tol=1e-10).height
    expected = sparse_solve(v[0], w[0], anchor[0], r[0])
    np.testing.assert_allclose(height[0, 0], expected, atol=1e-6)


def test_conjugate_gradients_never_end_worse_than_they_began():
    """An indefinite system, which they must not be asked: steps go uphill."""
    A = torch.diag(torch.tensor([1.0, -1.0, 1e-3], dtype=torch.float64))
    b = torch.tensor([[1.0, 1.0 + 1e-9, 1.0]], dtype=torch.float64)
    for x0 in (None, torch.full_like(b, 1e9)):
        found = conjugate_gradients(lambda x: x @ A, lambda x: x.clone(), b, x0, tol=1e-8, max_iter=1)
        assert float((b - found.x @ A).norm()) <= float(b.norm()) * (1 + 1e-12)
        assert not bool(found.converged.any())


def far_apart(orders, seed, dtype):
    """Noise on 3 x 4 pixels, with weights so many orders apart, and the exact solution."""
    u = torch.rand(1, 2, 3, 4, dtype=torch.float64, generator=seeded(seed))
    v, w = random_field(1, 2, 3, 4, seed=seed + 100).to(dtype), (10 ** (orders * (u - 0.5))).to(dtype)
    w[:, 0, :, -1] = w[:, 1, -1] = 0
    return v, w, rational_solve(v[0], w[0], None, None)[None]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("orders", [3, 6, 9, 14, 21])
def test_weights_of_edges_far_apart(orders, dtype):
    """The tolerance of the firm edges used to swallow the slopes on weak ones: a third of the relief was missing."""
    for seed in range(10):
        v, w, exact = far_apart(orders, seed, dtype)
        found = solve(v, w)
        assert bool(found.converged.all())
        assert error(found.height, exact) < 1e-5
        spoilt = w.clone()
        spoilt[:, 0, :, -1] = spoilt[:, 1, -1] = 1e20  # edges that are not there
        assert torch.equal(solve(v, spoilt).height, found.height)


@pytest.mark.parametrize(
    "shape, slopes, weights, held, chosen, firmness, offset",
    [((3, 4), 428170, 104550, "one", 41, 10.0, 1e6), ((2, 5), 515879, 394098, "some", 762, 1e3, 500.0)],
)
def test_firm_anchors_beside_weights_far_apart(shape, slopes, weights, held, chosen, firmness, offset):
    """Forces lose in rounding what weak edges say: off by .09 and .38 of the relief, and counted as converged."""
    v, w = field(1, 2, *shape, kind="waves", seed=slopes), trust(1, 2, *shape, kind="orders", seed=weights)
    r = firm(mask(1, *shape), held, chosen, firmness)
    anchor = torch.full_like(r, offset)
    w[:, 0, :, -1] = w[:, 1, -1] = 0
    found = solve(v, w, anchor, r)
    assert bool(found.converged.all())
    assert error(found.height, rational_solve(v[0], w[0], anchor[0], r[0])[None]) < 1e-8


def test_derivatives_where_weights_are_far_apart():
    """By slopes, from solutions for single slopes in rational numbers: heights are linear in them."""
    v, w, _ = far_apart(16, 3, torch.float64)
    r, anchor = firm(mask(1, 3, 4), "some", 5, 1e-3), random_field(1, 1, 3, 4, seed=7)
    probe = random_field(1, 1, 3, 4, seed=8)
    given, single = v.clone().requires_grad_(), torch.eye(v.numel(), dtype=torch.float64).view(-1, *v.shape[1:])
    (solve(given, w, anchor, r).height * probe).sum().backward()
    exact = torch.stack([(rational_solve(one, w[0], 0 * anchor[0], r[0]) * probe[0]).sum() for one in single])
    torch.testing.assert_close(given.grad.flatten(), exact, rtol=0, atol=1e-12)
    weight = w.clone().requires_grad_()
    (solve(v, weight, anchor, r).height * probe).sum().backward()
    for i in w.flatten().nonzero()[::4, 0]:
        change = torch.zeros_like(w).flatten()
        change[i] = 1e-3 * w.flatten()[i]
        up, down = (
            (rational_solve(v[0], (w + t * change.view_as(w))[0], anchor[0], r[0]) * probe[0]).sum() for t in (1, -1)
        )
        assert float(weight.grad.flatten()[i] * 2 * change[i]) == pytest.approx(float(up - down), rel=1e-4, abs=1e-12)


def test_weights_beyond_what_two_numbers_hold_warn():
    for orders in (40, 300):
        v, w = random_field(2, 2, 3, 4), torch.ones(2, 2, 3, 4, dtype=torch.float64)
        w[1, :, :, :2] = 10.0**-orders
        with pytest.warns(ConvergenceWarning, match="1 of 2 surfaces"):
            found = solve(v, w)
        assert found.converged.tolist() == [True, False]
        assert bool(found.height.isfinite().all())


def test_conjugate_gradients_return_about_the_best_iterate():
    """On an ill-conditioned system residuals swing by orders: where the limit falls must not matter."""
    scale = torch.logspace(0, 4, 40, dtype=torch.float64)
    turn = torch.linalg.qr(random_field(40, 40))[0]
    A = turn @ torch.diag(scale) @ turn.mT
    b = random_field(1, 40, seed=1) @ A
    least, swing = float(b.norm()), 1.0
    for limit in range(1, 80):
        found = conjugate_gradients(lambda x: x @ A, lambda x: x.clone(), b, None, tol=1e-14, max_iter=limit)
        residual = float(found.residual * b.norm())
        least = min(least, residual)
        swing = max(swing, residual / least)
    assert 1 < swing <= 10
