"""Sparse coding of unit normals, their three components together, and the noise that tells what to keep."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls._tracing import seen_everywhere
from torchdls.operators import Patches, dct2, idct2

_TAU = 1.8  # threshold in standard deviations of the noise of a coefficient's two tangential components together
_FACING = 0.6  # cosine from which a pixel is face-on
_WIDTHS = (3.0, 9.0, 27.0)  # of the normalised convolutions that continue the normals outside the mask
_REACHED = 1e-3  # share of a window inside the mask from which it says something


def curl_noise(b: Tensor, c: Tensor, inside: Tensor, ray: Tensor | None = None) -> Tensor:
    """(N,) noise of unit normals whose slopes in pixels are p = b / c, (N, 2, H, W) and (N, 1, H, W).

    With c the scalar product of normal and ray (0, 0, 1), or another ray of depth 1, the covariance of noisy p has the
    trace sigma^2 (2 + 2 p.ray_xy + |p|^2 |ray|^2) / c^2, and its mean over a cell is the variance of the curl.
    """
    if min(c.shape[-2:]) < 2:
        return c.new_zeros(len(c))
    facing = torch.where(inside, c, -1)
    level = torch.minimum(masked_median(facing.flatten(1), inside.flatten(1)), facing.new_tensor(_FACING))
    fine = facing >= level[:, None, None, None].clamp(min=0.05)
    c = torch.where(fine, c, 1)
    p = torch.where(fine, b / c, 0)
    x, y = (p[:, 0, :, :-1] + p[:, 0, :, 1:]) / 2, (p[:, 1, :-1] + p[:, 1, 1:]) / 2
    curl = x[:, :-1] - x[:, 1:] + y[..., 1:] - y[..., :-1]
    square = p.square().sum(1, keepdim=True)
    along = 0.0 if ray is None else 2 * (p * ray[..., :2, :, :]).sum(1, keepdim=True)
    length = 1.0 if ray is None else ray.square().sum(-3, keepdim=True)
    spread = F.avg_pool2d((2 + along + square * length) / c.square(), 2, 1)[:, 0]
    live = F.avg_pool2d(fine.to(p), 2, 1)[:, 0] > 0.99
    return masked_median((curl.abs() / spread.sqrt()).flatten(1), live.flatten(1)) / NORMAL_MEDIAN


def code_normals(n: Tensor, inside: Tensor, sigma: Tensor, sizes: Sequence[int] = (6, 12, 24)) -> Tensor:
    """Unit normals (N, 3, H, W) without noise of sigma (N,); 0 outside the mask."""
    whole = _continued(n, inside)
    noise = sigma[:, None, None, None]
    first = _average(whole, sizes, lambda c: _kept(c, noise))
    whole = torch.where(inside, n, first)

    def shrunk(c: Tensor, pilot: Tensor) -> tuple[Tensor, Tensor]:
        energy = pilot.square().sum(1, keepdim=True) / 2
        total = energy + noise[..., None].square()
        gain = torch.where(total > 0, energy / torch.where(total > 0, total, 1), 1)
        gain = _with_mean(gain)
        return c * gain, 1 / gain.square().sum((-2, -1), keepdim=True)

    coded = _average(whole, sizes, shrunk, first)
    return torch.where(inside, F.normalize(coded, dim=1), 0)


def _kept(c: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients (N, 3, L, s, s) beyond the noise, and the weights of their patches (N, 1, L, 1, 1)."""
    kept = c.detach().square().sum(1, keepdim=True) > 2 * (_TAU * noise[..., None]).square()
    kept = _with_mean(kept.to(c))
    return c * kept, 1 / (1 + kept.sum((-2, -1), keepdim=True))


def _with_mean(gain: Tensor) -> Tensor:
    """A gain of 1 for the mean of the patch."""
    mean = torch.zeros(gain.shape[-2:], dtype=torch.bool, device=gain.device)
    mean[0, 0] = True
    return torch.where(mean, 1, gain)


def _average(
    x: Tensor, sizes: Sequence[int], estimate: Callable[..., tuple[Tensor, Tensor]], pilot: Tensor | None = None
) -> Tensor:
    """(N, 3, H, W): the weighted mean of what all patches of all sizes make of x."""
    total, weight = torch.zeros_like(x), torch.zeros_like(x[:, :1])
    for size in sizes:
        patches, border = Patches(size, max(1, size // 4)), (size - 1,) * 4
        shape = (x.shape[-2] + 2 * size - 2, x.shape[-1] + 2 * size - 2)
        parts = [_coefficients(f, patches, border) for f in ((x,) if pilot is None else (x, pilot))]
        c, w = estimate(*parts)
        w = w.expand(-1, -1, -1, size, size)
        total = total + _put(idct2(c) * w, patches, shape, size)
        weight = weight + _put(w, patches, shape, size)
    return total / weight


def _coefficients(x: Tensor, patches: Patches, border: tuple[int, ...]) -> Tensor:
    """(N, 3, L, s, s) cosine coefficients of the patches of x, continued beyond its border."""
    n, channels = x.shape[:2]
    wide = F.pad(x, border, mode="replicate").flatten(0, 1)[:, None]
    cut = patches.extract(wide).mT
    size = int(cut.shape[-1] ** 0.5 + 0.5)
    return dct2(cut.reshape(n, channels, -1, size, size))


def _put(parts: Tensor, patches: Patches, shape: tuple[int, int], size: int) -> Tensor:
    """(N, C, H, W): patches (N, C, L, s, s) summed up in their places."""
    n, channels = parts.shape[:2]
    put = patches.adjoint(parts.flatten(3).flatten(0, 1).mT, shape)
    return put.view(n, channels, *shape)[..., size - 1 : 1 - size or None, size - 1 : 1 - size or None]


def _continued(n: Tensor, inside: Tensor) -> Tensor:
    """Normals (N, 3, H, W) with those outside the mask continued by normalised convolutions, wider and wider."""
    if seen_everywhere(inside):
        return n
    result, known = n, inside
    for width in _WIDTHS:
        share, blurred = blur(inside.to(n), width), blur(torch.where(inside, n, 0), width)
        reached = share > _REACHED
        new = reached & ~known
        result = torch.where(new, blurred / torch.where(reached, share, 1), result)
        known = known | reached
    return result


def blur(x: Tensor, width: float) -> Tensor:
    """Gaussian of this width along both axes, 0 beyond the border."""
    for dim in (-1, -2):
        reach = min(int(4 * width), max(x.shape[dim] - 1, 0))
        at = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device)
        kernel = torch.exp(-0.5 * (at / width).square())
        kernel = (kernel / kernel.sum()).view((1, 1, 1, -1) if dim == -1 else (1, 1, -1, 1))
        padding = (0, reach) if dim == -1 else (reach, 0)
        x = F.conv2d(x.flatten(0, 1)[:, None], kernel, padding=padding)[:, 0].unflatten(0, x.shape[:2])
    return x
