"""Slopes given on the edges: against the sparse solve, with released edges, and what the methods make of them."""

import pytest
import torch

from tests.helpers import MASKS, assert_gradients, seeded, sparse_solve
from torchdls import DLS, L1, SURFACES, Bilateral, GradientOperator, Huber, LeastSquares, MEstimator, SlopeDLS
from torchdls.metrics import rmse
from torchdls.noise import edge_noise_if_told
from torchdls.operators import edge_slopes, present_edges

H, W = 12, 9
METHODS = [LeastSquares(), L1(), Huber(), MEstimator(), DLS(patch_size=4, n_iter=5)]


def slopes_and_trusts(seed=0, n=2):
    g = seeded(seed)
    v = torch.randn(n, 2, H, W, generator=g, dtype=torch.float64)
    return v, torch.rand(n, 2, H, W, generator=g, dtype=torch.float64) + 0.1


@pytest.mark.parametrize("pixel_size", [1.0, (0.5, 2.0)])
def test_least_squares_is_the_sparse_solve(pixel_size):
    v, w = slopes_and_trusts()
    w[0, 0, 3:6, 4] = 0  # released edges
    v[0, 0, 3:6, 4] = torch.nan  # which are never read
    v[..., 0, :, -1] = torch.inf  # nor are those that leave the image
    found = LeastSquares(tol=1e-12, pixel_size=pixel_size).from_edges(v, w)
    steps = (pixel_size, pixel_size) if isinstance(pixel_size, float) else pixel_size
    there = present_edges(w)
    v = torch.where((w * there) > 0, v, 0)
    for k in range(2):
        truth = torch.from_numpy(sparse_solve(v[k], (w * there)[k], pixel_size=steps))
        torch.testing.assert_close(found[k, 0], truth, atol=1e-8, rtol=1e-8)


def test_slopes_of_pixels_brought_to_the_edges_give_the_same_surface():
    g, _ = slopes_and_trusts(3)
    mask = MASKS["disk"](H, W)
    for kind in (None, mask):
        v, w = edge_slopes(g, None if kind is None else kind.expand(2, -1, -1, -1))
        expected = LeastSquares(tol=1e-12)(g, kind)
        torch.testing.assert_close(LeastSquares(tol=1e-12).from_edges(v, w, kind), expected, atol=1e-9, rtol=1e-9)
        torch.testing.assert_close(LeastSquares(tol=1e-12).from_edges(v, mask=kind), expected, atol=1e-9, rtol=1e-9)
    single = LeastSquares().from_edges(edge_slopes(g)[0][0])
    assert single.shape == (1, H, W)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_exact_slopes_give_the_surface_and_a_released_fault_its_two_sides(method):
    """A fault of 5 along a column, on whose edges no slope is known; one anchor on either side tells it."""
    z = SURFACES["peaks"](24, dtype=torch.float64).height
    z[..., 11:] += 5.0
    v = GradientOperator()(z)
    w = torch.ones_like(v)
    w[:, 0, :, 10] = 0
    v[:, 0, :, 10] = 1e3
    r = torch.zeros_like(z)
    r[..., 4, 4] = r[..., 4, 20] = 1.0
    found = method.from_edges(v, w, anchor=z, anchor_weight=r)
    torch.testing.assert_close(found, z, atol=2e-4 * float(z.std()), rtol=0)


@pytest.mark.parametrize("method", METHODS[1:4], ids=lambda m: type(m).__name__)
def test_wild_edges_do_no_harm_to_robust_methods(method):
    z = SURFACES["peaks"](32, dtype=torch.float64).height
    v = GradientOperator()(z) + 0.01 * torch.randn(1, 2, 32, 32, generator=seeded(1), dtype=torch.float64)
    v[:, 0, 5::7, 3::9] += 8.0
    plain, robust = (rmse(m.from_edges(v), z) for m in (LeastSquares(), method))
    assert robust < 0.2 * plain


def test_noise_on_edges_is_read_from_the_cells():
    w = torch.rand(1, 2, 96, 96, generator=seeded(5), dtype=torch.float64) + 0.2
    n = 0.3 * torch.randn(1, 2, 96, 96, generator=seeded(6), dtype=torch.float64)
    v = GradientOperator()(SURFACES["gaussians"](96, dtype=torch.float64).height)
    for trust, noise in ((None, n), (w, n * w.rsqrt())):
        sigma, told = edge_noise_if_told(v + noise, trust, (1.0, 1.0))
        assert bool(told)
        assert float(sigma) == pytest.approx(0.3, rel=0.03)


def test_dls_removes_noise_of_edges():
    z = SURFACES["saddle"](48, dtype=torch.float64).height
    v = GradientOperator()(z)
    v = v + v.std() * torch.randn(1, 2, 48, 48, generator=seeded(2), dtype=torch.float64)
    plain, found = (rmse(m.from_edges(v), z) for m in (LeastSquares(), DLS()))
    assert found < 0.97 * plain


def test_derivative():
    v, w = (t[:1, :, :5, :4] for t in slopes_and_trusts(4))
    assert_gradients(lambda v, w: LeastSquares(tol=1e-13).from_edges(v, w), v, w)


def test_errors_name_the_argument():
    v, w = slopes_and_trusts()
    with pytest.raises(ValueError, match="Bilateral: takes no slopes on edges"):
        Bilateral().from_edges(v)
    for method in (SlopeDLS(), LeastSquares(boundary="dirichlet"), DLS(data_term=Bilateral())):
        with pytest.raises(ValueError, match="takes no slopes on edges"):
            method.from_edges(v)
    with pytest.raises(ValueError, match=r"trust \(2, 2, 12, 8\) differ in width"):
        LeastSquares().from_edges(v, w[..., :-1])
    with pytest.raises(ValueError, match=r"trust .* is negative"):
        LeastSquares().from_edges(v, -w)
    with pytest.raises(ValueError, match=r"slopes .* are not finite"):
        LeastSquares().from_edges(v / 0)
