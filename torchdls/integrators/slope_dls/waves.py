"""What patches cannot see: waves longer than they are; and how far to trust a smoothed height as a whole."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_field, check_fit
from torchdls._precision import full_precision
from torchdls.noise import height_noise
from torchdls.operators import dct2, idct2
from torchdls.operators.modes import Boundary, half_periods, mode_eigenvalues, to_modes

_THRESHOLDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)
_TEMPERATURE = 8.0  # of the mean over the thresholds, in units of the noise of one mode: few modes make SURE scatter
_LEAST_CUT = 0.2  # share of the risk of least squares that must go, as predicted, for anything to be changed


@full_precision
def shrink_slow_waves(
    height: Tensor,
    reference: Tensor,
    noise: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    period: float = 32.0,
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Shrink the cosine modes of long period by what their least-squares coefficients say of signal and noise.

        C_k -> f_k C_k,   f_k = sum_T p_T max(0, 1 - T^2 s_k^2 / x_k^2),   p_T ~ exp(-R_T / 8)
        R_T = sum_k (min(x^2, T^4 s^4 / x^2) + 2 s^2 (1 + T^2 s^2 / x^2) [|x| > T s] - s^2) / s^2

    x_k is the coefficient of mode k in the orthonormal basis of the fields that have a surface (L_k^(1/2) dct2(z_ls)_k,
    L_k the eigenvalue of the Laplacian), s_k its noise; R_T is Stein's unbiased estimate of the risk of threshold T,
    with s_k^2 in the denominator replaced by its mean. The thresholds 0, 1/2, .. 5/2 are averaged rather than chosen
    among, since the risk of few modes scatters. `SlopeDLS` ends with it; any other height of patches gains too.

    Args:
        height: (N, 1, H, W), on a full rectangle.
        reference: (N, 1, H, W), the least-squares height of the same data, with equal trust in all slopes.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).
        period: in pixels; modes of longer period are shrunk.
        boundary: "neumann", or "periodic" for a surface that repeats. Its modes are those of the Fourier transform, of
            two coefficients each: x_k^2 is their mean square, and (1 + T^2 s^2 / x^2) in R_T becomes 1.

    Returns:
        (N, 1, H, W); differentiable, with the p_T held fixed.

    Raises:
        TypeError: a tensor is not float32 or float64, or they differ in it.
        ValueError: a shape does not fit.

    Source: the shrinkage after Karacali, Snyder, IEEE TIP 13(2), 2004; the mean after Leung, Barron, IEEE Trans. IT
    52(8), 2006.

    Example:
        >>> surface = torchdls.SURFACES["tent"](64)
        >>> noisy = torchdls.add_noise(surface.gradient, 5, torch.Generator().manual_seed(0))
        >>> height, reference = torchdls.DLS(n_iter=10)(noisy), torchdls.LeastSquares()(noisy)
        >>> smoother = torchdls.shrink_slow_waves(height, reference, torchdls.noise_level(noisy))
        >>> [round(float(torchdls.rmse(z, surface.height)), 1) for z in (height, smoother)]
        [0.7, 0.5]
    """
    check_field("shrink_slow_waves", "height", height, 1)
    check_fit("shrink_slow_waves", "reference", reference, height, "height", channels=(1,))
    check_alike("shrink_slow_waves", "noise", noise, height.dtype)
    if height.ndim != 4 or noise.shape != height.shape[:1]:
        shapes = f"height {tuple(height.shape)} and noise {tuple(noise.shape)}"
        raise ValueError(f"shrink_slow_waves: {shapes} given, (N, 1, H, W) and (N,) are needed")
    shape = (height.shape[-2], height.shape[-1])
    slow = slow_modes(shape, shape, period, height, boundary)
    eigenvalue = mode_eigenvalues(shape, height, pixel_size, boundary)
    s2 = noise.square()[:, None, None, None] * height_noise(shape, height, pixel_size, boundary) * eigenvalue
    if boundary == "periodic":  # a sine and a cosine share their fate, or waves would shift
        x2 = _power(torch.fft.fft2(reference, norm="ortho")) * eigenvalue
        return torch.fft.ifft2(torch.fft.fft2(height) * slow_factors(x2, s2, slow, two=True)).real
    x2 = dct2(reference).square() * eigenvalue
    return idct2(dct2(height) * slow_factors(x2, s2, slow))


def slow_factors(x2: Tensor, s2: Tensor, slow: Tensor, two: bool = False) -> Tensor:
    """f_k of `shrink_slow_waves`, 1 for modes that are not slow.

    Args:
        x2: (N, 1, h, w) squares of the coefficients, of all modes or of the first ones that hold all slow ones.
        s2: (N, 1, h, w), their variances.
        slow: (h, w) bool.
        two: whether each mode has two coefficients.
    """
    seen = slow & (x2 > 0)
    ratio = torch.where(seen, s2 / torch.where(seen, x2, 1), 0)
    risks = torch.stack([_risk(x2.detach(), s2.detach(), ratio.detach(), slow, t, two) for t in _THRESHOLDS])
    share = torch.softmax(-risks / _TEMPERATURE, 0)
    factor = torch.stack([(1 - t * t * ratio).clamp(min=0) for t in _THRESHOLDS])
    mean = (share[..., None, None, None] * factor).sum(0)
    return torch.where(slow, mean, 1)


def cautious(
    height: Tensor,
    reference: Tensor,
    removed_by: Tensor,
    noise: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    moved: Tensor | None = None,
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Return to least squares where hardly any of its noise was found.

        z_ls + r (z - z_ls),   r = clip(5 q - 1, 0, 1),   q = sum |D|^2 S^-1/4 / (sigma^2 sum S^3/4)

    with D = dct2(z' - z_ls), z' the height that found the noise. For a blend by SURE, q is about the share of the risk
    that it is predicted to remove; where a method keeps most of what least squares says, as on texture, what little it
    changes is as likely wrong as right.

    Args:
        height: (N, 1, H, W), on a full rectangle.
        reference: (N, 1, H, W), the least-squares height.
        removed_by: (N, 1, H, W), z'.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).
        moved: (N, 1, H, W), what noise of random signs leaves in the least-squares height, from which the denominator
            is estimated where there is a mask; None for a full rectangle.
        boundary: "neumann" or "periodic".

    Returns:
        (N, 1, H, W); r is held fixed in derivatives.
    """
    variance = height_noise((height.shape[-2], height.shape[-1]), height, pixel_size, boundary)
    weight = torch.where(variance > 0, torch.where(variance > 0, variance, 1).pow(-0.25), 0)
    removed = (weight * to_modes((removed_by - reference).detach(), boundary).square()).sum((-3, -2, -1))
    left = variance if moved is None else to_modes(moved.detach(), boundary).square()
    share = share_followed(removed, noise.detach().square() * (weight * left).sum((-2, -1)).flatten())
    return reference + share[:, None, None, None] * (height - reference)


def share_followed(removed: Tensor, risk: Tensor) -> Tensor:
    """r of `cautious` (N,), from the numerator and the denominator of q."""
    share = torch.where(risk > 0, removed / torch.where(risk > 0, risk, 1), 0)
    return (share / _LEAST_CUT - 1).clamp(0, 1)


def slow_modes(
    part: tuple[int, int], shape: tuple[int, int], period: float, like: Tensor, boundary: Boundary = "neumann"
) -> Tensor:
    """Bool of the first (h, w) modes of a surface (H, W): those of longer period, without the mean."""
    rows, columns = (
        (half_periods(n, boundary)[:k] / (2 * n)).to(like.device) for k, n in zip(part, shape, strict=True)
    )
    frequency = (rows.square()[:, None] + columns.square()).sqrt()
    return (frequency > 0) & (frequency < 1 / period)


def _power(spectrum: Tensor) -> Tensor:
    return spectrum.real.square() + spectrum.imag.square()


def _risk(x2: Tensor, s2: Tensor, ratio: Tensor, slow: Tensor, threshold: float, two: bool = False) -> Tensor:
    """(N,) Stein's estimate over the slow modes, in units of their mean noise; of one coefficient each, or of two."""
    t2 = threshold * threshold
    above = t2 * ratio < 1
    loss = (
        torch.where(above, t2 * t2 * s2 * ratio, x2)
        + torch.where(above, 2 * s2 * (1 + (0 if two else t2 * ratio)), 0)
        - s2
    )
    total = (slow * s2).sum((-3, -2, -1)) / slow.sum().clamp(min=1)
    return (slow * loss).sum((-3, -2, -1)) / torch.where(total > 0, total, 1)
