r"""What the methods share: the Lambertian model I_k = max(0, l_k . b), b = albedo * normal, and its least squares.

Images are (N, K, H, W), one channel per light; colour images are averaged to grey at the door. Lights are (K, 3), or
(N, K, 3) for each surface of a batch: x right, y up, z to the viewer, and the length is the strength of the light.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_fit, check_real
from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls._tracing import holds_everywhere

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # the entries of a symmetric 3 x 3 matrix that are kept
_RANK = 1e-6  # a pivot below this part of its diagonal means that the lights do not span the space
_ORDINARY = 2.5  # residuals up to so many deviations say nothing about their pixel
_FACING = 1e-2  # smallest cosine to the viewer of a normal that has slopes, as in `normals_to_gradient`


class PhotometricResult(NamedTuple):
    r"""Normals and what belongs to them; batched as the images.

    Attributes:
        normals: (N, 3, H, W), canonical (x right, y up, z to the viewer), of length 1; 0 where they are unknown
            (outside the mask, or without three lights that span the space): `normals_to_gradient` calls them invalid.
        albedo: (N, 1, H, W), for lights of length 1 the brightness under a light along the normal; 0 where unknown.
        confidence: (N, 1, H, W), at least 0, for use as the `weight` of an integrator: 1 / variance of the slopes, in
            units that make its mean 1 over the pixels where it is positive. The variance of sample k is
            s^2 + max(0, r_k^2 - 6.25 s^2) with r_k its residual from the Lambertian model and s their robust scale on
            the whole surface: ordinary noise leaves it as it is, and pixels that are dark, steep, lit by few lights or
            not Lambertian weigh less. 0 where there are no slopes.
        covariance: (N, 6, H, W), of the errors of the normals, as the entries xx, xy, xz, yy, yz, zz of a symmetric
            matrix: K / (K - 3) (I - n n^T) (\sum_k l_k l_k^T / var_k)^{-1} (I - n n^T) / albedo^2, with the variances
            of the confidence and a factor for the three numbers fitted to K samples. 0 where the normal is unknown.
            With three samples nothing is left to tell the noise by. `slope_noise` carries it on to slopes.

    Example:
        >>> normals = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](16).gradient)
        >>> lights = torchdls.ring_of_lights(10)
        >>> result = torchdls.woodham(torchdls.render(normals, lights), lights)
        >>> result.normals.shape, result.confidence.shape, result.covariance.shape
        (torch.Size([1, 3, 16, 16]), torch.Size([1, 1, 16, 16]), torch.Size([1, 6, 16, 16]))
    """

    normals: Tensor
    albedo: Tensor
    confidence: Tensor
    covariance: Tensor


class Samples(NamedTuple):
    """Checked input, batched: images (N, K, H, W), 0 where not lit; lights (N or 1, K, 3); lit (N, K, H, W) or None."""

    images: Tensor
    lights: Tensor
    lit: Tensor | None
    batched: bool


def check(
    name: str, images: Tensor, lights: Tensor, mask: Tensor | None, lit: Tensor | None, least: int = 3
) -> Samples:
    """The arguments of a method as `Samples`, of at least so many lights; errors say what came and what is needed."""
    check_real(name, "images", images)
    shape = tuple(images.shape)
    if images.ndim not in (3, 4) or shape[-3] < least or 0 in shape:
        needed = f"(N, K, H, W) or (K, H, W) of at least K = {least} lights"
        raise ValueError(f"{name}: images {shape} given, {needed} is needed")
    lights = check_lights(name, lights, images)
    for label, field, channels in (("mask", mask, 1), ("lit", lit, shape[-3])):
        if field is not None:
            check_fit(name, label, field, images, "images", channels=(channels,), dtype=torch.bool)
    inside = mask if lit is None else lit if mask is None else mask & lit
    batched = images.ndim == 4
    if not batched:
        images, inside = images[None], None if inside is None else inside[None]
    if inside is not None:
        inside = inside.expand(images.shape)
        images = torch.where(inside, images, 0)
    if not holds_everywhere(images.detach().isfinite()):
        where = "" if inside is None else " where the mask and lit are True"
        raise ValueError(f"{name}: images {shape} holds NaN or infinite values{where}")
    return Samples(images, lights, inside, batched)


def check_lights(name: str, lights: Tensor, like: Tensor, count: int | None = None) -> Tensor:
    """The lights as (N or 1, K, 3), on the device and in the dtype of the field they belong to."""
    check_real(name, "lights", lights)
    n = like.shape[0] if like.ndim == 4 else 1
    k = like.shape[-3] if count is None else count
    if tuple(lights.shape) not in {(k, 3), (1, k, 3), (n, k, 3)}:
        raise ValueError(f"{name}: lights {tuple(lights.shape)} given, ({k}, 3) or ({n}, {k}, 3) is needed")
    if not holds_everywhere(lights.detach().isfinite()):
        raise ValueError(f"{name}: lights {tuple(lights.shape)} holds NaN or infinite values")
    return lights.to(like).reshape(-1, k, 3)


def count_of(lights: Tensor) -> int:
    """How many lights there are, where nothing else says how many there should be; 0 where they are none."""
    return lights.shape[-2] if isinstance(lights, Tensor) and lights.ndim > 1 else 0


def shading(b: Tensor, lights: Tensor) -> Tensor:
    """l_k . b for every light: (N, 3, H, W) -> (N, K, H, W)."""
    return torch.einsum("nkc,nchw->nkhw", lights.expand(b.shape[0], -1, -1), b)


def covariance(lights: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    r"""(\sum_k w_k l_k l_k^T)^{-1} as its six entries (N or 1, 6, H or 1, W or 1), and where it exists.

    By the factors of Cholesky, so that weights of very different size do no harm. Without weights, w = 1.
    """
    outer = torch.stack([lights[..., i] * lights[..., j] for i, j in _PAIRS], -1)
    if weight is None:
        m = outer.sum(1)[..., None, None]
    else:
        m = torch.einsum("nka,nkhw->nahw", outer.expand(weight.shape[0], -1, -1), weight)
    m00, m01, m02, m11, m12, m22 = m.split(1, 1)
    some = m00 > 0
    d0 = torch.where(some, m00, 1)
    a, b = m01 / d0, m02 / d0
    d1 = m11 - a * m01
    some = some & (d1 > _RANK * m11)
    d1 = torch.where(some, d1, 1)
    c = (m12 - a * m02) / d1
    d2 = m22 - b * m02 - c.square() * d1
    some = some & (d2 > _RANK * m22)
    d2 = torch.where(some, d2, 1)
    e = a * c - b
    i00 = 1 / d0 + a.square() / d1 + e.square() / d2
    i11 = 1 / d1 + c.square() / d2
    return torch.cat([i00, -a / d1 - c * e / d2, e / d2, i11, -c / d2, 1 / d2], 1), some


def fit(images: Tensor, lights: Tensor, weight: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""argmin_b \sum_k w_k (I_k - l_k . b)^2 at every pixel: b (N, 3, H, W), and its `covariance`; 0 where unknown."""
    inverse, some = covariance(lights, weight)
    weighted = images if weight is None else weight * images
    right = torch.einsum("nkc,nkhw->nchw", lights.expand(images.shape[0], -1, -1), weighted)
    return torch.where(some, multiply(inverse, right), 0), inverse


def multiply(m: Tensor, x: Tensor) -> Tensor:
    """Symmetric 3 x 3 matrices (N, 6, H, W) times vectors (N, 3, H, W)."""
    m00, m01, m02, m11, m12, m22 = m.split(1, 1)
    x0, x1, x2 = x.split(1, 1)
    return torch.cat(
        [m00 * x0 + m01 * x1 + m02 * x2, m01 * x0 + m11 * x1 + m12 * x2, m02 * x0 + m12 * x1 + m22 * x2], 1
    )


def result(b: Tensor, samples: Samples) -> PhotometricResult:
    """Normals, albedo, confidence and covariance of b = albedo * normal."""
    square = b.square().sum(1, keepdim=True)
    known = square > 0
    albedo = torch.where(known, torch.where(known, square, 1).sqrt(), 0)
    normals = b / torch.where(known, albedo, 1)
    inverse, some, freedom = _noise(b, albedo, samples)
    trust = _confidence(b, albedo, inverse, some)
    spread = tangent_covariance(normals, albedo, inverse, some) * freedom
    found = PhotometricResult(normals, albedo, trust, spread)
    return found if samples.batched else PhotometricResult(*(t[0] for t in found))


def _noise(b: Tensor, albedo: Tensor, samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    """Covariance of b as its six entries (N, 6, H, W), where it is known, and a factor (N, 1, 1, 1) on it.

    Three numbers are fitted to K samples, so residuals are smaller than noise: by (K - 3) / K in variance.
    """
    residual = samples.images - shading(b, samples.lights)
    known = albedo > 0 if samples.lit is None else (albedo > 0) & samples.lit
    scale = _scale(residual, samples.images, known.expand_as(residual))
    beyond = (residual.square() - (_ORDINARY * scale).square()).clamp(min=0)
    pixels = (albedo > 0).sum((-3, -2, -1), keepdim=True).clamp(min=1)
    used = known.expand_as(residual).sum((-3, -2, -1), keepdim=True) / pixels
    freedom = torch.where(used > 3, used / (used - 3).clamp(min=1), 1).to(b.dtype)
    return *covariance(samples.lights, torch.where(known, 1 / (scale.square() + beyond), 0)), freedom


def tangent_covariance(normals: Tensor, albedo: Tensor, inverse: Tensor, some: Tensor) -> Tensor:
    """(N, 6, H, W): P C P / albedo^2 of the covariance C of albedo * normal, with P = I - n n^T; 0 where unknown."""
    some = some & (albedo > 0)
    across = multiply(inverse, normals)  # C n
    along = (normals * across).sum(1, keepdim=True)  # n^T C n
    lean = across - along / 2 * normals  # P C P = C - n lean^T - lean n^T
    entries = [normals[:, i] * lean[:, j] + lean[:, i] * normals[:, j] for i, j in _PAIRS]
    left = inverse - torch.stack(entries, 1)
    return torch.where(some, left / torch.where(some, albedo, 1).square(), 0)


def _confidence(b: Tensor, albedo: Tensor, inverse: Tensor, some: Tensor) -> Tensor:
    """(N, 1, H, W): 1 / variance of the slopes, of mean 1."""
    c00, _, c02, c11, c12, c22 = inverse.split(1, 1)
    some = some & (b[:, 2:] > _FACING * albedo)
    depth = torch.where(some, b[:, 2:], 1)
    p, q = -b[:, :1] / depth, b[:, 1:2] / depth
    variance = (c00 + 2 * p * c02 + p.square() * c22) + (c11 - 2 * q * c12 + q.square() * c22)
    trust = torch.where(some, depth.square() / torch.where(some, variance, 1), 0)
    count = some.sum((-3, -2, -1), keepdim=True).clamp(min=1)
    mean = trust.sum((-3, -2, -1), keepdim=True) / count
    return trust / torch.where(mean > 0, mean, 1)


def _scale(residual: Tensor, images: Tensor, known: Tensor) -> Tensor:
    """(N, 1, 1, 1) robust deviation of the residuals, at least a thousandth of the rms of the images; 1 if all is 0."""
    count = known.sum((-3, -2, -1)).clamp(min=1)
    scale = masked_median(residual.abs().flatten(1), known.flatten(1)) / NORMAL_MEDIAN
    power = torch.where(known, images.square(), 0).sum((-3, -2, -1)) / count
    least = torch.where(power > 0, 1e-3 * torch.where(power > 0, power, 1).sqrt(), 1)
    return torch.maximum(scale, least)[:, None, None, None]
