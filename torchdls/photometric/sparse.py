"""Normals among outliers, pixel by pixel: sparse regression."""

from __future__ import annotations

from math import sqrt
from typing import Literal

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls.photometric.least_squares import lit_samples
from torchdls.photometric.model import _PAIRS, PhotometricResult, check, fit, result, shading

_LEAST, _PILOT = 0.01, 20  # least noise that is assumed, and iterations of the fit that tells it


@full_precision
def sparse_normals(
    images: Tensor,
    lights: Tensor,
    *,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    shadow: float | None = None,
    prior: Literal["bayes", "l1"] = "bayes",
    noise: float | Literal["auto"] = "auto",
    n_iter: int = 100,
) -> PhotometricResult:
    r"""Normals by a fit whose errors are sparse: shadows and highlights take few of the samples of a pixel.

        I = L b + e + noise

    "bayes" (sparse Bayesian learning) gives every error its own variance, e_k ~ N(0, gamma_k), and maximises the
    likelihood of I over the gamma by expectation-maximisation. With w_k = 1/(gamma_k + noise^2), b by least squares
    with weights w, M = sum_k w_k l_k l_k^T and r = I - L b, each step sets

        gamma_k <- (gamma_k w_k r_k)^2 + gamma_k - gamma_k^2 (w_k - w_k^2 l_k^T M^{-1} l_k)

    "l1" minimises sum_k sqrt(r_k^2 + noise^2), by iteratively reweighted least squares with w_k = 1/sqrt(r_k^2 +
    noise^2): convex, and less robust. Both treat each pixel alone and are unrolled in the derivative, in images and
    lights.

    Args:
        images: (N, K, H, W) or (K, H, W), one per light, K at least 3; to be robust, 8 or more.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read.
        lit: (N, K, H, W) bool, False where a sample must not be used.
        shadow: leave out samples of at most this part of the pixel's brightest, as `woodham` does; None leaves the
            shadows to the sparse errors.
        prior: "bayes" or "l1".
        noise: deviation of the dense noise, as a part of the root mean square of the surface's images, between 0 and 1;
            or "auto": 1.5 times the median residual of an "l1" fit, at least .01, held fixed in the derivative. Too
            little costs most: at 17 dB (.14) and 60 lights normals err by 3.6 degrees with .01, by 2.4 with "auto".
        n_iter: iterations, at least 1.

    Returns:
        PhotometricResult(normals, albedo, confidence, covariance).

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or an option is unknown or out of range.

    Source: Ikehata, Wipf, Matsushita, Aizawa, "Robust photometric stereo using sparse regression", CVPR 2012.

    Example:
        >>> normals = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](16).gradient)
        >>> lights = torchdls.ring_of_lights(12)
        >>> images = torchdls.render(normals, lights)
        >>> images[:, 0, 4:8, 4:8] += 1.0  # a highlight
        >>> methods = torchdls.woodham, torchdls.sparse_normals
        >>> [round(float((method(images, lights).normals - normals).abs().max()), 1) for method in methods]
        [0.3, 0.0]
    """
    samples = check("sparse_normals", images, lights, mask, lit)
    if prior not in ("bayes", "l1"):
        raise ValueError(f"sparse_normals: prior={prior!r} is unknown; choose 'bayes' or 'l1'")
    fits = noise == "auto" if isinstance(noise, str) else 0 < noise < 1
    if not fits or not isinstance(n_iter, int) or n_iter < 1:
        needed = "noise must be 'auto' or between 0 and 1, n_iter an integer of at least 1"
        raise ValueError(f"sparse_normals: noise={noise!r} and n_iter={n_iter!r} given, {needed}")
    if shadow is not None:
        samples = samples._replace(lit=lit_samples("sparse_normals", samples.images, samples.lit, shadow))
    images, used = _scaled(samples.images, samples.lit)
    level = (
        _level(images.detach(), used, samples.lights.detach()) if isinstance(noise, str) else images.new_tensor(noise)
    )
    b = (_bayes if prior == "bayes" else _l1)(images, used, samples.lights, level, n_iter)
    return result(b * _power(samples.images, samples.lit), samples)


def _power(images: Tensor, lit: Tensor | None) -> Tensor:
    """(N, 1, 1, 1) root mean square of the samples in use; 1 for black images."""
    count = images[0].numel() if lit is None else lit.sum((-3, -2, -1), keepdim=True).clamp(min=1)
    square = images.square().sum((-3, -2, -1), keepdim=True) / count
    return torch.where(square > 0, square, 1).sqrt()


def _scaled(images: Tensor, lit: Tensor | None) -> tuple[Tensor, Tensor]:
    """Images of root mean square 1, and the trust 0 or 1 in each sample."""
    used = torch.ones_like(images) if lit is None else lit.to(images.dtype)
    return images / _power(images, lit) * used, used


def _level(images: Tensor, used: Tensor, lights: Tensor) -> Tensor:
    """(N, 1, 1, 1), 1.5 times the noise by the median residual of a robust fit."""
    K = images.shape[1]  # to which three numbers are fitted
    b = _l1(images, used, lights, images.new_tensor(_LEAST), _PILOT)
    size = (images - shading(b, lights)).abs()
    noise = masked_median(size.flatten(1), used.flatten(1) > 0) / NORMAL_MEDIAN * sqrt(K / max(K - 3, 1))
    return (1.5 * noise).nan_to_num(_LEAST).clamp(_LEAST, 0.9)[:, None, None, None]


def _bayes(images: Tensor, used: Tensor, lights: Tensor, noise: Tensor, n_iter: int) -> Tensor:
    """Images of root mean square 1 in, b out."""
    gamma = torch.ones_like(images)
    for _ in range(n_iter):
        weight = used / (gamma + noise**2)
        b, inverse = fit(images, lights, weight)
        error = gamma * weight * (images - shading(b, lights))
        leverage = weight * _quadratic(inverse, lights)
        gamma = error.square() + gamma * (1 - gamma * weight * (1 - leverage)).clamp(min=0)
    return fit(images, lights, used / (gamma + noise**2))[0]


def _l1(images: Tensor, used: Tensor, lights: Tensor, noise: Tensor, n_iter: int) -> Tensor:
    b, _ = fit(images, lights, used)
    for _ in range(n_iter):
        residual = images - shading(b, lights)
        b, _ = fit(images, lights, used * (residual.square() + noise**2).rsqrt())
    return b


def _quadratic(m: Tensor, lights: Tensor) -> Tensor:
    """l_k^T M l_k for every light: (N, 6, H, W) -> (N, K, H, W)."""
    outer = torch.stack([(1 + (i != j)) * lights[..., i] * lights[..., j] for i, j in _PAIRS], -1)
    return torch.einsum("nka,nahw->nkhw", outer.expand(m.shape[0], -1, -1), m)
