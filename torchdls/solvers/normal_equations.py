"""The normal equations of (*), and their solution by a direct factor, which measures the error of heights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.operators import GradientOperator
from torchdls.operators.edges import edge_ends
from torchdls.solvers.cg import CGResult, LinearMap
from torchdls.solvers.components import Gauge
from torchdls.solvers.nested_dissection import factor

# Solves by a direct factor at most, and the change of heights that rounding leaves.
_REFINEMENTS = 12
_EXACT = 1e-13
# Contrast of weights beyond which it is not to be trusted.
_LOST = 1e30
# Weights of edges (over squared steps) further apart than this let a residual swallow what the lighter ones say: they
# take the direct factor, in double precision, which measures heights.
STEEP = 1e4
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
    return w.flatten(1).amax(1) > STEEP * _least(w)


def spread(w: Tensor, r: Tensor, setting: Setting) -> Tensor:
    """(N,) by how much residuals understate errors: the largest weight of edges, by the least that holds any height.

    H is at least the Laplacian times the smallest weight of its edges, and at least the smallest anchor weight.
    """
    w = w / squares(w, setting)
    least = torch.maximum(_least(w), r.flatten(1).amin(1))
    return (w.flatten(1).amax(1) / least).clamp(min=1)


def _least(w: Tensor) -> Tensor:
    """(N,) the smallest weight of an edge that is there; infinite where none is."""
    return torch.where(w > 0, w, torch.inf).flatten(1).amin(1)


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


def directly(u: Tensor, pull: Tensor, w: Tensor, r: Tensor, gauge: Gauge, setting: Setting) -> tuple[CGResult, Tensor]:
    """Minimiser of 1/2 w (A z - u)^2 + 1/2 r z^2 - pull z by a direct factor, in double precision; and u - A z.

    The factor is right at any contrast of weights, but forces A^T (w u) are not: what firm edges round away may be all
    that weak ones say. So z is a sum of two numbers, whose misfits u - A z are taken edge by edge, and the forces of
    what they leave pixel by pixel, without rounding in between; it is refined until one more solve changes no height by
    more than `tol` of the largest of its component. Where weights of one component are more than `_LOST` apart, two
    numbers do not suffice: the surface counts as not converged.
    """
    dtype, gauge = u.dtype, gauge.double()
    u, pull, w, r = (t.double() for t in (u, pull, w, r))
    solve, goal = _inverse(w, r, gauge, setting), max(setting.tol, _EXACT)
    bent = gauge.balance(gauge.balance(pull))
    some = gauge.greatest(bent.abs()) > _EXACT * gauge.greatest(pull.abs())  # the rest is rounding of nothing
    pull = torch.where(some, bent, 0)
    high = low = torch.zeros_like(r)
    change = torch.full_like(r[:, 0, 0, 0], torch.inf)
    active = torch.ones_like(change, dtype=torch.bool)
    steps = torch.zeros_like(change, dtype=torch.int64)
    for _ in range(_REFINEMENTS):
        step = solve(_forces(w, misfit(u, high, low, setting), pull - r * high - r * low, setting))
        active = active & step.isfinite().flatten(1).all(1)
        step = torch.where(active.view(-1, 1, 1, 1), step, 0)
        total, rest = _sum(high, low + step)
        largest = gauge.greatest(total.abs())
        now = (step.abs() / torch.where(largest > 0, largest, 1)).flatten(1).amax(1)
        high, low, steps = total, rest, steps + active
        change, active = torch.where(active, now, change), active & ~(now <= goal)
        if not bool(active.any()):
            break
    m = misfit(u, high, low, setting)
    found = (change <= goal) & (_contrast(w / squares(w, setting), gauge) <= _LOST)
    change = torch.where(found, change, change.clamp(1.0, torch.finfo(dtype).max))
    return CGResult(high.to(dtype), steps, change.to(dtype), found), m.to(dtype)


def _contrast(w: Tensor, gauge: Gauge) -> Tensor:
    """(N,) the largest ratio of two weights of edges of one component."""
    least, most = 1 / torch.where(w > 0, w, torch.inf), w
    ratio = gauge.greatest(least.amax(1, keepdim=True)) * gauge.greatest(most.amax(1, keepdim=True))
    return ratio.flatten(1).amax(1)


def _inverse(w: Tensor, r: Tensor, gauge: Gauge, setting: Setting) -> LinearMap:
    """Forces to heights that are settled. One pixel of each component is held by as much as its edges weigh.

    What this bends is given back: `lift` are the heights that the added weight asks for by itself.
    """
    if gauge.share.shape[1] == 0:
        return factor(w, r, setting.pixel_size).solve
    edges = edge_ends(w / squares(w, setting))
    pins = torch.where(gauge.pins().view_as(r), torch.where(edges > 0, edges, r), 0)
    direct = factor(w, r + pins, setting.pixel_size)
    if gauge.labels.shape[1] == 0:
        return lambda force: gauge.settle(direct.solve(gauge.balance(force)))
    lift = direct.solve(pins).flatten(1)
    whole = gauge.sums(lift * gauge.trust)
    lift = lift / torch.where(whole > 0, whole, 1)

    def solve(force: Tensor) -> Tensor:
        x = direct.solve(gauge.balance(force)).flatten(1)
        return (x - lift * gauge.sums(x * gauge.trust)).view_as(force)

    return solve


def misfit(u: Tensor, high: Tensor, low: Tensor, setting: Setting) -> Tensor:
    """u - A (high + low) (N, 2, H, W), rounded once."""
    steps = squares(u, setting).sqrt()
    m = u * steps
    for channel, dim in ((0, -1), (1, -2)):
        n = u.shape[dim] - 1
        part = m.narrow(1, channel, 1).narrow(dim, 0, n)
        rise, lost = _sum(high.narrow(dim, 1, n), -high.narrow(dim, 0, n))
        left, more = _sum(part, -rise)
        part.copy_(left + (more - lost - (low.narrow(dim, 1, n) - low.narrow(dim, 0, n))))
    return m / steps


def _forces(w: Tensor, m: Tensor, more: Tensor, setting: Setting) -> Tensor:
    """A^T (w m) + more, rounded once: what leaves one end of an edge enters the other to the last digit."""
    flow = w * m / squares(w, setting).sqrt()
    total, lost = more.clone(), torch.zeros_like(more)
    for channel, dim in ((0, -1), (1, -2)):
        n = flow.shape[dim] - 1
        part = flow.narrow(1, channel, 1).narrow(dim, 0, n)
        for end, sign in ((0, -1), (1, 1)):
            pixel, rest = total.narrow(dim, end, n), lost.narrow(dim, end, n)
            now, left = _sum(pixel, sign * part)
            pixel.copy_(now)
            rest.add_(left)
    return total + lost


def _sum(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """a + b, and what rounding took from it (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)
