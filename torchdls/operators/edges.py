"""Fields on the edges of the pixel grid: slopes, pixels to edges and back, divergence, which edges are there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._checks import check_field, check_fit, require


def edge_slopes(
    gradient: Tensor, mask: Tensor | None = None, weight: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """From a slope at each pixel to a slope, and a trust, on each edge between neighbours.

    The pixels i and j at the ends of an edge both measure its slope, with trusts t_i and t_j:

        v_e = (t_i g_i + t_j g_j) / (t_i + t_j)        w_e = (t_i + t_j) / 2

    and both must lie inside the mask, else v_e = w_e = 0. With equal trusts v_e is the average of Simchony, Chellappa
    and Shao (1990), taken half way between the two pixels. What the gradient holds outside the mask is never read.

    Args:
        gradient: (N, 2, H, W).
        mask: (N, 1, H, W) bool, or None for a full rectangle.
        weight: (N, 1, H, W) or (N, 2, H, W), at least 0, or None for equal trust.

    Returns:
        v: (N, 2, H, W); v[:, 0, :, j] belongs to the edge between columns j and j + 1 (0 in the last column),
            v[:, 1, i, :] to the edge between rows i and i + 1 (0 in the last row).
        w: (N, 2, H, W) on the same edges, or None where every trust is 1.

    Raises:
        ValueError: a shape or device does not fit.
        TypeError: a dtype does not.

    Example:
        >>> slopes, trust = torchdls.edge_slopes(torch.arange(3.0).expand(1, 2, 1, 3))
        >>> slopes[0, 0]  # half way between the pixels; no edge leaves the last column
        tensor([[0.5000, 1.5000, 0.0000]])
        >>> trust is None  # all are trusted alike
        True
    """
    check_field("edge_slopes", "gradient", gradient, 2)
    require(gradient.ndim == 4, f"edge_slopes: gradient {tuple(gradient.shape)} given, (N, 2, H, W) is needed")
    if mask is None and weight is None:
        return _pair_sums(gradient) * 0.5, None
    for label, t, channels, dtype in (("mask", mask, (1,), torch.bool), ("weight", weight, (1, 2), None)):
        if t is not None:
            check_fit("edge_slopes", label, t, gradient, "gradient", channels=channels, dtype=dtype)
    trust = torch.ones_like(gradient) if weight is None else weight.expand_as(gradient)
    if mask is not None:
        gradient, trust = torch.where(mask, gradient, 0), torch.where(mask, trust, 0)
    moment = trust * gradient
    both = _pair_sums(trust)
    if mask is not None:
        both = torch.where(_pair_both(mask.expand_as(gradient)), both, 0)
    some = both > 0
    v = torch.where(some, _pair_sums(moment) / torch.where(some, both, 1), 0)
    return v, both * 0.5


def slope_divergence(gradient: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """A^T v (N, 1, H, W) for forward differences A and the slopes v = `edge_slopes(gradient)` of equal trust.

    Averaging and differencing make one central difference, once the slopes are continued with opposite sign:

        (A^T v)_j = (g_{j-1} - g_{j+1}) / 2 dx + (the same along y),     g_{-1} = -g_0,  g_W = -g_{W-1}
    """
    if torch.compiler.is_compiling():
        (gx, gy), (dx, dy) = gradient.split(1, -3), pixel_size
        return torch.add(_central(gx, -1) * (0.5 / dx), _central(gy, -2), alpha=0.5 / dy)
    return _SlopeDivergence.apply(gradient, pixel_size)


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


def _pair_sums(t: Tensor) -> Tensor:
    tx, ty = t.split(1, -3)
    return _stack_edges(tx[..., :, :-1] + tx[..., :, 1:], ty[..., :-1, :] + ty[..., 1:, :])


def _pair_both(inside: Tensor) -> Tensor:
    ix, iy = inside.split(1, -3)
    return _stack_edges(ix[..., :, :-1] & ix[..., :, 1:], iy[..., :-1, :] & iy[..., 1:, :])


def present_edges(v: Tensor) -> Tensor:
    """Weight 1 on every edge of the rectangle, 0 beyond its last column and row."""
    w = torch.ones_like(v)
    w[:, 0, :, -1] = 0
    w[:, 1, -1, :] = 0
    return w


def edge_ends(w: Tensor) -> Tensor:
    """(N, 1, H, W): sum of an edge field over the (up to four) edges at each pixel."""
    x, y = w.split(1, -3)
    return x + y + F.pad(x[..., :, :-1], (1, 0)) + F.pad(y[..., :-1, :], (0, 0, 1, 0))


def extend_edges(field: Tensor) -> Tensor:
    """An edge field (N, 2, H, W) with its absent last column (of x) and last row (of y) continued."""
    x, y = field.split(1, 1)
    x = torch.cat([x[..., :-1], x[..., -2:-1]], -1) if x.shape[-1] > 1 else x
    y = torch.cat([y[..., :-1, :], y[..., -2:-1, :]], -2) if y.shape[-2] > 1 else y
    return torch.cat([x, y], 1)
