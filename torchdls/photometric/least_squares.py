"""Woodham's least squares over the lights that reach each pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.photometric.model import PhotometricResult, check, fit, result


@full_precision
def woodham(
    images: Tensor,
    lights: Tensor,
    *,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    shadow: float | None = 0.05,
) -> PhotometricResult:
    r"""Normals by least squares over the images in which a pixel is lit.

        b = argmin \sum_{k lit} (I_k - l_k . b)^2,   albedo = |b|,   normal = b / |b|

    A sample counts as lit unless `lit` says otherwise or it is at most `shadow` times the pixel's brightest one. Cheap
    and, for gaussian noise, as accurate as any; for highlights see `low_rank_normals` and `sparse_normals`.
    Differentiable in images and lights, the choice of samples held fixed.

    Args:
        images: (N, K, H, W) or (K, H, W), one per light, K at least 3.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read.
        lit: (N, K, H, W) bool, False where a sample must not be used, such as a known shadow.
        shadow: from 0 to below 1; None uses every sample, as the paper's experiment does.

    Returns:
        PhotometricResult(normals, albedo, confidence, covariance).

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or `shadow` is out of range.

    Source: Woodham, "Photometric method for determining surface orientation from multiple images", 1980.

    Example:
        >>> normals = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](16).gradient)
        >>> lights = torchdls.ring_of_lights(12)
        >>> images = torchdls.render(normals, lights)
        >>> float((torchdls.woodham(images, lights).normals - normals).abs().max()) < 0.01
        True
    """
    samples = check("woodham", images, lights, mask, lit)
    if shadow is not None:
        samples = samples._replace(lit=lit_samples("woodham", samples.images, samples.lit, shadow))
    used = None if samples.lit is None else samples.lit.to(samples.images.dtype)
    b, _ = fit(samples.images, samples.lights, used)
    return result(b, samples)


def lit_samples(name: str, images: Tensor, lit: Tensor | None, shadow: float) -> Tensor:
    """(N, K, H, W) bool: the samples above `shadow` times the brightest one of their pixel, of those that are lit."""
    if not 0 <= shadow < 1:
        raise ValueError(f"{name}: shadow={shadow!r} given, a number from 0 to below 1, or None, is needed")
    bright = images.detach() > shadow * images.detach().amax(1, keepdim=True).clamp(min=0)
    return bright if lit is None else torch.logical_and(bright, lit)
