"""The robust integrators against SciPy, brute force, and what outliers and jumps do to least squares."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import linprog, minimize
from torch import Tensor

from tests.helpers.fields import MASKS, random_field, seeded
from tests.helpers.methods import ROBUST, promising
from torchdls import (
    DLS,
    INTEGRATORS,
    L1,
    SURFACES,
    AnisotropicDiffusion,
    EdgePreserving,
    Exact,
    Huber,
    LeastSquares,
    MEstimator,
    MumfordShah,
    TotalVariation,
    WeightedLeastSquares,
    add_noise,
    rmse,
)
from torchdls.integrators.robust.convex import shrink


@pytest.fixture(params=ROBUST)
def make(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """A robust integrator, as a function of its options."""
    name, options = ROBUST[request.param]
    promising(name, request.node.originalname.removeprefix("test_"), request.param)
    return partial(INTEGRATORS[name], **options)


def residual_rows(g: Tensor, mask: Tensor | None = None, weight: Tensor | None = None):
    """The residuals of one field by plain loops: (pixel, direction, stencil side) -> row of K, slope, trust."""
    _, h, w = g.shape
    inside = np.ones((h, w), bool) if mask is None else mask[0].numpy()
    trust = np.ones((2, h, w)) if weight is None else np.broadcast_to(weight.numpy(), (2, h, w))
    rows = {}
    for i in range(h):
        for j in range(w):
            for c, (di, dj) in enumerate(((0, 1), (1, 0))):
                for side in (1, -1):
                    a, b = i + side * di, j + side * dj
                    if 0 <= a < h and 0 <= b < w and inside[i, j] and inside[a, b] and trust[c, i, j] > 0:
                        row = np.zeros(h * w)
                        row[a * w + b] += side
                        row[i * w + j] -= side
                        rows[i, j, c, side] = row, float(g[c, i, j]), trust[c, i, j]
    return rows


def stack(rows):
    k, v, t = zip(*rows.values(), strict=True)
    return np.array(k), np.array(v), np.array(t)


def small_problem(masked: bool, weighted: bool, channels: int = 2):
    g = random_field(2, 6, 7, seed=3)
    g[0, 2, 3] += 20
    mask = torch.ones(1, 6, 7, dtype=torch.bool)
    mask[0, 1:3, 4] = False
    mask[0, 5, :2] = False
    weight = 0.2 + random_field(channels, 6, 7, seed=4).square()
    weight[:, 0, 0] = 0
    return g, mask if masked else None, weight if weighted else None


@pytest.mark.parametrize("masked, weighted", [(False, False), (True, True)])
def test_l1_is_the_linear_program(masked, weighted):
    g, mask, weight = small_problem(masked, weighted)
    k, v, t = stack(residual_rows(g, mask, weight))
    m, n = k.shape
    cost = np.concatenate([np.zeros(n), t])
    eye = np.eye(m)
    bounds = [(None, None)] * n + [(0, None)] * m
    lp = linprog(cost, np.block([[k, -eye], [-k, -eye]]), np.concatenate([v, -v]), bounds=bounds)
    n_iter, close = (200, 2e-2) if masked else (1000, 2e-3)  # without a mask, the solves are direct
    z = L1(smoothing=0, n_iter=n_iter, tol=0, solve_tol=1e-8)(g, mask, weight)
    assert t @ np.abs(k @ z.flatten().numpy() - v) == pytest.approx(lp.fun, rel=close)


def smooth_minimum(cost, n: int) -> np.ndarray:
    return minimize(cost, np.zeros(n), jac=True, method="BFGS", options={"gtol": 1e-9, "maxiter": 5000}).x


def center(z: np.ndarray, mask: Tensor | None) -> np.ndarray:
    inside = np.ones(z.shape, bool) if mask is None else mask.flatten().numpy()
    return np.where(inside, z - z[inside].mean(), 0)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_huber_is_the_minimum_that_scipy_finds(masked, weighted):
    g, mask, weight = small_problem(masked, weighted)
    k, v, t = stack(residual_rows(g, mask, weight))
    delta = 0.7

    def cost(z):
        r = k @ z - v
        big = np.abs(r) > delta
        return t @ np.where(big, delta * np.abs(r) - delta**2 / 2, r**2 / 2), k.T @ (t * np.clip(r, -delta, delta))

    result = Huber(delta, n_iter=300, tol=1e-11, solve_tol=1e-9).solve(
        g[None], *(None if f is None else f[None] for f in (mask, weight))
    )
    expected = smooth_minimum(cost, k.shape[1])
    assert result.converged.all()
    assert float(result.objective[0, -1]) == pytest.approx(cost(expected)[0] / 2, rel=1e-9)
    if not weighted:  # else a pixel of weight 0 may be loose
        np.testing.assert_allclose(result.height.flatten().numpy(), center(expected, mask), atol=2e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_total_variation_is_the_minimum_that_scipy_finds(masked):
    g, mask, weight = small_problem(masked, True, channels=1)
    rows = residual_rows(g, mask, weight)
    absent = np.zeros(42), 0.0, 0.0
    sides = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    pairs = [[rows.get((i, j, c, s[c]), absent) for c in (0, 1)] for i in range(6) for j in range(7) for s in sides]
    k, v, t = (np.array([[row[part] for row in pair] for pair in pairs]) for part in range(3))
    t = t.max(1)
    method = TotalVariation(n_iter=300, tol=1e-11, solve_tol=1e-9)
    fields = method._check_fields(g[None], *(None if f is None else f[None] for f in (mask, weight)))
    penalty = method._data_term(fields)
    strength, corner = float(penalty.strength), float(penalty.corner)

    def cost(z):
        r = k @ z - v
        n = np.linalg.norm(r, axis=1)
        phi = np.where(n > corner, n - corner / 2, n**2 / (2 * corner))
        slope = np.einsum("g,gcn,gc->n", t / np.maximum(n, corner), k, r)
        return strength / 4 * t @ phi, strength / 4 * slope

    expected = smooth_minimum(cost, g[0].numel())
    result = method.solve(g[None], fields.mask, fields.weight)
    assert float(result.objective[0, -1]) == pytest.approx(cost(expected)[0], rel=1e-8)


@pytest.mark.parametrize("method", [Huber(0.5), L1(), TotalVariation()], ids=["huber", "l1", "tv"])
def test_anchors_and_pixel_size_reach_a_stationary_point(method):
    """At the minimum, the derivative of the returned objective vanishes."""
    g, mask, weight = small_problem(True, True, channels=1)
    anchor, trust = random_field(1, 6, 7, seed=6), random_field(1, 6, 7, seed=7).square()
    method.n_iter, method.tol, method.solve_tol, method.pixel_size = 300, 1e-12, 1e-8, (0.5, 1.5)
    fields = method._check_fields(*(None if f is None else f[None] for f in (g, mask, weight, anchor, trust)))
    z = method._integrate(fields).requires_grad_()
    cost = method._data_term(fields).cost(z) + (fields.anchor_weight * (z - fields.anchor).square()).sum() / 2
    (slope,) = torch.autograd.grad(cost.sum(), z)
    assert slope.abs().max() < 1e-4


@pytest.mark.parametrize("step", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("corner", [0.0, 0.5])
def test_shrink_by_brute_force(step, corner):
    x = torch.linspace(-3, 3, 25, dtype=torch.float64)
    d = torch.linspace(-3.5, 3.5, 70001, dtype=torch.float64)[:, None]
    n = d.abs()
    phi = torch.where(n < corner, n.square() / (2 * max(corner, 1e-9)), n - corner / 2)
    best = d[(step * phi + (d - x).square() / 2).argmin(0), 0]
    step, corner = (torch.tensor(t, dtype=torch.float64) for t in (step, corner))
    torch.testing.assert_close(shrink(x, x.abs(), step, corner), best, atol=1e-4, rtol=0)


def test_shrink_of_vectors_by_brute_force():
    x = torch.tensor([1.2, -0.9], dtype=torch.float64)
    axis = torch.linspace(-2, 2, 2001, dtype=torch.float64)
    d = torch.cartesian_prod(axis, axis)
    n = d.norm(dim=1)
    phi = torch.where(n < 0.2, n.square() / 0.4, n - 0.1)
    best = d[(0.6 * phi + (d - x).square().sum(1) / 2).argmin()]
    step, corner = (torch.tensor(t, dtype=torch.float64) for t in (0.6, 0.2))
    torch.testing.assert_close(shrink(x, x.norm(), step, corner), best, atol=2e-3, rtol=0)


@pytest.mark.parametrize("mask", [None, "sieve"])
def test_majoriser_touches_and_is_nowhere_below(make, mask):
    method = make(pixel_size=(0.8, 1.25))
    mask = None if mask is None else MASKS[mask](9, 10)
    weight = random_field(1, 1, 9, 10, seed=1).square()
    fields = method._check_fields(random_field(1, 2, 9, 10), mask, weight)
    z0 = random_field(1, 1, 9, 10, seed=5)
    v, w = method._data_term(fields).majoriser(z0)

    def quadratic(z):
        slopes = torch.zeros_like(v)
        slopes[:, 0, :, :-1] = z[:, 0].diff(dim=-1) / 0.8
        slopes[:, 1, :-1] = z[:, 0].diff(dim=-2) / 1.25
        return (w * (slopes - v).square()).sum((1, 2, 3)) / 2

    h = method._unit
    assert h == pytest.approx(1.0)
    base = method._data_term(fields).cost(z0) - quadratic(z0)
    for seed in range(20):
        z = z0 + 10.0 ** (seed % 4 - 2) * random_field(1, 1, 9, 10, seed=10 + seed)
        above = quadratic(z) + base - method._data_term(fields).cost(z)
        assert above > -1e-8
    small = z0 + 1e-7 * random_field(1, 1, 9, 10, seed=99)
    torch.testing.assert_close(quadratic(small) + base, method._data_term(fields).cost(small), rtol=0, atol=1e-9)


def test_reweighting_never_raises_the_objective(make):
    g = add_noise(SURFACES["vase"](32, dtype=torch.float64).gradient, snr_db=10, generator=seeded(0))
    g[..., 10:20, 16] += 5
    result = make(tol=0, n_iter=8, solve_tol=1e-7).solve(g)
    assert result.objective.shape == (1, 9)
    assert (result.objective.diff(dim=1) <= 1e-9 * result.objective[:, :1]).all()
    assert result.objective[0, -1] < result.objective[0, 0]


def test_outliers_do_little_harm(make):
    surface = SURFACES["vase"](32, dtype=torch.float64)
    g = add_noise(surface.gradient, snr_db=25, generator=seeded(0))
    bad = torch.rand(g.shape, generator=seeded(1)) < 0.05
    g = torch.where(bad, g + 20 * random_field(*g.shape, seed=2), g)
    error = rmse(make()(g), surface.height)
    assert error < 0.25 * rmse(LeastSquares()(g), surface.height)


def test_jumps_do_little_harm(make):
    """A wrong wall of slopes, as along an occluding contour."""
    surface = SURFACES["vase"](32, dtype=torch.float64)
    g = add_noise(surface.gradient, snr_db=25, generator=seeded(0))
    g[:, 0, 5:27, 16] += 20
    assert rmse(make()(g), surface.height) < 0.06 * rmse(LeastSquares()(g), surface.height)


def test_weighted_least_squares_distrusts_the_curl():
    surface = SURFACES["vase"](32, dtype=torch.float64)
    g = add_noise(surface.gradient, snr_db=25, generator=seeded(0))
    g[0, :, 10::12, 10::12] += 20
    assert rmse(WeightedLeastSquares()(g), surface.height) < 0.2 * rmse(LeastSquares()(g), surface.height)
    method = WeightedLeastSquares()
    w = method._data_term(method._check_fields(surface.gradient.new_ones(1, 2, 5, 6))).w  # a plane is all integrable
    torch.testing.assert_close(w[:, 0, :, :-1], torch.full_like(w[:, 0, :, :-1], 1.03))
    assert (w[:, 0, :, -1] == 0).all()
    assert (w[:, 1, -1] == 0).all()


@pytest.mark.slow
def test_total_variation_is_within_one_percent_soon():
    g = add_noise(SURFACES["tent"](16, dtype=torch.float64).gradient, snr_db=10, generator=seeded(0))
    g[:, 0, 3:13, 8] += 20
    reference = TotalVariation(n_iter=2000, tol=0).solve(g).objective[0, -1]
    result = TotalVariation().solve(g)
    assert result.iterations <= 100
    assert result.objective[0, -1] <= 1.01 * reference


def test_each_surface_stops_on_its_own(make):
    g = torch.cat([SURFACES[s](12, dtype=torch.float64).gradient for s in ("tent", "vase")])
    g = g + 0.05 * random_field(*g.shape)
    g[1, 0, 3:9, 8] += 10
    both = make().solve(g)
    for i in range(2):
        alone = make().solve(g[i : i + 1])
        assert both.iterations[i] == alone.iterations[0]
        torch.testing.assert_close(both.height[i], alone.height[0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(both.objective[i, -1], alone.objective[0, -1])


def test_plane_is_exact(make):
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (7, 9)), indexing="ij")
    z = (2 * x - 3 * y)[None, None]
    g = torch.stack([torch.full_like(x, 2 / 0.5), torch.full_like(x, -3 / 2.0)])[None]
    result = make(pixel_size=(0.5, 2.0), solve_tol=1e-12).solve(g)
    assert result.converged.all()
    torch.testing.assert_close(result.height, z - z.mean(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("mask", [None, "disk"])
def test_dls_with_it_never_raises_its_objective(make, mask):
    check_descent(make(), mask)


@pytest.mark.parametrize("mask", [None, "disk"])
def test_dls_with_weighted_least_squares_never_raises_its_objective(mask):
    check_descent(WeightedLeastSquares(), mask)


def check_descent(data_term, mask):
    g = add_noise(SURFACES["tent"](24, dtype=torch.float64).gradient, snr_db=8, generator=seeded(0))
    g[:, 1, 12, 5:15] += 3
    model = DLS(stride=4, data_term=data_term, tol=0, n_iter=3, lam=0.5, mu=0.2, height_step=Exact(1e-9))
    objective = model.solve(g, None if mask is None else MASKS[mask](24, 24)).objective
    assert (objective.diff(dim=1) <= 1e-9 * objective[:, :1]).all()
    assert objective[0, -1] < objective[0, 0]


def test_derivatives_of_the_iterations_run(make):
    method = make(n_iter=2, tol=0, solve_tol=1e-13)
    mask = MASKS["sieve"](5, 6)
    g, weight = random_field(1, 2, 5, 6), 0.5 + random_field(1, 1, 5, 6, seed=1).square()
    anchor, trust = random_field(1, 1, 5, 6, seed=2), random_field(1, 1, 5, 6, seed=3).square()
    inputs = [t.requires_grad_() for t in (g, weight, anchor, trust)]
    assert torch.autograd.gradcheck(lambda g, *rest: method(g, mask, *rest), inputs, fast_mode=True)


def test_derivative_of_weighted_least_squares():
    method = WeightedLeastSquares(tol=1e-13)
    mask = MASKS["sieve"](5, 6)
    g, weight = random_field(1, 2, 5, 6), 0.5 + random_field(1, 2, 5, 6, seed=1).square()
    inputs = [t.requires_grad_() for t in (g, weight)]
    assert torch.autograd.gradcheck(lambda g, weight: method(g, mask, weight), inputs, fast_mode=True)


@pytest.mark.parametrize("masked", [False, True])
def test_anisotropic_diffusion_is_the_dense_solution(masked):
    g, mask, weight = small_problem(masked, True, channels=1)
    method = AnisotropicDiffusion(contrast=0.7, follow="field", n_iter=200, tol=1e-15, solve_tol=1e-11)
    fields = method._check_fields(g[None], *(None if f is None else f[None] for f in (mask, weight)))
    tensors = method._tensors(fields)
    (xx, yy), xy = tensors.diagonal[0, 0].numpy(), tensors.mixed[0, 0, 0].numpy()
    assert np.abs(xy).max() > 0.2  # else the diagonal alone would do
    rows = residual_rows(g, mask, weight)
    absent = np.zeros(42), 0.0, 0.0
    H, b = np.zeros((42, 42)), np.zeros(42)
    for i in range(6):
        for j in range(7):
            for sides in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                (kx, gx, tx), (ky, gy, ty) = (rows.get((i, j, c, s), absent) for c, s in enumerate(sides))
                K, T = np.array([kx, ky]), np.array([[xx[i, j], xy[i, j]], [xy[i, j], yy[i, j]]])
                H += max(tx, ty) * K.T @ T @ K / 4
                b += max(tx, ty) * K.T @ T @ (gx, gy) / 4
    z = method(g[None], fields.mask, fields.weight).flatten().numpy()
    np.testing.assert_allclose(H @ z, b, atol=1e-6)


def test_diffusion_tensors():
    """Eigenvalue 1 along an edge and nearly beta across it; no direction where there is no edge."""
    g = torch.zeros(1, 2, 9, 9, dtype=torch.float64)
    g[:, :, 4, 4] = 5 * torch.tensor([0.6, 0.8], dtype=torch.float64)
    method = AnisotropicDiffusion(beta=0.02, follow="field")
    tensors = method._tensors(method._check_fields(g))
    (xx, yy), xy = tensors.diagonal[0, 0, :, 4, 4], tensors.mixed[0, 0, 0, 4, 4]
    T = torch.stack([torch.stack([xx, xy]), torch.stack([xy, yy])])
    across, along = (torch.tensor(e, dtype=torch.float64) for e in ((0.6, 0.8), (-0.8, 0.6)))
    torch.testing.assert_close(T @ along, along)
    torch.testing.assert_close(T @ across, 0.02 * across, rtol=0, atol=1e-4)
    torch.testing.assert_close(tensors.diagonal[0, 0, :, 0, 0], torch.ones(2, dtype=torch.float64))


def test_indicator_marks_the_jump():
    surface = SURFACES["vase"](32, dtype=torch.float64)
    g = add_noise(surface.gradient, snr_db=30, generator=seeded(0))
    g[:, 0, 5:27, 16] += 20
    method = MumfordShah()
    s = method.indicator(method(g), g)
    assert s.shape == (1, 1, 32, 32)
    assert (s[..., 5:27, 16] < 0.2).all()
    assert s.median() > 0.9


@pytest.mark.parametrize("bad", [
    lambda: TotalVariation(smoothing=-1),
    lambda: L1(n_iter=2.5),
    lambda: Huber(delta=0),
    lambda: MEstimator("lorentz"),
    lambda: MEstimator(floor=0),
    lambda: MEstimator(scale="big"),
    lambda: MumfordShah(width=-1),
    lambda: WeightedLeastSquares(threshold=0),
    lambda: Huber(tol=-1),
    lambda: AnisotropicDiffusion(beta=0),
    lambda: AnisotropicDiffusion(follow="height"),
    lambda: MumfordShah(indicators=2),
    lambda: EdgePreserving(lam=-1),
])  # fmt: skip
def test_bad_options(bad):
    with pytest.raises(
        ValueError, match=r"smoothing|n_iter|delta|loss|floor|scale|width|threshold|tol|beta|follow|indic|lam"
    ):
        bad()


def test_a_sharp_corner_is_no_data_term():
    with pytest.raises(ValueError, match="smoothing=0"):
        DLS(4, data_term=TotalVariation(smoothing=0))(random_field(1, 2, 6, 6))


def test_total_variation_takes_the_mean_of_two_weights():
    g, weight = random_field(1, 2, 6, 6), random_field(1, 2, 6, 6, seed=1).square()
    found, expected = (
        TotalVariation(n_iter=300, tol=1e-10)(g, weight=w) for w in (weight, weight.mean(1, keepdim=True))
    )
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)


def test_callback_reports_every_iteration():
    seen = []
    result = L1(n_iter=4, tol=0).solve(random_field(2, 2, 6, 6), callback=lambda i, f: seen.append((i, f)))
    assert [i for i, _ in seen] == [1, 2, 3, 4]
    torch.testing.assert_close(torch.stack([f for _, f in seen], 1), result.objective[:, 1:])


@pytest.mark.parametrize("make", [L1, TotalVariation, Huber])
def test_two_parts_in_single_precision(make):
    """A warm start outside the range of a singular system must not be taken for progress."""
    y, x = torch.meshgrid(torch.arange(96.0) - 48, torch.arange(96.0) - 40, indexing="ij")
    z = (0.01 * x.square() - 0.02 * y.square() + 0.3 * x)[None, None]
    mask = torch.ones(1, 1, 96, 96, dtype=torch.bool)
    mask[..., 48] = False
    height = make()(torch.stack([0.02 * x + 0.3, -0.04 * y])[None], mask=mask)
    for part in (slice(0, 48), slice(49, 96)):
        truth = z[..., part] - z[..., part].mean()
        assert float((height[..., part] - truth).abs().max()) < 0.02 * float(truth.abs().max())


@pytest.mark.parametrize("masked", [False, True])
def test_trusts_that_follow_the_surface_are_at_rest(masked):
    """Where the iteration stands still, the dense normal equations with the trusts of that surface hold."""
    g, mask, weight = small_problem(masked, True, channels=1)
    g[0, 2, 3] -= 18  # gentle enough for the iteration to settle
    method = AnisotropicDiffusion(contrast=1.5, n_iter=400, tol=0, solve_tol=1e-12)
    fields = method._check_fields(g[None], *(None if f is None else f[None] for f in (mask, weight)))
    z = method(g[None], fields.mask, fields.weight).flatten().numpy()
    rows, absent = residual_rows(g, mask, weight), (np.zeros(42), 0.0, 0.0)
    slope = np.zeros(42)
    for i in range(6):
        for j in range(7):
            for sides in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                pair = [rows.get((i, j, c, s), absent) for c, s in enumerate(sides)]
                fall = 1 + sum((k @ z) ** 2 for k, _, _ in pair) / 1.5**2
                for c, (k, v, t) in enumerate(pair):
                    slope += t * k * (k @ z - v) / fall / (1 + (float(g[c, i, j]) / 75) ** 2) / 4
    assert np.abs(slope).max() < 1e-7


def test_joint_loss_by_its_definition():
    g, mask, weight = small_problem(True, True, channels=1)
    method = MEstimator("tukey", scale=1.3, floor=0.01, joint=True)
    fields = method._check_fields(g[None], mask[None], weight[None])
    z = random_field(1, 1, 6, 7, seed=8)
    rows, absent, flat = residual_rows(g, mask, weight), (np.zeros(42), 0.0, 0.0), z.flatten().numpy()
    cost = 0.0
    for i in range(6):
        for j in range(7):
            for sides in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                pair = [rows.get((i, j, c, s), absent) for c, s in enumerate(sides)]
                square = sum((k @ flat - v) ** 2 for k, v, _ in pair)
                rho = 1.3**2 / 6 * (1 - max(0, 1 - square / 1.3**2) ** 3) + 0.005 * square
                cost += max(t for _, _, t in pair) * rho / 4
    assert float(method._data_term(fields).cost(z)) == pytest.approx(cost, rel=1e-9)


def test_four_indicators_by_lines():
    """Each field of s minimises its functional along its own rows or columns: a tridiagonal system."""
    g, mask, weight = small_problem(True, True)
    method = MumfordShah(kappa=0.6, width=0.8, solve_tol=1e-12, indicators=4)
    fields = method._check_fields(g[None], mask[None], weight[None])
    data, z = method._data_term(fields), random_field(1, 1, 6, 7, seed=8)
    c = data.misfit(z)
    s = data._replace(tol=1e-12).indicator(c)[0]
    for number in range(4):
        for i, j in mask[0].nonzero().tolist():
            pull = c[0, number, i, j] * s[number, i, j] + 0.36 * (s[number, i, j] - 1)
            for side in (-1, 1):
                a, b = (i, j + side) if number % 2 == 0 else (i + side, j)
                if 0 <= a < 6 and 0 <= b < 7 and mask[0, a, b]:
                    pull += 0.36 * 0.64 * (s[number, i, j] - s[number, a, b])
            assert abs(float(pull)) < 1e-8


def test_edge_preserving_is_the_minimum_that_scipy_finds():
    g = random_field(1, 2, 5, 6)
    A = np.array([row for i in range(5) for j in range(6) for c, (a, b) in enumerate(((i, j + 1), (i + 1, j)))
                  if a < 5 and b < 6 for row in [np.eye(30)[6 * a + b] - np.eye(30)[6 * i + j]]])  # fmt: skip
    v = np.array([float(g[0, c, i, j] + g[0, c, a, b]) / 2 for i in range(5) for j in range(6)
                  for c, (a, b) in enumerate(((i, j + 1), (i + 1, j))) if a < 5 and b < 6])  # fmt: skip

    def cost(z):
        s = A @ z
        slope = A.T @ (s - v + 0.4 * s / (1 + (s / 0.7) ** 2))
        return 0.5 * ((s - v) ** 2).sum() + 0.4 * 0.49 / 2 * np.log1p((s / 0.7) ** 2).sum(), slope

    expected = minimize(cost, LeastSquares()(g).flatten().numpy(), jac=True, method="BFGS", options={"gtol": 1e-10}).x
    z = EdgePreserving(lam=0.4, delta=0.7, n_iter=500, tol=1e-14)(g).flatten().numpy()
    np.testing.assert_allclose(z, center(expected, None), atol=1e-5)
