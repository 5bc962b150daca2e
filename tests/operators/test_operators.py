"""Gradient operators and edge slopes against dense matrices, plain convolutions and their transposes."""

import itertools

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.optimize import minimize_scalar

from tests.helpers import assert_adjoint, assert_gradients, assert_unchanged, random_field
from tests.helpers.oracles import differences, edge_vector
from torchdls import GradientOperator, edge_slopes
from torchdls.operators import as_pixel_size, present_edges, slope_divergence

SOBEL = (((-1, 0, 1), (-2, 0, 2), (-1, 0, 1)), ((-1, -2, -1), (0, 0, 0), (1, 2, 1)))
DIAGONAL = (((-1, 0, 0), (0, 0, 0), (0, 0, 1)), ((0, 0, 1), (0, 0, 0), (-1, 0, 0)))
WIDE = (((1, -8, 0, 8, -1),), ((1,), (-8,), (0,), (8,), (-1,)))  # fourth-order central differences, times 12
UNEQUAL = (((-1.0, 0.0, 3.0),), ((2.0,), (1.0,), (0.0,)))
STENCILS = {"forward": "forward", "backward": "backward", "central": "central"} | {
    "sobel": SOBEL,
    "diagonal": DIAGONAL,
    "wide": WIDE,
    "unequal": UNEQUAL,
}
SHAPES = [(1, 1), (1, 4), (3, 1), (2, 2), (3, 3), (5, 6), (7, 4)]


def slope_by_loops(z, kernel, spacing):
    """Cross-correlation, pixel by pixel; 0 where a nonzero tap falls outside."""
    h, w = z.shape
    taps = [
        (i - len(kernel) // 2, j - len(row) // 2, t)
        for i, row in enumerate(kernel)
        for j, t in enumerate(row)
        if t != 0
    ]
    top, bottom = min(i for i, _, _ in taps), max(i for i, _, _ in taps)
    left, right = min(j for _, j, _ in taps), max(j for _, j, _ in taps)
    out = np.zeros((h, w))
    for y, x in itertools.product(range(h), range(w)):
        if y + top >= 0 and y + bottom < h and x + left >= 0 and x + right < w:
            out[y, x] = sum(t * z[y + i, x + j] for i, j, t in taps) / spacing
    return out


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("stencil", STENCILS.values(), ids=STENCILS.keys())
def test_gradient_is_the_convolution_and_its_adjoint_the_transpose(stencil, shape):
    A = GradientOperator(stencil, (0.5, 2.0))
    z = random_field(2, 1, *shape)
    slopes = A(z)
    assert slopes.shape == (2, 2, *shape)
    for n, (c, kernel) in itertools.product(range(2), enumerate(A.kernels)):
        expected = slope_by_loops(z[n, 0].numpy(), kernel, A.pixel_size[c])
        np.testing.assert_allclose(slopes[n, c].numpy(), expected, atol=1e-12)
    assert_adjoint(A, A.adjoint, z, random_field(2, 2, *shape, seed=1))


@pytest.mark.parametrize("stencil", ["forward", "backward", "central", UNEQUAL], ids=str)
def test_shifted_differences_equal_conv2d_and_conv_transpose2d(stencil):
    """The two-tap shortcut and PyTorch's convolution are the same map."""
    A = GradientOperator(stencil)
    z, g = random_field(2, 1, 9, 8), random_field(2, 2, 9, 8, seed=1)
    kx, ky = (torch.tensor(k, dtype=z.dtype)[None, None] for k in A.kernels)
    convolved = [F.conv2d(z, k, padding=(k.shape[-2] // 2, k.shape[-1] // 2)) for k in (kx, ky)]
    inside = (
        (A(torch.ones_like(z)) == 0) & (A(random_field(1, 1, 9, 8, seed=5)) != 0) if stencil != UNEQUAL else A(z) != 0
    )
    expected = torch.where(inside, torch.cat(convolved, 1), 0)
    torch.testing.assert_close(A(z), expected)
    masked = torch.where(inside, g, 0)
    transposed = sum(
        F.conv_transpose2d(masked[:, c : c + 1], k, padding=(k.shape[-2] // 2, k.shape[-1] // 2))
        for c, k in enumerate((kx, ky))
    )
    torch.testing.assert_close(A.adjoint(g), transposed)


def test_forward_differences_are_the_matrix_of_the_solve():
    z = random_field(1, 1, 5, 7)
    expected = differences(5, 7, 2.0, 0.5) @ z.numpy().ravel()
    np.testing.assert_allclose(edge_vector(GradientOperator("forward", (2.0, 0.5))(z)[0]), expected, atol=1e-12)


@pytest.mark.parametrize("stencil", STENCILS.values(), ids=STENCILS.keys())
def test_norm_bound_holds_and_is_tight_for_two_taps(stencil):
    A = GradientOperator(stencil, (1.0, 2.0))
    h, w = 24, 24
    basis = torch.eye(h * w, dtype=torch.float64).view(h * w, 1, h, w)
    norm = float(torch.linalg.matrix_norm(A(basis).flatten(1), 2))
    assert norm <= A.norm_bound * (1 + 1e-12)
    if stencil in ("forward", "backward", "central"):
        assert norm > 0.97 * A.norm_bound
    assert GradientOperator("forward").norm_bound == pytest.approx(8**0.5)
    assert GradientOperator("central").norm_bound == pytest.approx(2**0.5)


def test_a_plane_has_its_slopes():
    y, x = torch.meshgrid(torch.arange(5.0), torch.arange(6.0), indexing="ij")
    z = (3 * 0.5 * x - 2 * 4.0 * y)[None, None]
    for stencil in ("forward", "backward", "central"):
        slopes = GradientOperator(stencil, (0.5, 4.0))(z)
        assert slopes[0, 0, 2, 2] == 3
        assert slopes[0, 1, 2, 2] == -2


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"stencil": "sobel"}, "stencil: 'sobel' is unknown"),
        ({"stencil": (((1.0,),),)}, "stencil: 1 kernels given"),
        ({"stencil": (((1.0, -1.0),), ((1.0, 0, 0),))}, "odd sides"),
        ({"stencil": (((1.0, 0, 0), (1.0,)), ((1.0, 0, 0),))}, "odd sides"),
        ({"stencil": (((0.0,),), ((1.0,),))}, "no nonzero tap"),
        ({"pixel_size": 0.0}, "pixel_size: 0.0 given"),
        ({"pixel_size": (1.0, -1.0)}, "pixel_size"),
        ({"pixel_size": (1.0, 1.0, 1.0)}, "pixel_size"),
        ({"pixel_size": float("nan")}, "pixel_size"),
        ({"pixel_size": (1.0, float("inf"))}, "pixel_size"),
        ({"pixel_size": "wide"}, "pixel_size"),
        ({"pixel_size": True}, "pixel_size"),
        ({"pixel_size": None}, "pixel_size"),
    ],
)
def test_bad_settings_are_named(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        GradientOperator(**arguments)


def test_pixel_size_takes_any_real_number():
    assert as_pixel_size(2) == (2.0, 2.0)
    assert as_pixel_size(np.float32(0.5)) == (0.5, 0.5)
    assert as_pixel_size([np.float64(1), 3]) == (1.0, 3.0)


K = 1e5  # squared difference of the slopes at both ends of an edge, in variances of the better one


def best_slope(g_i, g_j, t_i, t_j):
    """The estimate (1/2 + d) g_i + (1/2 - d) g_j of least expected squared error, and the inverse of that, by SciPy.

    The samples have variances 1/t, and their slopes differ by D either way: the estimate errs by d D at the middle.
    """
    if min(t_i, t_j) == 0:
        return (g_j, 2 * t_j / (4 + K)) if t_i == 0 else (g_i, 2 * t_i / (4 + K))

    def error(d):
        return (0.5 + d) ** 2 / t_i + (0.5 - d) ** 2 / t_j + d**2 * K / max(t_i, t_j)

    found = minimize_scalar(error, bounds=(-0.5, 0.5), method="bounded", options={"xatol": 1e-12})
    return (0.5 + found.x) * g_i + (0.5 - found.x) * g_j, 0.5 / found.fun


def slopes_by_loops(g, mask, t):
    """v and w of one field, edge by edge from the definition."""
    _, h, w = g.shape
    v, trust = np.zeros_like(g), np.zeros_like(g)
    for c, (down, right) in enumerate(((0, 1), (1, 0))):
        for y, x in itertools.product(range(h - down), range(w - right)):
            i, j = (c, y, x), (c, y + down, x + right)
            if mask[y, x] and mask[y + down, x + right] and t[i] + t[j] > 0:
                v[i], trust[i] = best_slope(g[i], g[j], t[i], t[j])
    return v, trust


@pytest.mark.parametrize("channels", [None, 1, 2])
@pytest.mark.parametrize("masked", [False, True])
def test_edge_slopes_follow_their_definition(masked, channels):
    g = random_field(2, 2, 6, 5)
    mask = torch.rand(2, 1, 6, 5, generator=torch.Generator().manual_seed(1)) < 0.7 if masked else None
    weight = None if channels is None else random_field(2, channels, 6, 5, seed=2).clamp(min=0)
    if mask is not None:
        g = torch.where(mask, g, torch.nan)
    with assert_unchanged(g, mask, weight):
        v, w = edge_slopes(g, mask, weight)
    trust = torch.ones_like(g) if weight is None else weight.expand_as(g)
    inside = torch.ones(2, 1, 6, 5, dtype=torch.bool) if mask is None else mask
    for n in range(2):
        expected = slopes_by_loops(g[n].nan_to_num().numpy(), inside[n, 0].numpy(), trust[n].numpy())
        np.testing.assert_allclose(v[n].numpy(), expected[0], atol=1e-8)
        if w is not None:
            np.testing.assert_allclose(w[n].numpy(), expected[1], rtol=1e-8)
    assert (w is None) == (mask is None and weight is None)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-24, 1.0, 1e24])
def test_trusts_have_no_scale_and_equal_ones_take_the_mean(dtype, scale):
    g, error = random_field(1, 2, 6, 5, dtype=dtype), torch.full((1, 1, 1, 1), 0.7, dtype=dtype)
    v, w = edge_slopes(g, weight=torch.full_like(g, scale), error=error)
    there = present_edges(v)
    torch.testing.assert_close(v, edge_slopes(g)[0])
    torch.testing.assert_close(w / scale, there)
    weight = torch.rand(1, 1, 6, 5, generator=torch.Generator().manual_seed(3)).to(dtype) ** 8
    (v, w), (v_scaled, w_scaled) = (edge_slopes(g, weight=c * weight, error=error) for c in (1, scale))
    torch.testing.assert_close(v_scaled, v)
    torch.testing.assert_close(w_scaled / scale, w)


def test_what_averaging_errs_by_adds_to_the_variance():
    """One edge, of trusts 1 and 3, their mean 2: variance 1/3 and an error of .6 times 1/2; weights of 2 stay 2."""
    weight = torch.tensor([[[[1.0, 3.0]]]]).double()
    w = edge_slopes(torch.zeros(1, 2, 1, 2).double(), weight=weight, error=torch.full((1, 1, 1, 1), 0.6).double())[1]
    expected = 0.5 / (1 / 3 + 0.3) * (1 / 4 + 0.3) / (1 / 4)
    assert float(w[0, 0, 0, 0]) == pytest.approx(expected, rel=1e-4)


def test_a_slope_that_is_not_known_is_taken_from_the_other_end_and_continuously_so():
    g = torch.tensor([[1.0, 5.0]]).double().expand(1, 2, 1, 2)
    zero, tiny = (edge_slopes(g, weight=torch.tensor([[[[2.0, t]]]]).double()) for t in (0.0, 1e-14))
    assert float(zero[0][0, 0, 0, 0]) == 1
    assert 0 < float(zero[1][0, 0, 0, 0]) < 1e-4
    torch.testing.assert_close(tiny, zero, rtol=1e-8, atol=1e-8)
    neither = edge_slopes(g, weight=torch.zeros(1, 1, 1, 2).double())
    assert all((x == 0).all() for x in neither)


def test_edge_slopes_are_differentiable_and_ignore_nan_outside():
    mask = torch.ones(1, 1, 4, 4, dtype=torch.bool)
    mask[..., 0, 0] = mask[..., 3, 1] = False
    g, t = random_field(1, 2, 4, 4), random_field(1, 1, 4, 4, seed=1).exp()
    assert_gradients(lambda g, t: torch.cat([x for x in edge_slopes(g, mask, t) if x is not None]), g, t)
    g = torch.where(mask, g, torch.nan).requires_grad_()
    edge_slopes(g, mask, t)[0].sum().backward()
    assert g.grad.isfinite().all()
    assert (g.grad[~mask.expand_as(g)] == 0).all()


@pytest.mark.parametrize("taped", [False, True])
@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 3.0)], ids=str)
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2), (7, 6)], ids=str)
def test_divergence_is_the_adjoint_of_the_edge_slopes(shape, pixel_size, taped):
    """With and without a derivative, which are computed differently."""
    g = random_field(2, 2, *shape)
    with assert_unchanged(g):
        b = slope_divergence(g.requires_grad_(taped), pixel_size)
    expected = GradientOperator("forward", pixel_size).adjoint(edge_slopes(g.detach())[0])
    torch.testing.assert_close(b.detach(), expected, rtol=0, atol=1e-14)
