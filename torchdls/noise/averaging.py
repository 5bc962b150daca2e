"""What averaging two neighbouring slopes errs by, beside their noise."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls.noise.level import normalised, robust_scale, trusts
from torchdls.operators import edge_slopes
from torchdls.operators.edges import cell_curl, mean_trust

_ORDINARY = 6000.0  # 300 times u for trusts of 1
_LARGEST_ERROR = 1e4  # of averaging, in units of the noise: beyond it all weights are alike anyway


def averaging_error(
    gradient: Tensor,
    mask: Tensor | None,
    weight: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
) -> Tensor:
    r"""How far the mean of two neighbouring slopes is from the slope between them, in units of the noise.

    A crease somewhere between the pixels i and i + 1 turns the slope by c and puts their mean off by c (f - 1/2), where
    f is uniform: by c^2/12 on average. c shows in the third difference of the slopes, and so does the error on a curved
    surface (where it is smaller):

        r = g_{i-1} - 3 g_i + 3 g_{i+1} - g_{i+2},     mean error^2 = mean (r^2 - sigma^2 u) / 48
        u = 1/t_{i-1} + 9/t_i + 9/t_{i+1} + 1/t_{i+2}

    The mean over the surface is weighted by 1 / (u + 6000) for trusts of mean 1: all edges alike, those where steep
    relief is trusted less, but for the worst, whose noise would drown the rest. sigma is read from the curl, as by
    `noise_level`.

    Args:
        gradient: (N, 2, H, W).
        mask: (N, 1, H, W) bool, or None.
        weight: (N, 1 or 2, H, W).
        pixel_size: (dx, dy).

    Returns:
        (N, 1, 1, 1): the mean squared error over the noise variance of a sample of mean trust, from 0 to 1e4; 0 where
        the field is too small or too sparse to tell. It does not depend on the scale of the slopes or the weights.
    """
    trust = trusts(gradient, mask, weight)
    gradient = gradient if mask is None else torch.where(mask, gradient, 0)
    trust = trust / mean_trust(trust)
    if min(gradient.shape[-2:]) < 2 or max(gradient.shape[-2:]) < 4:
        return 0 * trust[:, :1, :1, :1]
    dx, dy = pixel_size
    unit, cells = normalised(cell_curl(edge_slopes(gradient)[0], (dx, dy)), trust, dx, dy)
    power = robust_scale(unit, cells).nan_to_num(0.0).square()
    sums = [third_differences(gradient[:, c], trust[:, c], dim) for c, dim in ((0, -1), (1, -2))]
    square, noise, total = (torch.stack(parts).sum(0) for parts in zip(*sums, strict=True))
    return error_of(square, noise, total, power, cells.flatten(1).any(1))[:, None, None, None]


def error_of(square: Tensor, noise: Tensor, total: Tensor, power: Tensor, told: Tensor) -> Tensor:
    """(N,) the error from the sums of `third_differences`, the noise variance, and whether any cell tells that."""
    noisy, known = power > 0, (total > 0) & told
    over = (square / torch.where(noisy, power, 1) - noise) / torch.where(known, total, 1) / 48
    over = torch.where(noisy, over, _LARGEST_ERROR * (square > 0)).clamp(0, _LARGEST_ERROR)
    return torch.where(known, over, 0)


def third_differences(g: Tensor, trust: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) sums of q r^2, q u and q along one axis of (N, H, W), where all four samples are trusted."""
    n = g.shape[dim] - 3
    if n < 1:
        return (0 * g[:, 0, 0],) * 3
    ends = [(g.narrow(dim, k, n), trust.narrow(dim, k, n)) for k in range(4)]
    live = torch.stack([t > 0 for _, t in ends]).all(0)
    r, u = torch.zeros_like(ends[0][0]), torch.zeros_like(ends[0][0])
    for factor, (slope, t) in zip((1, -3, 3, -1), ends, strict=True):
        r, u = r + factor * slope, u + factor**2 / torch.where(live, t, 1)
    q = torch.where(live, 1 / (u + _ORDINARY), 0)
    return (q * r.square()).sum((-2, -1)), (q * u).sum((-2, -1)), q.sum((-2, -1))


# --- what least squares makes of white noise --------------------------------------------------------------------------
