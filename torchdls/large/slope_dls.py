r"""SlopeDLS by tiles: what the tiles found to be noise, blended smoothly, and one exact solve of the whole surface.

Windows of one size, which overlap by two halos, are smoothed each by itself with the noise level of the whole. What
window t changed in its own least squares, d_t = z_t - z_ls,t, is local but for its slowest waves, whose slopes are
small: so its slopes are blended, and the surface is the exact least-squares height of the measured slopes with that
added,

    z = argmin ||A z - v - sum_t p_t A d_t||^2,      sum_t p_t = 1

with p_t rising over one halo around the middle of an overlap, so that half a halo at the rim of a window counts for
nothing. Waves as long as a window are seen by none: they are those of the whole at a lower resolution, at which it is
no larger than a window. There slopes are means over blocks, with less noise, and the modes of d that are longer than a
quarter of a window come from there. The last steps of SlopeDLS look at the whole again: in the cosine modes of z and of
the least-squares height the slow waves are shrunk, and where little of the noise was found least squares is returned.
The two iterations between these are left out, so one window is SlopeDLS with the recipe "quick".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torchdls._files import Array, as_tensor
from torchdls.integrators import SlopeDLS
from torchdls.integrators.slope_dls.runs import PERIOD, Grid, blended
from torchdls.integrators.slope_dls.waves import share_followed, shrunk_modes, slow_modes, slow_part
from torchdls.large.transform import (
    Passes,
    columns_back,
    columns_forward,
    integrated,
    rows_back,
    rows_forward,
)
from torchdls.noise import height_noise_part, noise_if_told
from torchdls.operators import GradientOperator, dct2

HALO = 64  # pixels
_NARROW = 8  # pixels that a side must have at the lower resolution


class Span(NamedTuple):
    """A window along one axis: its pixels, and the weight of each."""

    pixels: slice
    weight: Tensor


def spans(n: int, tile: int, halo: int) -> list[Span]:
    """Windows of one size along an axis of n pixels, at most `tile` apart; their weights add up to 1."""
    size = min(n, tile + 2 * halo)
    count = 1 if size == n else math.ceil((n - 2 * halo) / tile)
    starts = [round(k * (n - size) / max(1, count - 1)) for k in range(count)]
    seams = [(following + start + size) / 2 for start, following in pairwise(starts)]
    x = torch.arange(n, dtype=torch.float64) + 0.5
    rises = [(0.5 - 0.5 * torch.cos(math.pi * ((x - s) / max(1, halo) + 0.5).clamp(0, 1))) for s in seams]
    edges = [torch.ones_like(x), *rises, torch.zeros_like(x)]
    parts = [slice(start, start + size) for start in starts]
    return [Span(p, (a - b)[p]) for p, (a, b) in zip(parts, pairwise(edges), strict=True)]


Windows = tuple[list[Span], list[Span]]


def slope_dls(passes: Passes, integrator: SlopeDLS, windows: Windows, level: Tensor) -> Iterator[tuple[slice, Array]]:
    """Bands of the height.

    Args:
        passes: over a full rectangle.
        integrator: one of the recipes of runs; its pixel size is not read.
        windows: along the rows and the columns.
        level: (1,) standard deviation of one gradient sample.
    """
    unit, steps = in_pixels(passes.step)
    base, change = passes.scratch("base"), passes.scratch("change")
    _smooth(passes, integrator, windows, level, steps, change)
    waves = long_waves(passes, integrator, windows, level, steps)
    for rows in passes.bands():
        base[rows] = rows_forward(passes.divergence(rows, steps))
        change[rows] = rows_forward(as_tensor(change[rows]))
    shrunk, share = _finish(passes, base, change, level, steps, waves)
    share = 1.0 if integrator.guard is None else share
    for columns in passes.strips():
        z, d = (as_tensor(x[:, columns].T) for x in (base, change))
        smooth = z + d
        slow = shrunk[:, columns].T
        smooth[: len(slow), : slow.shape[1]] = slow
        base[:, columns] = columns_back(z + share * (smooth - z))
    for rows in passes.bands():
        yield rows, rows_back(base[rows]) * unit


def in_pixels(step: tuple[float, float]) -> tuple[float, tuple[float, float]]:
    """The side of a square pixel of the same area, and the sides of a pixel in that unit."""
    unit = math.sqrt(step[0] * step[1])
    return unit, (step[0] / unit, step[1] / unit)


def noise_of(passes: Passes, sigma: float | Tensor | None, windows: Windows) -> Tensor:
    """(1,) the noise level that is given, or the median of those of all windows: a few with creases do not count."""
    if sigma is not None:
        return as_tensor(np.asarray([float(sigma)], passes.field.dtype))
    (rows, columns), steps = windows, in_pixels(passes.step)[1]
    passes.say(f"the noise of {len(rows)} x {len(columns)} tiles")
    levels: list[float] = []
    for down in rows:
        for across in columns:
            level, told = noise_if_told(passes.field.slopes(down.pixels, across.pixels)[None], None, None, steps)
            levels += level[told].tolist()
    return as_tensor(np.asarray([np.median(levels) if levels else 0.0], passes.field.dtype))


def _smooth(
    passes: Passes,
    integrator: SlopeDLS,
    windows: Windows,
    level: Tensor,
    steps: tuple[float, float],
    change: Array,
) -> None:
    """Add A^T sum_t p_t A d_t to `change`."""
    a, guard = GradientOperator("forward", steps), integrator.guard is not None
    for k, down in enumerate(windows[0]):
        passes.say(f"row {k + 1} of {len(windows[0])}, {len(windows[1])} tiles")
        for across in windows[1]:
            gradient = passes.field.slopes(down.pixels, across.pixels)[None]
            start, height = blended(integrator._exact_runs, gradient, level, Grid(steps), guard)
            weight = (down.weight[:, None] * across.weight).to(gradient)
            change[down.pixels, across.pixels] += a.adjoint(weight * a(height - start))[0, 0].numpy()


class Waves(NamedTuple):
    """The first modes (h, w) of a change, and which of them are meant."""

    modes: Array
    chosen: Array

    def put(self, change: Array, columns: slice) -> None:
        """In the place of those of a strip."""
        (h, _), part = self.modes.shape, slice(columns.start, columns.stop)
        own, chosen = change[:h, : self.modes.shape[1]][:, part], self.chosen[:, part]
        own[chosen] = self.modes[:, part][chosen]


def long_waves(
    passes: Passes, integrator: SlopeDLS, windows: Windows, level: Tensor, steps: tuple[float, float]
) -> Waves | None:
    """The modes that are too long for a window, of the change of the whole at a lower resolution.

    None where one window is all, or the surface is so narrow that nothing would be left.
    """
    (h, w), sides = passes.size, [span[0].pixels.stop - span[0].pixels.start for span in windows]
    fold = max(2, *(math.ceil(n / side) for n, side in zip((h, w), sides, strict=True)))
    low = math.ceil(h / fold), math.ceil(w / fold)
    if len(windows[0]) == len(windows[1]) == 1 or min(low) < _NARROW:
        return None
    passes.say(f"the whole at {low[0]} x {low[1]}")
    blocks = [slice(i * h // low[0], -(-(i + 1) * h // low[0])) for i in range(low[0])]
    means = [functional.adaptive_avg_pool1d(passes.field.slopes(rows).mean(1), low[1]) for rows in blocks]
    unit, wide = in_pixels((steps[0] * w / low[1], steps[1] * h / low[0]))
    area = h * w / (low[0] * low[1])
    guard = integrator.guard is not None
    start, height = blended(
        integrator._exact_runs, torch.stack(means, 1)[None], level / math.sqrt(area), Grid(wide), guard
    )
    modes = dct2(height - start)[0, 0] * (unit * math.sqrt(area))
    period = max(max(sides) / 4, 8.0 * fold)
    return Waves(modes.numpy(), slow_modes(low, (h, w), period, modes).numpy())


def _finish(
    passes: Passes, base: Array, change: Array, level: Tensor, steps: tuple[float, float], waves: Waves | None
) -> tuple[Tensor, float]:
    """Strips of columns from A^T v to the spectrum of heights, in place; `shrink_slow_waves` and `cautious` from it.

    Returns:
        The first modes (rows, columns) of the smoothed height, which hold the slow waves, these shrunk, and the share
        of the change that is followed.
    """
    (h, w), removed, energy = passes.size, 0.0, 0.0
    for columns in passes.strips():
        for array in (base, change):
            array[:, columns] = integrated(columns_forward(array[:, columns]), columns, (h, w), steps).T.numpy()
        if waves is not None:
            waves.put(change, columns)
        variance = height_noise_part((h, w), (0, h), (columns.start, columns.stop), steps)
        weight = torch.where(variance > 0, variance, math.inf).pow_(-0.25)
        removed += float((weight * as_tensor(change[:, columns]).square()).sum())
        energy += float(weight.mul_(torch.where(variance > 0, variance, 0)).sum())
    rows, across = slow_part((h, w), PERIOD)
    z, d = (as_tensor(x[:rows, :across])[None, None] for x in (base, change))
    noise = (level.square() * height_noise_part((h, w), (0, rows), (0, across), steps)).to(z)
    shrunk = shrunk_modes(z + d, z, noise[None, None], (h, w), steps, PERIOD)[0, 0]
    share = share_followed(torch.tensor([removed], dtype=torch.float64), level.double().square() * energy)
    return shrunk, float(share)
