"""Noise to try methods on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls._checks import check_field, check_fit, check_numbers, require
from torchdls._precision import full_precision
from torchdls._tracing import holds_everywhere

_CUT = 3.0  # samples beyond so many standard deviations belong to the surface (creases, waves), not to the noise
_KEPT = math.erf(_CUT / math.sqrt(2))
_TRIMMED_VARIANCE = 1 - _CUT * math.sqrt(2 / math.pi) * math.exp(-_CUT * _CUT / 2) / _KEPT  # of a cut standard normal


@full_precision
def noise_sigma(gradient: Tensor, snr_db: float, mask: Tensor | None = None) -> Tensor:
    """Standard deviation of the noise on one gradient sample at a signal-to-noise ratio.

        SNR = 10 log10(||g||^2 / E||noise||^2),  E||noise||^2 = M sigma^2:  sigma = ||g|| 10^(-SNR/20) /
        sqrt(M)

    per surface, with ||g|| over both components and M samples (2 H W of them without a mask). The mean of g
    is not removed. With this definition plain least squares reproduces the DCTLS column of the paper's
    tables.

    Args:
        gradient: (N, 2, H, W), or (2, H, W).
        snr_db: the ratio in decibels.
        mask: (N, 1, H, W) bool, or (1, H, W): the pixels that count.

    Returns:
        (N,), or () for an unbatched gradient.

    Raises:
        TypeError: the gradient is not float32 or float64, or the mask is not bool.
        ValueError: the gradient has no two components, the shapes differ, a surface has no pixel in the mask, or
            `snr_db` is not finite.

    Example:
        >>> torchdls.noise_sigma(torch.ones(1, 2, 4, 4), snr_db=20)
        tensor([0.1000])
    """
    check_field("noise_sigma", "gradient", gradient, 2)
    check_numbers("noise_sigma", snr_db=snr_db)
    if not math.isfinite(snr_db):
        raise ValueError(f"snr_db: {snr_db} given, a finite number of decibels is needed")
    square = gradient.square()
    if mask is None:
        power = square.mean((-3, -2, -1))
    else:
        check_fit("noise_sigma", "mask", mask, gradient, "gradient", channels=(1,), dtype=torch.bool)
        some = holds_everywhere(mask.flatten(-3).any(-1))
        require(some, f"noise_sigma: mask {tuple(mask.shape)} is False everywhere on a surface")
        inside = mask.expand_as(gradient)
        power = torch.where(inside, square, 0).sum((-3, -2, -1)) / inside.sum((-3, -2, -1))
    return power.sqrt() * 10 ** (-snr_db / 20)


@full_precision
def add_noise(
    gradient: Tensor, snr_db: float, generator: torch.Generator | None = None, mask: Tensor | None = None
) -> Tensor:
    """Add white gaussian noise at a signal-to-noise ratio, independent in every sample and both components.

    The standard deviation is `noise_sigma(gradient, snr_db, mask)`, which also defines the ratio. The noise
    is drawn in float64 on the generator's device, so a seed means the same noise in float32 and float64.

    Args:
        gradient: (N, 2, H, W), or (2, H, W); not written to.
        snr_db: the ratio in decibels.
        generator: the source of randomness; None is PyTorch's default generator.
        mask: (N, 1, H, W) bool, or (1, H, W): the pixels over which the ratio is taken. Noise is added
            everywhere.

    Returns:
        The noisy gradient, in the shape and dtype of `gradient`.

    Raises:
        TypeError: as `noise_sigma`.
        ValueError: as `noise_sigma`.

    Example:
        >>> gradient = torch.ones(1, 2, 64, 64)
        >>> noisy = torchdls.add_noise(gradient, snr_db=20, generator=torch.Generator().manual_seed(0))
        >>> round(float((noisy - gradient).std()), 2)
        0.1
    """
    sigma = noise_sigma(gradient, snr_db, mask)
    source = "cpu" if generator is None else generator.device
    noise = torch.randn(gradient.shape, generator=generator, dtype=torch.float64, device=source)
    return gradient + sigma[..., None, None, None] * noise.to(gradient)
