"""Fields on the edges of the pixel grid: slopes, pixels to edges and back, divergence, which edges are there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._checks import check_field, check_fit
from torchdls._precision import full_precision
from torchdls._tracing import is_recorded

# How many times the variance of the better end the squared difference of slopes between two pixels is taken for: far
# above it, so that the slope leaves the middle of an edge only where one end is next to unknown.
_BEND = 1e5


@full_precision
def edge_slopes(
    gradient: Tensor, mask: Tensor | None = None, weight: Tensor | None = None, *, error: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    r"""From a slope at each pixel to a slope, and a trust, on each edge between neighbours.

    The pixels i and j at the ends of an edge both measure its slope, with trusts t_i and t_j (inverse variances):

        v_e = (g_i + g_j) / 2        w_e = 2 t_i t_j / (t_i + t_j)

    the average of Simchony, Chellappa and Shao (1990), which is the slope half way between the two pixels, and its
    inverse variance; equal trusts t give w_e = t. Leaning towards the better end would lower the noise, but the slope
    would no longer be that of the middle, and errors of one sign add up over many edges. Only where one end is all but
    unknown does its slope give way, so that a pixel without a slope hangs on its neighbours by weak edges: with lo and
    hi the smaller and the larger trust and the slopes taken to differ by k = 1e5 variances of the better end,

        v_e = (g_i + g_j) / 2 + (t_i - t_j) / (t_i + t_j + k lo) (g_i - g_j) / 2
        w_e = 2 hi (t_i + t_j + k lo) / (4 hi + k (t_i + t_j))

    minimise the expected squared error of the slope at the middle; w_e is the inverse of that minimum. From equal
    trusts down to t_i = 0 (v_e = g_j, w_e = 2 t_j / (4 + k)) the rule is smooth.

    The mean of two slopes also errs where the surface is creased or curved, whatever the noise. With `error` this
    counts as so much more variance, and where it dominates all weights become alike (t the mean trust):

        w_e <- (1 + 2 error) w_e / (1 + 2 error w_e / t),        k <- k (1 + 2 error hi / t)

    Both pixels must lie inside the mask, else v_e = w_e = 0; also w_e = 0 where both trusts are 0. What the gradient
    holds outside the mask is never read.

    Args:
        gradient: (N, 2, H, W).
        mask: (N, 1, H, W) bool, or None for a full rectangle.
        weight: (N, 1, H, W) or (N, 2, H, W), at least 0, or None for equal trust.
        error: (N, 1, 1, 1), mean squared error of the average over the noise variance of a sample of mean trust, as
            `torchdls.noise.averaging_error` reads it off the gradient; None for 0. Without weights it has no effect.

    Returns:
        v: (N, 2, H, W); v[:, 0, :, j] belongs to the edge between columns j and j + 1 (0 in the last column),
            v[:, 1, i, :] to the edge between rows i and i + 1 (0 in the last row).
        w: (N, 2, H, W) on the same edges, or None where every trust is 1.

    Raises:
        TypeError: the gradient is not float32 or float64, the weight is of another dtype, or the mask is not bool.
        ValueError: a shape or device does not fit.

    Example:
        >>> slopes, trust = torchdls.edge_slopes(torch.arange(3.0).expand(1, 2, 1, 3))
        >>> slopes[0, 0]  # half way between the pixels; no edge leaves the last column
        tensor([[0.5000, 1.5000, 0.0000]])
        >>> trust is None  # all are trusted alike
        True
        >>> weight = torch.tensor([[[[1.0, 3.0, 0.0]]]])
        >>> slopes, trust = torchdls.edge_slopes(torch.arange(3.0).expand(1, 2, 1, 3), weight=weight)
        >>> slopes[0, 0].round(decimals=3), trust[0, 0].round(decimals=3)  # the last pixel hangs on the other's slope
        (tensor([[0.5000, 1.0000, 0.0000]]), tensor([[1.5000, 0.0000, 0.0000]]))
    """
    check_field("edge_slopes", "gradient", gradient, 2)
    if mask is not None:
        check_fit("edge_slopes", "mask", mask, gradient, "gradient", channels=(1,), dtype=torch.bool)
    if weight is not None:
        check_fit("edge_slopes", "weight", weight, gradient, "gradient", channels=(1, 2))
    if error is not None:
        check_fit("edge_slopes", "error", error, gradient, "gradient", channels=(1,), scalar=True)
    if mask is not None:
        gradient = torch.where(mask, gradient, 0)
    if weight is None:
        v = _pair_sums(gradient) * 0.5
        if mask is None:
            return v, None
        there = _pair_both(mask.expand_as(gradient))
        return torch.where(there, v, 0), there.to(v.dtype)
    trust = weight.expand_as(gradient) if mask is None else torch.where(mask, weight, 0).expand_as(gradient)
    (g_i, g_j), (t_i, t_j) = _pair(gradient), _pair(trust)
    hi, lo = torch.maximum(t_i, t_j), torch.minimum(t_i, t_j)
    live = hi > 0 if mask is None else (hi > 0) & _pair_both(mask.expand_as(gradient))
    unit = torch.where(live, hi, 1)
    ratio, extra = lo / unit, 0 * lo if error is None else 2 * error * (unit / mean_trust(trust))
    bend = _BEND * (1 + extra)
    whole = 1 + ratio + bend * ratio
    lean = 0.5 * (t_i - t_j) / unit / whole
    v = (0.5 + lean) * g_i + (0.5 - lean) * g_j
    w = 2 * whole / (4 + bend * (1 + ratio))
    if error is not None:
        w = w * (1 + 2 * error) / (1 + extra * w)
    return torch.where(live, v, 0), torch.where(live, hi * w, 0)


def wrapped_edge_slopes(gradient: Tensor) -> Tensor:
    """`edge_slopes` of equal trust on a torus: (N, 2, H, W), the last edges lead from the last pixels to the first."""
    gx, gy = gradient.split(1, -3)
    return torch.cat([gx + gx.roll(-1, -1), gy + gy.roll(-1, -2)], -3) * 0.5


def mean_trust(trust: Tensor) -> Tensor:
    """(N, 1, 1, 1) mean of the trusts (N, C, H, W) that are positive; 1 where none is."""
    largest = trust.amax((-3, -2, -1), keepdim=True)
    unit = torch.where(largest > 0, largest, 1)  # so that no sum overflows
    count = (trust > 0).sum((-3, -2, -1), keepdim=True).clamp(min=1)
    return torch.where(largest > 0, (trust / unit).sum((-3, -2, -1), keepdim=True) / count * unit, 1)


@full_precision
def slope_divergence(gradient: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """A^T v (N, 1, H, W) for forward differences A and the slopes v = `edge_slopes(gradient)` of equal trust.

    Averaging and differencing make one central difference, once the slopes are continued with opposite sign:

        (A^T v)_j = (g_{j-1} - g_{j+1}) / 2 dx + (the same along y),     g_{-1} = -g_0,  g_W = -g_{W-1}
    """
    if not is_recorded(gradient):
        return _divergence(gradient, pixel_size)
    if torch.compiler.is_compiling():
        (gx, gy), (dx, dy) = gradient.split(1, -3), pixel_size
        return torch.add(_central(gx, -1) * (0.5 / dx), _central(gy, -2), alpha=0.5 / dy)
    return _SlopeDivergence.apply(gradient, pixel_size)


def _divergence(gradient: Tensor, pixel_size: tuple[float, float]) -> Tensor:
    """The map of `slope_divergence` by a few strided differences, where nobody records them."""
    gx, gy = gradient.unbind(-3)
    (h, w), aspect = gx.shape[-2:], pixel_size[0] / pixel_size[1]
    b = torch.empty_like(gx, memory_format=torch.contiguous_format)
    if w > 1:
        torch.sub(gx.narrow(-1, 0, w - 2), gx.narrow(-1, 2, w - 2), out=b.narrow(-1, 1, w - 2))
        torch.add(gx.select(-1, 0), gx.select(-1, 1), out=b.select(-1, 0)).neg_()
        torch.add(gx.select(-1, w - 2), gx.select(-1, w - 1), out=b.select(-1, w - 1))
    else:
        b.zero_()
    b.narrow(-2, 1, h - 1).add_(gy.narrow(-2, 0, h - 1), alpha=aspect)
    b.narrow(-2, 0, h - 1).sub_(gy.narrow(-2, 1, h - 1), alpha=aspect)
    b.select(-2, 0).sub_(gy.select(-2, 0), alpha=aspect)
    b.select(-2, h - 1).add_(gy.select(-2, h - 1), alpha=aspect)
    return b.mul_(0.5 / pixel_size[0]).unsqueeze(-3)


class _SlopeDivergence(torch.autograd.Function):
    """The map of `slope_divergence`, summed up in place."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gradient: Tensor, pixel_size: tuple[float, float]) -> Tensor:
        divergence = torch.zeros_like(gradient[..., :1, :, :], memory_format=torch.contiguous_format)
        for channel, dim, at, of, count, factor in _stencil(gradient, pixel_size):
            part = gradient.narrow(-3, channel, 1).narrow(dim, of, count)
            divergence.narrow(dim, at, count).add_(part, alpha=factor)
        return divergence

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.pixel_size = inputs[1]

    @staticmethod
    def backward(ctx: Any, change: Tensor) -> tuple[Tensor, None]:
        return _SlopeDivergenceAdjoint.apply(change, ctx.pixel_size), None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _: None) -> Tensor:
        return _SlopeDivergence.apply(change, ctx.pixel_size)


class _SlopeDivergenceAdjoint(torch.autograd.Function):
    """Its adjoint, from (N, 1, H, W) to (N, 2, H, W)."""

    generate_vmap_rule = True

    @staticmethod
    def forward(field: Tensor, pixel_size: tuple[float, float]) -> Tensor:
        slopes = torch.cat([torch.zeros_like(field)] * 2, -3)
        for channel, dim, at, of, count, factor in _stencil(field, pixel_size):
            slopes.narrow(-3, channel, 1).narrow(dim, of, count).add_(field.narrow(dim, at, count), alpha=factor)
        return slopes

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.pixel_size = inputs[1]

    @staticmethod
    def backward(ctx: Any, change: Tensor) -> tuple[Tensor, None]:
        return _SlopeDivergence.apply(change, ctx.pixel_size), None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _: None) -> Tensor:
        return _SlopeDivergenceAdjoint.apply(change, ctx.pixel_size)


def _stencil(like: Tensor, pixel_size: tuple[float, float]) -> Iterator[tuple[int, int, int, int, int, float]]:
    """Channel, dimension, start of the divergence and of the slopes that enter it, their number and their factor."""
    for channel, dim in ((0, -1), (1, -2)):
        n, half = like.shape[dim], 0.5 / pixel_size[channel]
        yield channel, dim, 1, 0, n - 1, half
        yield channel, dim, 0, 1, n - 1, -half
        yield channel, dim, 0, 0, 1, -half
        yield channel, dim, n - 1, n - 1, 1, half


def _central(g: Tensor, dim: int) -> Tensor:
    n = g.shape[dim]
    g = torch.cat([-g.narrow(dim, 0, 1), g, -g.narrow(dim, n - 1, 1)], dim)
    return g.narrow(dim, 0, n) - g.narrow(dim, 2, n)


def _stack_edges(x: Tensor, y: Tensor) -> Tensor:
    """Edges along the rows (.., H, W - 1) and along the columns (.., H - 1, W), padded to one (.., 2, H, W) field."""
    return torch.cat([F.pad(x, (0, 1)), F.pad(y, (0, 0, 0, 1))], -3)


def _pair(t: Tensor) -> tuple[Tensor, Tensor]:
    """The values of a pixel field (.., 2, H, W) at both ends of each edge; 0 where there is no edge."""
    tx, ty = t.split(1, -3)
    return _stack_edges(tx[..., :-1], ty[..., :-1, :]), _stack_edges(tx[..., 1:], ty[..., 1:, :])


def _pair_sums(t: Tensor) -> Tensor:
    tx, ty = t.split(1, -3)
    return _stack_edges(tx[..., :, :-1] + tx[..., :, 1:], ty[..., :-1, :] + ty[..., 1:, :])


def _pair_both(inside: Tensor) -> Tensor:
    ix, iy = inside.split(1, -3)
    return _stack_edges(ix[..., :, :-1] & ix[..., :, 1:], iy[..., :-1, :] & iy[..., 1:, :])


def present_edges(v: Tensor) -> Tensor:
    """Weight 1 on every edge of the rectangle, 0 beyond its last column and row."""
    ones = torch.ones_like(v[..., :1, :, :])
    return _stack_edges(ones[..., :, :-1], ones[..., :-1, :])


def edges_behind(field: Tensor) -> Tensor:
    """The edge field at the edge behind each pixel, 0 where there is none: (.., 2, H, W)."""
    x, y = field.split(1, -3)
    return torch.cat([F.pad(x[..., :, :-1], (1, 0)), F.pad(y[..., :-1, :], (0, 0, 1, 0))], -3)


def edges_at_pixels(field: Tensor) -> Tensor:
    """Sum of an edge field over the two edges at each pixel, the one ahead and the one behind: (.., 2, H, W)."""
    return field + edges_behind(field)


def edge_ends(w: Tensor) -> Tensor:
    """(N, 1, H, W): sum of an edge field over the (up to four) edges at each pixel."""
    x, y = w.split(1, -3)
    return x + y + F.pad(x[..., :, :-1], (1, 0)) + F.pad(y[..., :-1, :], (0, 0, 1, 0))


def cell_curl(v: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """(N, H - 1, W - 1): sums of the slopes v, times their lengths, around each cell of 2 x 2 pixels."""
    x, y = v[:, 0, :, :-1] * pixel_size[0], v[:, 1, :-1] * pixel_size[1]
    return x[:, :-1] - x[:, 1:] + y[:, :, 1:] - y[:, :, :-1]


def wrapped_cell_curl(v: Tensor, pixel_size: tuple[float, float]) -> Tensor:
    """(N, H, W): `cell_curl` on a torus."""
    x, y = v[:, 0] * pixel_size[0], v[:, 1] * pixel_size[1]
    return x - x.roll(-1, -2) + y.roll(-1, -1) - y


def cell_edges(field: Tensor) -> Tensor:
    """(N, 4, H - 1, W - 1): the edge field on the top, bottom, right and left edges of each cell of 2 x 2 pixels."""
    x, y = field[:, 0, :, :-1], field[:, 1, :-1]
    return torch.stack([x[:, :-1], x[:, 1:], y[:, :, 1:], y[:, :, :-1]], 1)


def complete_cells(live: Tensor) -> Tensor:
    """(N, H - 1, W - 1) bool: the cells that have all four edges."""
    return cell_edges(live).all(1)


def beside_edges(cells: Tensor) -> Tensor:
    """Sum of a cell field (N, H - 1, W - 1) over the (one or two) cells beside each edge: (N, 2, H, W)."""
    low = F.pad(cells, (0, 1, 0, 1))
    return torch.stack([low + F.pad(cells, (0, 1, 1, 0)), low + F.pad(cells, (1, 0, 0, 1))], 1)


def extend_edges(field: Tensor) -> Tensor:
    """An edge field (N, 2, H, W) with its absent last column (of x) and last row (of y) continued."""
    x, y = field.split(1, 1)
    x = torch.cat([x[..., :-1], x[..., -2:-1]], -1) if x.shape[-1] > 1 else x
    y = torch.cat([y[..., :-1, :], y[..., -2:-1, :]], -2) if y.shape[-2] > 1 else y
    return torch.cat([x, y], 1)
