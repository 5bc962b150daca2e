"""What the two ends of every edge measure, in depths: distances that grow away from the viewer, in pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls.integrators.fields import Fields
from torchdls.operators import edge_slopes
from torchdls.operators.edges import present_edges

GRAZING = 0.05  # cosine below which a slope is no longer believed to grow
_LEAST_SCALE = 0.05  # pixels: residuals below it are as good as 0


class Measured(NamedTuple):
    """Both ends of every edge; i is the left or upper one, stacked as (N, 2 ends, 2 directions, H, W).

    Attributes:
        slopes: of the depth along the edge, p_i and p_j.
        facing: cosines between normal and line of sight, n_i and n_j.
        v: (N, 2, H, W), their mean.
        trust: (N, 2, H, W), 0 where there is no edge.
        unit: (N, 3, H, W), the normals as (p n, n).
        angle: (N, 2, H, W), between the normals of the two ends, in degrees.
        scale: (N, 2, H, W), residual at which the mean is no longer believed.
    """

    slopes: Tensor
    facing: Tensor
    v: Tensor
    trust: Tensor
    unit: Tensor
    angle: Tensor
    scale: Tensor

    @property
    def live(self) -> Tensor:
        """(N, 2, H, W) bool, where there is an edge."""
        return self.trust > 0


def believed(p: Tensor) -> Tensor:
    """Slopes (N, 2, H, W) p n / max(n, GRAZING), n the cosine: at grazing angle they grow no further."""
    n = (1 + p.square().sum(1, keepdim=True)).rsqrt()
    return p * (n / n.clamp(min=GRAZING))


def measure(p: Tensor, fields: Fields, noise: Tensor) -> Measured:
    """The ends of all edges.

    Args:
        p: (N, 2, H, W) slopes of the depth in pixels.
        fields: mask and weights; the gradient is not read.
        noise: (N,) of the normals, in radians per tangential component.
    """
    n = (1 + p.square().sum(1, keepdim=True)).rsqrt()
    p = p * (n / n.clamp(min=GRAZING))
    v, trust = edge_slopes(p, fields.mask, fields.weight)
    trust = present_edges(v) if trust is None else trust
    slopes, facing = ends(p), ends(n.expand_as(p))
    live = trust > 0
    half = noise[:, None, None, None]
    spread = torch.where(live, (slopes[:, 0] - slopes[:, 1]).abs(), 0)
    usual = masked_median(spread.flatten(1), live.flatten(1))[:, None, None, None] / NORMAL_MEDIAN
    own = ((1 + slopes.square()) / facing.clamp(min=GRAZING).square()).sum(1) / 4
    scale = (usual.clamp(min=_LEAST_SCALE).square() + (0.4 * spread).square() + half.square() * own).sqrt()
    unit = torch.cat([p * n, n], 1) / (torch.cat([p * n, n], 1).norm(dim=1, keepdim=True))
    return Measured(slopes, facing, v, trust, unit, _angles(unit), scale)


def follows_tilt(p: Tensor, inside: Tensor, least: float = 0.05) -> Tensor:
    """(N,) bool, whether the curl of slopes p grows with them as noise of normals makes it, not as noise of slopes.

    Noise of normals gives the curl over 2 x 2 pixels a scale s = sqrt((1 + |p|^2) (2 + |p|^2)) times one number.
    Densities exp(-|c| / b) / 2b with b = m s, m the mean of |c| / s, are compared with one b for all, the mean of |c|.
    The mean of log b is smaller for what describes the curl better: by `least` nats, for what matters to the height.
    """
    if min(p.shape[-2:]) < 2:
        return torch.zeros(len(p), dtype=torch.bool, device=p.device)
    x, y = (p[:, 0, :, :-1] + p[:, 0, :, 1:]) / 2, (p[:, 1, :-1] + p[:, 1, 1:]) / 2
    curl = (x[:, :-1] - x[:, 1:] + y[..., 1:] - y[..., :-1]).abs().flatten(1)
    square = avg_pool2d(p, 2, 1).square().sum(1)
    scale = ((1 + square) * (2 + square)).sqrt().flatten(1)
    live = (avg_pool2d(inside.to(p), 2, 1) > 0.99).flatten(1)

    def mean(f: Tensor) -> Tensor:
        return torch.where(live, f, 0).sum(1) / live.sum(1).clamp(min=1)

    return (mean(curl) > 0) & (mean(curl / scale).log() + mean(scale.log()) + least < mean(curl).log())


def filled(g: Tensor, fields: Fields) -> Tensor:
    """Slopes (N, 2, H, W) with those of no weight replaced by the mean of those beside them, or 0."""
    if fields.weight is None:
        return g
    told = (fields.weight > 0).expand_as(g)
    told = told if fields.mask is None else told & fields.mask
    known, count = torch.where(told, g, 0), told.to(g)
    total, number = (_beside(f) for f in (known, count))
    return torch.where(told, g, total / number.clamp(min=1))


def _beside(f: Tensor) -> Tensor:
    """Sum over the four neighbours."""
    wide = pad(f, (1, 1, 1, 1))
    return wide[..., 1:-1, 2:] + wide[..., 1:-1, :-2] + wide[..., 2:, 1:-1] + wide[..., :-2, 1:-1]


def ends(field: Tensor) -> Tensor:
    """A field (N, 2, H, W) at both ends of the edges: (N, 2 ends, 2, H, W)."""
    return torch.stack([field, ahead(field)], 1)


def ahead(field: Tensor) -> Tensor:
    """(N, 2, H, W): channel 0 from the column to the right, channel 1 from the row below; 0 beyond the border."""
    return torch.stack([pad(field[:, 0, :, 1:], (0, 1)), pad(field[:, -1, 1:], (0, 0, 0, 1))], 1)


def _angles(unit: Tensor) -> Tensor:
    """(N, 2, H, W) degrees between the unit normals (N, 3, H, W) at both ends."""
    right, below = pad(unit[..., 1:], (0, 1)), pad(unit[..., 1:, :], (0, 0, 0, 1))
    chord = torch.stack([(unit - other).square().sum(1) for other in (right, below)], 1).sqrt()
    return torch.rad2deg(2 * torch.asin((chord / 2).clamp(max=1)))
