"""A solve (*) brought to numbers of order 1, and its heights brought back: exact, and without a trace in derivatives.

Units are powers of two, so that nothing is rounded. The plane and the constants that are taken out of the slopes and
anchors are put back into the heights, which therefore do not depend on them: they need no derivative.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

# Anchors that outweigh every edge by more than 2^60 (2^40 in single precision) are exact to the last digit anyway.
_FIRMEST = {torch.float64: 2.0**60}
_FIRM = 2.0**40


class Problem(NamedTuple):
    """The tensors of (*) and its pixels: v and w (N, 2, H, W), anchors, their weights and the guess (N, 1, H, W)."""

    v: Tensor
    w: Tensor
    anchor: Tensor | None
    r: Tensor | None
    z0: Tensor | None
    pixel_size: tuple[float, float]

    def double(self) -> Problem:
        """In double precision."""
        anchor, r, z0 = (None if t is None else t.double() for t in (self.anchor, self.r, self.z0))
        return Problem(self.v.double(), self.w.double(), anchor, r, z0, self.pixel_size)


def unit_of(x: Tensor) -> Tensor:
    """The largest power of two that is not above x >= 0, within what the dtype inverts exactly; 1 where x is 0."""
    limit = 1000 if x.dtype == torch.float64 else 120
    exponent = torch.where(x > 0, x, 1).log2().floor().clamp(-limit, limit)
    return exponent.exp2()


def normalize_problem(problem: Problem) -> tuple[Problem, Tensor]:
    """The same problem with slopes, weights and pixels of order 1, and the unit (N, 1, 1, 1) of its heights."""
    v, w, anchor, r, z0, (dx, dy) = problem
    length = 2.0 ** math.floor(math.log2(min(dx, dy)))
    trust, slope = (unit_of(t.detach().abs().amax((1, 2, 3), keepdim=True)) for t in (w, v))
    back = 1 / slope / length
    if r is not None:
        weight = (r / trust * length * length).clamp(torch.finfo(r.dtype).tiny, _FIRMEST.get(r.dtype, _FIRM))
        anchor = None if anchor is None else torch.where(r > 0, anchor * back, 0)
        r = torch.where(r > 0, weight, 0)
    z0 = None if z0 is None else z0 * back
    return Problem(v / slope, w / trust, anchor, r, z0, (dx / length, dy / length)), slope * length


def plane_of(slope: Tensor, size: tuple[int, int], pixel_size: tuple[float, float]) -> Tensor:
    """Heights (N, 1, H, W) of planes with slopes (N, 2, H, W) or (N, 2, 1, 1), 0 in the middle of the rectangle."""
    y, x = (
        (torch.arange(n, dtype=slope.dtype, device=slope.device) - (n - 1) / 2) * d
        for n, d in zip(size, pixel_size[::-1], strict=True)
    )
    return slope[:, :1] * x + slope[:, 1:] * y[:, None]
