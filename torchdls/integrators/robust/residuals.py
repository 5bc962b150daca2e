"""Residuals of the slopes on the edges at each pixel, on which every robust data term is built."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls._tracing import seen_everywhere
from torchdls.integrators.base import Fields
from torchdls.operators import GradientOperator, edge_slopes, present_edges
from torchdls.operators.edges import edges_behind

_LEAST_NOISE = 1e-3  # of the root mean square slope: noise below it is treated as this much


class Terms(NamedTuple):
    r"""The one-sided residuals of a field, and the map between them and the edges of the grid.

    The slope g_i measured at a pixel speaks of both edges at it: the one ahead and the one behind, along x and along y.
    So every edge is measured twice, once from either end, and a pixel that is wrong spoils only one of the two, where
    averaging them first (as least squares may, see `edge_slopes`) spoils the edge.

        ---o--[edge j-1]--o--[edge j]--o---      residuals at pixel j:   (A z)_j - g_j       ahead
              j-1         j           j+1                                (A z)_{j-1} - g_j   behind

    They are stacked as (N, M, 2, H, W), the two directions in the third dimension:

    - separate, M = 2: ahead, behind;
    - joint, M = 4: the four one-sided stencils (ahead, ahead), (ahead, behind), (behind, ahead), (behind, behind), each
      a vector of two residuals at one pixel.

    The mean over M of half the squares, weighted by the trusts, is the data term of least squares but for a constant.

    Attributes:
        slopes: (N, 1, 2, H, W), g.
        trust: (N, 1, 1 or 2, H, W), at least 0; (N, 1, 1, H, W) for joint residuals.
        live: (N, M, 2, H, W) bool, whether the edge is there (both ends inside the mask) and the trust is positive.
        steps: sides of a pixel.
        joint: whether the residuals of a stencil belong together.
        plain: whether every edge of the rectangle is known to be measured from both ends.
    """

    slopes: Tensor
    trust: Tensor
    live: Tensor
    steps: tuple[float, float]
    joint: bool
    plain: bool

    @classmethod
    def of(cls, fields: Fields, *, joint: bool) -> Terms:
        """The terms of checked fields; slopes on edges are measured once, and count as much as from both ends."""
        g = fields.gradient
        if fields.on_edges:
            w = present_edges(g) if fields.weight is None else fields.weight
            live = torch.stack([w > 0, torch.zeros_like(w, dtype=torch.bool)], 1)
            return cls(g[:, None], 2 * w[:, None], live, fields.steps, joint, False)
        there = edge_slopes(g, fields.mask)[1]
        trust = torch.ones_like(g[:, :1]) if fields.weight is None else fields.weight
        live = (_spread(present_edges(g) if there is None else there, joint) > 0) & (trust > 0)[:, None]
        plain = fields.mask is None and (fields.weight is None or seen_everywhere(trust > 0))
        if joint:
            trust = trust.mean(1, keepdim=True)
        return cls(g[:, None], trust[:, None], live, fields.steps, joint, plain)

    def residual(self, z: Tensor) -> Tensor:
        """(N, M, 2, H, W), 0 where there is no edge."""
        return self.difference(z) - torch.where(self.live, self.slopes, 0)

    def difference(self, z: Tensor) -> Tensor:
        """What a height adds to the residuals: its own slopes (N, M, 2, H, W), 0 where there is no edge."""
        slopes = GradientOperator("forward", self.steps)(z)
        return torch.where(self.live, _spread(slopes, self.joint), 0)

    def size(self, r: Tensor) -> Tensor:
        """Magnitude of the residuals: (N, 2, 2, H, W) if separate, (N, 4, 1, H, W) for joint ones."""
        if not self.joint:
            return r.abs()
        square = r.square().sum(2, keepdim=True)
        positive = square > 0
        return torch.where(positive, torch.where(positive, square, 1).sqrt(), 0)

    def gather(self, stack: Tensor) -> Tensor:
        """Sum of a stack over the residuals that share an edge, divided by M: (N, 2, H, W)."""
        x, y = stack.unbind(2)
        if self.joint:
            x = torch.stack([x[:, 0] + x[:, 1], x[:, 2] + x[:, 3]], 1)
            y = torch.stack([y[:, 0] + y[:, 2], y[:, 1] + y[:, 3]], 1)
        x = x[:, 0] + pad(x[:, 1, :, 1:], (0, 1))
        y = y[:, 0] + pad(y[:, 1, 1:], (0, 0, 0, 1))
        return torch.stack([x, y], 1) / self.live.shape[1]

    def total(self, cost: Tensor) -> Tensor:
        """(N,) sum over all residuals, divided by M."""
        return cost.flatten(1).sum(1) / self.live.shape[1]

    def quadratic(self, factor: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes v and trusts w (N, 2, H, W) on the edges of 1/2 sum factor trust r^2, where the residuals are live."""
        trust = torch.where(self.live, factor * self.trust, 0)
        w = self.gather(trust)
        some = w > 0
        return torch.where(some, self.gather(trust * self.slopes) / torch.where(some, w, 1), 0), w


def _spread(edges: Tensor, joint: bool) -> Tensor:
    """An edge field (N, 2, H, W) as each pixel sees it, ahead and behind: (N, M, 2, H, W)."""
    (x, y), (before, above) = edges.unbind(1), edges_behind(edges).unbind(1)
    pairs = ((x, y), (x, above), (before, y), (before, above)) if joint else ((x, y), (before, above))
    return torch.stack([torch.stack(pair, 1) for pair in pairs], 1)


def sample_noise(fields: Fields) -> Tensor:
    r"""(N, 1, 1, 1) standard deviation of one slope around those of its neighbours, however many outliers (but half).

    The two ends of an edge measure the same slope, so their difference has deviation sigma sqrt(2) where the noise
    dominates; it is estimated by the median of its magnitude. Where curvature dominates, it is the change of slope
    from pixel to pixel, by which one-sided residuals differ from zero on the true surface: their scale in both cases.
    At least a thousandth of the root mean square slope, so that it can divide; 1 for a field of zeros.
    """
    g = fields.gradient
    trust = torch.ones_like(g) if fields.weight is None else fields.weight.expand_as(g)
    if fields.mask is not None:
        trust = torch.where(fields.mask, trust, 0)
    differences, live = [], []
    for channel, dim in ((0, -1), (1, -2)):
        slope, good = g[:, channel], trust[:, channel] > 0
        n = slope.shape[dim] - 1
        differences.append((slope.narrow(dim, 1, n) - slope.narrow(dim, 0, n)).flatten(1))
        live.append((good.narrow(dim, 1, n) & good.narrow(dim, 0, n)).flatten(1))
    noise = masked_median(torch.cat(differences, 1).abs(), torch.cat(live, 1)) / (NORMAL_MEDIAN * 2**0.5)
    return torch.maximum(noise, least_slope(g, trust > 0))[:, None, None, None]


def least_slope(g: Tensor, live: Tensor) -> Tensor:
    """(N,) a thousandth of the root mean square slope, or 1 for a field of zeros."""
    square = torch.where(live, g, 0).square().flatten(1).sum(1) / live.flatten(1).sum(1).clamp(min=1)
    return torch.where(square > 0, _LEAST_NOISE * torch.where(square > 0, square, 1).sqrt(), 1)
