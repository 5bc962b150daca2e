"""The normal equations of (*), and their solution by a direct factor, which measures the error of heights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.operators import GradientOperator
from torchdls.operators.edges import edge_ends
from torchdls.solvers.cg import CGResult, LinearMap, conjugate_gradients
from torchdls.solvers.components import Gauge
from torchdls.solvers.nested_dissection import factor

# Steps of conjugate gradients with a direct factor at most.
_DIRECT_STEPS = 30
# Weights of edges (over squared steps) further apart than this let a residual swallow what the lighter ones say: they
# take the direct factor, in double precision, which measures heights.
STEEP = 1e4
# What rounding may do to heights, by their size, where weights are so far apart.
_ROUNDED = 1e-6
# Anchors below this part of the weight of edges leave the constant of a component to rounding, unless it is set apart.
WEAK = 1e-4


class Setting(NamedTuple):
    """What the solve needs besides tensors."""

    pixel_size: tuple[float, float]
    tol: float
    max_iter: int


def slopes_of(setting: Setting) -> GradientOperator:
    """A, the forward differences."""
    return GradientOperator("forward", setting.pixel_size)


def squares(like: Tensor, setting: Setting) -> Tensor:
    """(1, 2, 1, 1), of the steps along x and y."""
    return torch.tensor(setting.pixel_size, dtype=like.dtype, device=like.device).view(1, 2, 1, 1).square()


def steep(w: Tensor, setting: Setting) -> Tensor:
    """(N,) bool: the weights of a surface are further apart than `STEEP`."""
    w = w.detach() / squares(w, setting)
    least = torch.where(w > 0, w, torch.inf).flatten(1).amin(1)
    return w.flatten(1).amax(1) > STEEP * least


def normal(w: Tensor, r: Tensor, setting: Setting) -> LinearMap:
    """z -> H z = A^T (w A z) + r z, edge by edge: what flows along an edge leaves one end and enters the other."""
    dx, dy = setting.pixel_size
    across, down = (w[:, :1, :, :-1] / dx**2).contiguous(), w[:, 1:, :-1] / dy**2

    def apply(z: Tensor) -> Tensor:
        result = r * z
        for weight, dim in ((across, -1), (down, -2)):
            n = z.shape[dim] - 1
            flow = (z.narrow(dim, 1, n) - z.narrow(dim, 0, n)).mul_(weight)
            result.narrow(dim, 0, n).sub_(flow)
            result.narrow(dim, 1, n).add_(flow)
        return result

    return apply


def directly(b: Tensor, w: Tensor, r: Tensor, x: Tensor, gauge: Gauge, setting: Setting) -> CGResult:
    """The same, preconditioned by a direct factor and in double precision; one step mostly, three where H is singular.

    In the factor alone, one pixel of every component that nothing else holds is held by as much as its edges weigh. The
    error of the heights is measured by the factor, and what rounding did to b too: where that is more than `_ROUNDED`,
    the system counts as not converged.
    """
    dtype, gauge = b.dtype, gauge.double()
    b, w, r, x = (t.double() for t in (b, w, r, x))
    edges = edge_ends(w / squares(w, setting))
    held = r
    if gauge.share.shape[1]:
        loose = gauge.pins().view_as(r)
        if gauge.pull.shape[1]:
            loose = loose & (gauge.sums(r.flatten(1)).view_as(r) < WEAK * edges)
        held = r + torch.where(loose, edges, 0)
    direct = factor(w, held, setting.pixel_size)
    apply, b = normal(w, r, setting), gauge.balance(b)

    def solve(y: Tensor) -> Tensor:
        return gauge.settle(direct.solve(y))

    found = conjugate_gradients(
        apply, solve, b, x, tol=setting.tol, max_iter=_DIRECT_STEPS, project=gauge.correction(),
        deflate=gauge.deflation(), by_steps=True,
    )  # fmt: skip
    rounded = solve(gauge.balance(_rounding(found.x, edges))).flatten(1).norm(dim=1)
    rounded = rounded / found.x.flatten(1).norm(dim=1).clamp(min=torch.finfo(b.dtype).tiny)
    lost = ~(rounded <= _ROUNDED)
    residual = torch.where(lost, rounded, found.residual).nan_to_num(nan=torch.inf).clamp(max=torch.finfo(dtype).max)
    return found._replace(x=found.x.to(dtype), residual=residual.to(dtype), converged=found.converged & ~lost)


def _rounding(x: Tensor, edges: Tensor) -> Tensor:
    """What rounding may have done to the pivots of H, as forces without a pattern, so that they do not cancel."""
    k = torch.arange(1, x[0].numel() + 1, dtype=x.dtype, device=x.device)
    size = 2 * torch.finfo(x.dtype).eps * x.abs().amax((1, 2, 3), keepdim=True)
    return size * edges * k.square().sin().view(x[0].shape)
