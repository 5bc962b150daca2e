"""Noise of normal maps: how large it is, and its removal by sparse coding of the three components together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._checks import check_alike, check_field, check_fit, require
from torchdls._precision import full_precision
from torchdls.dictionary.normals import code_normals, curl_noise
from torchdls.geometry.cameras import apply_matrix, check_camera, inverse_camera, pixel_grid
from torchdls.geometry.conventions import NORMAL_CONVENTIONS, inverse_axes, lookup, permute


class CodedNormals(NamedTuple):
    """What `denoise_normals` returns.

    Attributes:
        normals: as they came, of length 1 inside the mask and 0 outside.
        sigma: (N,) or (), noise of the normals that came: radians, per tangential component (the root mean square of
            the angle is sqrt(2) times that).

    Example:
        >>> coded = torchdls.denoise_normals(torch.tensor([0.0, 0.6, 0.8]).view(1, 3, 1, 1).expand(1, 3, 8, 8))
        >>> coded.normals.shape, float(coded.sigma)
        (torch.Size([1, 3, 8, 8]), 0.0)
    """

    normals: Tensor
    sigma: Tensor


@full_precision
def denoise_normals(
    normals: Tensor,
    mask: Tensor | None = None,
    sigma: Tensor | float | None = None,
    *,
    convention: str = "opengl",
    camera: Tensor | None = None,
    patch_sizes: Sequence[int] = (6, 12, 24),
) -> CodedNormals:
    r"""Remove the noise of a normal map, before it becomes slopes.

    The noise of normals is nearly the same everywhere, that of slopes is not, and the slope of a noisy normal is biased
    where the surface is steep. So the unit normals are coded, their three components x together. Overlapping patches
    of 6, 12, 24 pixels have cosine coefficients c (3 each); twice,

        1. kept are those with |c|^2 > (1.8 sqrt(2) sigma)^2, and the mean; a patch with K kept weighs 1 / (1 + K);
        2. each is multiplied by g = e / (e + sigma^2), e = |c|^2 / 2 of the first estimate; weight 1 / sum g^2;

    the weighted estimates are averaged, and scaled to length 1. Outside the mask normals are continued by normalised
    convolutions. Normals that noise has turned away from the viewer are kept and take part. Leave it to the caller to
    drop what still faces away (`normals_to_gradient` does).

    Differentiable, with the choice of coefficients held fixed; `sigma` takes part if it is a tensor that is given.

    Args:
        normals: (N, 3, H, W) or (3, H, W), float32 or float64; their length is not read.
        mask: (N, 1, H, W) bool, the valid pixels; None for all. What is not finite is left out.
        sigma: noise in radians per tangential component: a number or (N,). None reads it from the curl of the slopes
            in face-on cells (`normal_noise`).
        convention: one of `NORMAL_CONVENTIONS`; for the curl alone.
        camera: intrinsics K, (3, 3) or (N, 3, 3), of a perspective view; for the curl alone.
        patch_sizes: sides of the patches; those that do not fit the image are left out.

    Returns:
        `CodedNormals(normals, sigma)`.

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: a shape, the convention, the camera, sigma or a patch size is not usable.

    Source: thresholds after Donoho, Johnstone (1994); two passes after Dabov, Foi, Katkovnik, Egiazarian, "Image
    denoising by sparse 3-D transform-domain collaborative filtering" (2007).

    Example:
        >>> true = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](48).gradient)
        >>> noise = 0.1 * torch.randn(true.shape, generator=torch.Generator().manual_seed(0))
        >>> noisy = torch.nn.functional.normalize(true + noise, dim=1)
        >>> coded = torchdls.denoise_normals(noisy)
        >>> bool((coded.normals - true).norm() < 0.5 * (noisy - true).norm())
        True
    """
    name = "denoise_normals"
    n, inside = _checked(name, normals, mask, convention)
    sizes = _sizes(name, patch_sizes, n)
    if camera is not None:
        check_camera(camera, normals)
    if sigma is not None and not isinstance(sigma, int | float):
        check_alike(name, "sigma", sigma, normals.dtype)
        shape = tuple(sigma.shape)
        require(shape in {(), (1,), (len(n),)}, f"{name}: sigma {shape} given, (N,) or a number is needed")
    if sigma is None:
        found = _noise(n, inside, convention, camera)
    else:
        found = torch.as_tensor(sigma, dtype=n.dtype, device=n.device)
        if found.numel() not in (1, len(n)) or not bool((found >= 0).all()):
            raise ValueError(f"{name}: sigma {sigma!r} given, a number of at least 0 or one for each surface is needed")
        found = found.reshape(-1).expand(len(n))
    coded = code_normals(n, inside, found, sizes)
    single = normals.ndim == 3
    return CodedNormals(coded[0] if single else coded, found[0] if single else found)


@full_precision
def normal_noise(
    normals: Tensor, mask: Tensor | None = None, *, convention: str = "opengl", camera: Tensor | None = None
) -> Tensor:
    r"""Noise of a normal map: radians per tangential component.

    Slopes of a surface have no curl, so what curl there is over 2 x 2 pixels comes from noise (and from jumps, which
    are few). Noise sigma of a normal gives slopes p the covariance sigma^2 (1 + |p|^2) (1 + p p^T), so that

        sigma = median |curl| / sqrt(mean (1 + |p|^2) (2 + |p|^2)) / 0.6745

    over the cells whose four normals are face-on (cosine above 0.6, or above the median where few are); with a camera,
    the covariance is that of slopes of log depth.

    Args:
        normals: (N, 3, H, W) or (3, H, W).
        mask: (N, 1, H, W) bool, the valid pixels; None for all.
        convention: one of `NORMAL_CONVENTIONS`.
        camera: intrinsics K of a perspective view.

    Returns:
        (N,) or (); 0 without a cell. Raises as `denoise_normals` does.

    Example:
        >>> true = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](64).gradient)
        >>> noise = 0.1 * torch.randn(true.shape, generator=torch.Generator().manual_seed(0))
        >>> bool(0.08 < torchdls.normal_noise(true + noise) < 0.12)
        True
    """
    n, inside = _checked("normal_noise", normals, mask, convention)
    found = _noise(n, inside, convention, camera)
    return found[0] if normals.ndim == 3 else found


def _checked(name: str, normals: Tensor, mask: Tensor | None, convention: str) -> tuple[Tensor, Tensor]:
    """Unit normals (N, 3, H, W), 0 outside the mask, and the mask (N, 1, H, W)."""
    check_field(name, "normals", normals, 3)
    lookup(NORMAL_CONVENTIONS, "convention", convention)
    if mask is not None:
        check_fit(name, "mask", mask, normals, "normals", channels=(1,), dtype=torch.bool)
    n = normals if normals.ndim == 4 else normals[None]
    inside = n.isfinite().all(1, keepdim=True) & (n != 0).any(1, keepdim=True)
    if mask is not None:
        inside = inside & (mask if mask.ndim == 4 else mask[None])
    return F.normalize(torch.where(inside, n, 0), dim=1), inside


def _sizes(name: str, sizes: Sequence[int], n: Tensor) -> list[int]:
    if not sizes or not all(isinstance(s, int) and s >= 2 for s in sizes):
        raise ValueError(f"{name}: patch_sizes={sizes!r} given, integers of at least 2 are needed")
    return [s for s in sizes if s <= max(n.shape[-2:])] or [min(sizes)]


def _noise(n: Tensor, inside: Tensor, convention: str, camera: Tensor | None) -> Tensor:
    """(N,) from unit normals."""
    n = permute(n, NORMAL_CONVENTIONS[convention])
    if camera is None:
        b, c = torch.cat([-n[:, :1], n[:, 1:2]], 1), n[:, 2:]
        return curl_noise(b, c, inside)
    k_inv = inverse_camera(camera, n)
    ray = apply_matrix(k_inv, pixel_grid(n))
    toward = permute(n, inverse_axes(NORMAL_CONVENTIONS["opencv"]))
    return curl_noise(toward[:, :2], -(toward * ray).sum(1, keepdim=True), inside, ray)
