"""Choices by predicted risk: how far to follow an estimate, and which of several, without knowing the surface.

All of it rests on one fact: the cosine coefficients of the least-squares height on a rectangle are the true ones plus
independent normal errors of known variance (`torchdls.noise.height_noise`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls.noise import height_noise
from torchdls.operators import dct2, idct2
from torchdls.operators.tables import table

_RATIO = 1.5  # of the frequencies that bound a band
_SECTORS = 4  # directions into which a band is divided
_FEW = 8  # bands below this frequency (in half periods per side) are whole rings
_FINE = 3.0  # modes whose Laplacian eigenvalue exceeds this (of 8) are left alone: averaged slopes hardly see them


def discrepancy_guard(
    height: Tensor, reference: Tensor, noise: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)
) -> Tensor:
    r"""Give back to a smoothed height what was taken from it beyond the noise, band by band.

        z + (1 - a_b) (z_ls - z)   in band b,   a_b = min(1, N_b / R_b)
        R_b = sum of |C_kl|^2 / S_kl over the band, C = dct2(z - z_ls);   N_b = sigma^2 (n_b + sqrt(2 n_b))

    R_b is the energy that was removed, in units of the noise that least squares leaves in each of the n_b
    coefficients; N_b is the most that the noise itself can account for, give or take one standard deviation. Where R_b
    exceeds it the difference is part surface, and a_b = N_b / R_b is then the best factor, in the sense of mean
    squares. Bands are rings of frequencies, divided into sectors of directions.

    Args:
        height: (N, 1, H, W) on a full rectangle.
        reference: (N, 1, H, W), the least-squares height of the same data, with equal trust in all slopes.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).

    Returns:
        (N, 1, H, W).
    """
    shape = (height.shape[-2], height.shape[-1])
    band = _bands(*shape, like=height).long().flatten()
    n_bands = int(_bands(*shape, like=height).max()) + 1
    variance = height_noise(shape, height, pixel_size)
    difference = dct2(height - reference)
    weight = torch.where(band.view(shape) > 0, 1 / torch.where(variance > 0, variance, 1), 0)
    removed = _band_sums((difference.square() * weight).flatten(1), band, n_bands)
    count = torch.bincount(band, minlength=n_bands).to(height.dtype)
    allowed = noise[:, None].square() * (count + (2 * count).sqrt())
    beyond = removed > allowed
    beyond[:, 0] = False
    share = torch.where(beyond, allowed / torch.where(beyond, removed, 1), 1)
    return reference + idct2(difference * share[:, band].view_as(height))


def _band_sums(energy: Tensor, band: Tensor, n_bands: int) -> Tensor:
    """(N, n_bands) sums of (N, H W) over the bands."""
    return energy.new_zeros(energy.shape[0], n_bands).index_add(1, band, energy)


@table
def _bands(h: int, w: int) -> Tensor:
    """(H, W) number of the band of each cosine mode; 0 for those that are left alone."""
    y, x = (torch.arange(n, dtype=torch.float64, device="cpu") for n in (h, w))
    radius = (y[:, None].square() * (w / h) + x.square() * (h / w)).sqrt()
    ring = 1 + (radius.clamp(min=1).log() / math.log(_RATIO)).floor()
    sector = (torch.atan2(y[:, None] * w, x * h) * (2 * _SECTORS / math.pi)).floor().clamp(max=_SECTORS - 1)
    band = ring * _SECTORS + torch.where(radius >= _FEW, sector, 0)
    eigenvalue = 4 * ((y * (math.pi / (2 * h))).sin().square()[:, None] + (x * (math.pi / (2 * w))).sin().square())
    return torch.where((radius > 0) & (eigenvalue <= _FINE), band, 0)


def probe(gradient: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Random signs (N, 2, H, W), the same for every surface, and a step (N, 1, 1, 1) small against the noise.

    The signs come from a generator of their own with a fixed seed, so that a choice made with them is deterministic.
    """
    generator = torch.Generator(device="cpu").manual_seed(0)
    signs = torch.randint(0, 2, gradient.shape[1:], generator=generator, device="cpu") * 2 - 1
    step = 0.1 * noise.detach()[:, None, None, None]
    return signs.to(gradient).expand_as(gradient), torch.where(step > 0, step, 1)


def sure_guard(height: Tensor, reference: Tensor, change: Tensor, moved: Tensor, noise: Tensor) -> Tensor:
    r"""Blend a height with the least-squares one in every band, by Stein's unbiased risk estimate.

        z_ls + a_b (z - z_ls) in band b,   a_b = -sigma^2 div_b / ||z - z_ls||_b^2, clipped to [0, 1]
        div_b = <A^+ n, change - A^+ n>_b

    minimises the unbiased estimate of the squared error in the band. div_b is the divergence of z - z_ls with respect
    to the noise of z_ls, by one probe n.

    Args:
        height: (N, 1, H, W), z, on a full rectangle.
        reference: (N, 1, H, W), the least-squares height.
        change: (N, 1, H, W), the derivative of z along the probe n of the gradient.
        moved: (N, 1, H, W), that of the least-squares height: A^+ n.
        noise: (N,) standard deviation of one gradient sample.

    Returns:
        (N, 1, H, W).

    Source: Stein (1981); Ramani, Blu, Unser, "Monte-Carlo SURE", IEEE TIP 17(9), 2008.
    """
    shape = (height.shape[-2], height.shape[-1])
    band = _bands(*shape, like=height).long().flatten()
    n_bands = int(_bands(*shape, like=height).max()) + 1
    difference, along, push = (dct2(x) for x in (height - reference, change - moved, moved))
    energy = _band_sums(difference.square().flatten(1), band, n_bands)
    divergence = _band_sums((along * push).flatten(1), band, n_bands)
    some = energy > 0
    share = (-noise[:, None].square() * divergence / torch.where(some, energy, 1)).clamp(0, 1)
    share = torch.where(some, share, 1).index_fill(1, torch.zeros(1, dtype=torch.int64, device=band.device), 1.0)
    return reference + idct2(difference * share[:, band].view_as(height))
