"""How likely each edge is cut, and by which side being nearer, before any surface is known."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchdls.dictionary.normals import blur
from torchdls.integrators.piecewise.measured import Measured

NAMES = ("1", "A", "A2", "A-", "l", "l2", "Al", "A2l", "A-l", "D", "D|D|", "K", "K2", "Kl", "KA", "F", "|F|")
_NOISE = 10.0  # degrees: unit of the noise on which coefficients depend
_MOST = 30.0  # log odds


class Prior(NamedTuple):
    """Coefficients of the log odds: `alone` (3, F) without, `coupled` (3, F + 1) with the cuts next along the contour.

    They are quadratic in the noise: rows for 1, s, s^2, s the root mean square angle in units of 10 degrees.
    """

    alone: Tensor
    coupled: Tensor


@cache
def fitted() -> Prior:
    """The coefficients that `benchmarks/quality/fit_jump_prior.py` found."""
    text = resources.files(__package__).joinpath("jump_prior.json").read_text(encoding="utf-8")
    data = json.loads(text)
    return Prior(*(torch.tensor(data[name], dtype=torch.float64, device="cpu") for name in ("alone", "coupled")))


def features(m: Measured) -> Tensor:
    """(N, 2, F, 2, H, W): what speaks for a cut, for "i is nearer" and for "j is nearer".

    With theta the angle between line of sight and slope at an end: A of the end that would be nearer, positive where it
    dives toward the other; F of the other end. l is the log of the angle between the normals, D = A - F. K tells
    whether the jump of the normals can be that of a crease: across a continuous crease slopes change along its normal
    alone, so the smoothed tensor of those changes is symmetric.
    """
    theta = torch.rad2deg(torch.atan(m.slopes))
    i, j = theta.unbind(1)
    log_angle = (m.angle.clamp(min=0.25) / 10).log()
    bent = incompatible(m)
    return torch.stack([_directed(i, j, log_angle, bent), _directed(-j, -i, log_angle, bent)], 1)


def _directed(near: Tensor, far: Tensor, log_angle: Tensor, bent: Tensor) -> Tensor:
    a, away = near.clamp(0, 90) / 90, (-near).clamp(0, 60) / 60
    d, f, b = ((near - far) / 45).clamp(-1.5, 3), far.clamp(-90, 90) / 90, log_angle
    parts = [torch.ones_like(a), a, a * a, away, b, b * b, a * b, a * a * b, away * b, d, d * d.abs()]
    return torch.stack([*parts, bent, bent * bent, bent * b, bent * a, f, f.abs()], 1)


def incompatible(m: Measured, width: float = 2.0) -> Tensor:
    """(N, 2, H, W): antisymmetric part of the smoothed tensor of the jumps of normals, relative to its size."""
    if min(m.v.shape[-2:]) < 2:
        return torch.zeros_like(m.v)
    cells = []
    for channel, dim in ((0, -1), (1, -2)):  # n_i b_j - n_j b_i, bounded at grazing angle; then its mean over each cell
        n = m.unit.shape[dim] - 1
        near, far = (m.unit.narrow(dim, k, n) for k in (0, 1))
        live = m.live[:, channel : channel + 1].narrow(dim, 0, n)
        jump = torch.where(live, near[:, 2:] * far[:, :2] - far[:, 2:] * near[:, :2], 0)
        other = -3 - dim
        k = jump.shape[other] - 1
        cells.append(blur((jump.narrow(other, 0, k) + jump.narrow(other, 1, k)) / 2, width))
    (xx, xy), (yx, yy) = (cell.unbind(1) for cell in cells)
    size = (xx.square() + xy.square() + yx.square() + yy.square()).sqrt()
    cell = pad((xy - yx).abs() / (size + 0.01), (1, 1, 1, 1))
    return torch.stack([(cell[:, :-1, 1:] + cell[:, 1:, 1:]) / 2, (cell[:, 1:, :-1] + cell[:, 1:, 1:]) / 2], 1)


def log_odds(phi: Tensor, noise: Tensor, around: Tensor | None = None, prior: Prior | None = None) -> Tensor:
    """(N, 2, 2, H, W) of "i is nearer" and "j is nearer", from features and, if given, what is cut around.

    Args:
        phi: (N, 2, F, 2, H, W), as `features` gives them.
        noise: (N,) radians per tangential component.
        around: (N, 2, H, W), as `continued` gives it.
        prior: coefficients; None for the fitted ones.
    """
    prior = fitted() if prior is None else prior
    s = torch.rad2deg(noise.double()) * 2**0.5 / _NOISE
    row = prior.alone if around is None else prior.coupled
    theta = (torch.stack([torch.ones_like(s), s, s * s], 1) @ row.to(s.device)).to(phi)
    found = torch.einsum("nf,ndfehw->ndehw", theta[:, : phi.shape[2]], phi)
    if around is not None:
        found = found + theta[:, -1, None, None, None, None] * around[:, None]
    return found.clamp(-_MOST, _MOST)


def continued(cut: Tensor, live: Tensor) -> Tensor:
    """(N, 2, H, W): at how many of its two ends a contour through the edge goes on, given how likely each edge is cut.

    The edges of the grid are crossed by the contours, which run along the sides of pixels; three others meet at either
    end of a side. Where two of them are missing, at the border of the mask, a contour may end: one half.
    """

    def side(q: Tensor, missing: Tensor) -> Tensor:
        found = 1 - (1 - q).prod(0)
        return torch.where(missing.sum(0) >= 2, found.clamp(min=0.5), found)

    cut, gone = torch.where(live, cut, 0), ~live
    pairs = zip(_around(cut), _around(gone.to(cut), 1.0), strict=True)
    return sum(side(q, missing) for q, missing in pairs)  # type: ignore[return-value]


def _around(q: Tensor, beyond: float = 0.0) -> tuple[Tensor, Tensor]:
    """The three other edges (3, N, 2, H, W) around the corner at either end of the side that each edge crosses."""
    x, y = q.unbind(1)

    def at(f: Tensor, down: int, right: int) -> Tensor:
        wide = pad(f, (1, 1, 1, 1), value=beyond)
        h, w = f.shape[-2:]
        return wide[:, 1 + down : 1 + down + h, 1 + right : 1 + right + w]

    above = [at(x, -1, 0), at(y, -1, 0), at(y, -1, 1)]
    below = [at(x, 1, 0), at(y, 0, 0), at(y, 0, 1)]
    left = [at(y, 0, -1), at(x, 0, -1), at(x, 1, -1)]
    right = [at(y, 0, 1), at(x, 0, 0), at(x, 1, 0)]
    first, second = zip(above, left, strict=True), zip(below, right, strict=True)
    return torch.stack([torch.stack(p, 1) for p in first]), torch.stack([torch.stack(p, 1) for p in second])
