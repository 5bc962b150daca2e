r"""Photometric stereo by dictionary learning: images cleaned before the fit, or normals regularised by it.

    DLPI   min over X, D, B   1/2 ||Y - X||^2   + lam ( \sum_j ||P_j X - D b_j||^2 + mu^2 ||B||_0 )
    DLNV   min over N, D, B   1/2 ||Y - L N||^2 + lam ( \sum_j ||P_j N - D b_j||^2 + mu^2 ||B||_0 )

with ||d_i|| = 1. Patches hold all images, or all three channels of the map of albedo times normal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.dictionary import SoupDIL, dct_dictionary
from torchdls.operators import Patches
from torchdls.photometric.least_squares import lit_samples
from torchdls.photometric.model import PhotometricResult, Samples, check, fit, result, shading

_LEARNER = SoupDIL("block")
Auto = Literal["auto"]


@full_precision
def dlpi_normals(
    images: Tensor,
    lights: Tensor,
    *,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    shadow: float | None = None,
    patch_size: int = 8,
    stride: int = 2,
    lam: float = 0.5,
    mu: float | Auto = "auto",
    n_iter: int = 10,
) -> PhotometricResult:
    r"""Normals from images that a dictionary has cleaned of noise: dictionary learning with preprocessed images.

        min over X, D, B   1/2 ||Y - X||^2 + lam ( \sum_j ||P_j X - D b_j||^2 + mu^2 ||B||_0 )

    over patches of patch_size x patch_size pixels and all K images, then `woodham` on X. The first atoms are cosines
    over the pixels times an orthonormal basis of the span of the lights, since matte images are combinations of those.
    Each iteration is one sweep of SOUP-DIL (`torchdls.SoupDIL`) and the exact
    X = (Y + 2 lam fold(D B)) / (1 + 2 lam c), c patches holding a pixel. Pixels outside the mask, and samples that are
    not lit, take the value of the patches. Differentiable (unrolled).

    Args:
        images: (N, K, H, W) or (K, H, W), one per light.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read.
        lit: (N, K, H, W) bool, False where a sample must not be used.
        shadow: leave out samples of at most this part of the pixel's brightest in the last fit; None for none.
        patch_size: side of the patches.
        stride: step between patches.
        lam: weight of the patches, at least 0.
        mu: threshold of the codes, or "auto": 2.5 times the noise of the images, which is the root mean square residual
            of least squares.
        n_iter: iterations, at least 0.

    Returns:
        PhotometricResult(normals, albedo, confidence, covariance).

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or an option is out of range.

    Source: Wagenmaker, Moore, Nadakuditi, "Robust photometric stereo via dictionary learning", IEEE Transactions on
    Computational Imaging, 2018 (DLPI).

    Example:
        >>> surface, lights = torchdls.SURFACES["tent"](32), torchdls.ring_of_lights(8)
        >>> normals = torchdls.gradient_to_normals(surface.gradient)
        >>> noisy = torchdls.render(normals, lights, snr_db=10, generator=torch.Generator().manual_seed(0))
        >>> plain, found = (method(noisy, lights, shadow=None).normals
        ...                 for method in (torchdls.woodham, torchdls.dlpi_normals))
        >>> bool((found - normals).norm() < 0.7 * (plain - normals).norm())
        True
    """
    samples, patches = _checked("dlpi_normals", images, lights, mask, lit, patch_size, stride, lam, mu, n_iter)
    Y, live = samples.images, samples.lit
    level = 2.5 * _noise(samples) if isinstance(mu, str) else Y.new_full((len(Y),), mu)
    c = 2 * lam * patches.coverage(Y.shape, dtype=Y.dtype, device=Y.device)
    trust = torch.ones_like(Y) if live is None else live.to(Y.dtype)

    def update(folded: Tensor) -> Tensor:
        total = trust + c
        return (trust * Y + 2 * lam * folded) / torch.where(total > 0, total, 1)

    start = _filled(Y, live)
    X = _denoise(start, update, patches, _matte(samples.lights), level, n_iter)
    inside = live if shadow is None else lit_samples("dlpi_normals", Y, live, shadow)
    clean = samples._replace(images=X if live is None else torch.where(live, X, 0), lit=inside)
    b, _ = fit(clean.images, clean.lights, None if inside is None else inside.to(X.dtype))
    return result(b, samples._replace(lit=inside))


@full_precision
def dlnv_normals(
    images: Tensor,
    lights: Tensor,
    *,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    shadow: float | None = None,
    patch_size: int = 8,
    stride: int = 2,
    lam: float = 0.5,
    mu: float | Auto = "auto",
    n_iter: int = 20,
) -> PhotometricResult:
    r"""Normals regularised by a dictionary of their own patches: dictionary learning on normal vectors.

        min over N, D, B   1/2 ||Y - L N||^2 + lam l ( \sum_j ||P_j N - D b_j||^2 + mu^2 ||B||_0 )

    for N = albedo times normal (three channels, in every patch), l the mean eigenvalue of L^T L, so that lam means the
    same for any number and strength of lights. Each iteration is one sweep of SOUP-DIL and, pixel by pixel, the exact
    N = (L^T W L + 2 lam l c)^{-1} (L^T W Y + 2 lam l fold(D B)), W the samples that are lit. Differentiable (unrolled).

    Args:
        images: (N, K, H, W) or (K, H, W), one per light.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read.
        lit: (N, K, H, W) bool, False where a sample must not be used.
        shadow: leave out samples of at most this part of the pixel's brightest, as `woodham` does; None for none.
        patch_size: side of the patches.
        stride: step between patches.
        lam: weight of the patches, at least 0.
        mu: threshold of the codes, or "auto": 2.5 times the mean noise of a component of N by least squares.
        n_iter: iterations, at least 0.

    Returns:
        PhotometricResult(normals, albedo, confidence, covariance).

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or an option is out of range.

    Source: Wagenmaker, Moore, Nadakuditi, "Robust photometric stereo via dictionary learning", IEEE Transactions on
    Computational Imaging, 2018 (DLNV).

    Example:
        >>> surface, lights = torchdls.SURFACES["tent"](32), torchdls.ring_of_lights(8)
        >>> normals = torchdls.gradient_to_normals(surface.gradient)
        >>> noisy = torchdls.render(normals, lights, snr_db=10, generator=torch.Generator().manual_seed(0))
        >>> plain, found = (method(noisy, lights, shadow=None).normals
        ...                 for method in (torchdls.woodham, torchdls.dlnv_normals))
        >>> bool((found - normals).norm() < 0.7 * (plain - normals).norm())
        True
    """
    samples, patches = _checked("dlnv_normals", images, lights, mask, lit, patch_size, stride, lam, mu, n_iter)
    if shadow is not None:
        samples = samples._replace(lit=lit_samples("dlnv_normals", samples.images, samples.lit, shadow))
    Y, live = samples.images, samples.lit
    lights = samples.lights.expand(len(Y), -1, -1)
    scale = lights.square().sum((1, 2)) / 3
    level = 2.5 * _noise(samples) * _spread(lights) if isinstance(mu, str) else Y.new_full((len(Y),), mu)
    trust = torch.ones_like(Y) if live is None else live.to(Y.dtype)
    gram = torch.einsum("nkhw,nka,nkb->nhwab", trust, lights, lights)
    right = torch.einsum("nkhw,nka->nahw", trust * Y, lights)
    weight = 2 * lam * scale[:, None, None, None]
    c = weight * patches.coverage(Y.shape, dtype=Y.dtype, device=Y.device)
    eye = torch.eye(3, dtype=Y.dtype, device=Y.device)
    ridge = c.expand(len(Y), 1, *Y.shape[-2:]).permute(0, 2, 3, 1)[..., None]
    dark = ridge + torch.finfo(Y.dtype).eps * scale.view(-1, 1, 1, 1, 1)
    inverse = torch.linalg.inv(gram + dark * eye)

    def update(folded: Tensor) -> Tensor:
        return torch.einsum("nhwab,nbhw->nahw", inverse, right + weight * folded)

    plain, _ = fit(Y, lights, trust)
    known = (plain != 0).any(1, keepdim=True)
    N = _denoise(_filled(plain, known.expand_as(plain)), update, patches, eye[None], level, n_iter)
    return result(torch.where(known, N, 0), samples)


def _checked(
    name: str, images: Tensor, lights: Tensor, mask: Tensor | None, lit: Tensor | None,
    patch_size: int, stride: int, lam: float, mu: float | Auto, n_iter: int,
) -> tuple[Samples, Patches]:  # fmt: skip
    samples = check(name, images, lights, mask, lit)
    if not lam >= 0 or not isinstance(n_iter, int) or n_iter < 0:
        raise ValueError(f"{name}: lam={lam!r} must be at least 0, n_iter={n_iter!r} an integer of at least 0")
    if mu != "auto" and (isinstance(mu, str) or not mu >= 0):
        raise ValueError(f"{name}: mu={mu!r} given, 'auto' or a number of at least 0 is needed")
    patches = Patches(patch_size, stride)
    try:
        patches.grid(samples.images.shape)
    except ValueError as error:
        raise ValueError(f"{name}: images {tuple(images.shape)}: {error}") from error
    return samples, patches


def _denoise(
    x: Tensor, update: Callable[[Tensor], Tensor], patches: Patches, depth: Tensor, mu: Tensor, n_iter: int
) -> Tensor:
    """x (N, C, H, W) after iterations of a sweep over its patches of all channels, and of `update`(fold(D B)).

    The first atoms are cosines over the pixels times cosines over the columns of `depth` (N, C, 3), orthonormal ones
    over the channels: mixed, since the columns themselves differ in noise (angles then fall by up to 8 percent).
    """
    space, mixed = dct_dictionary(patches.size).to(x), depth @ dct_dictionary((3, 1)).to(x)
    D = torch.einsum("zcd,nk->zcndk", mixed, space).flatten(3).flatten(1, 2).expand(len(x), -1, -1)
    B = x.new_zeros(len(x), D.shape[-1], _extract(x, patches).shape[-1])
    for _ in range(n_iter):
        P = _extract(x, patches)
        _, D, B = _LEARNER((P.mT - B.mT @ D.mT).mT, D, B, mu[:, None])
        x = update(_fold(D @ B, patches, x.shape))
    return x


def _matte(lights: Tensor) -> Tensor:
    """(N, K, 3) an orthonormal basis of what matte images can be at a pixel: the span of the lights (N, K, 3)."""
    return torch.linalg.qr(lights).Q


def _extract(x: Tensor, patches: Patches) -> Tensor:
    """(N, C, H, W) -> (N, C n, L)."""
    P = patches.extract(x.flatten(0, 1)[:, None])
    return P.unflatten(0, x.shape[:2]).flatten(1, 2)


def _fold(P: Tensor, patches: Patches, shape: torch.Size) -> Tensor:
    """The transpose of `_extract`."""
    folded = patches.adjoint(P.unflatten(1, (shape[1], -1)).flatten(0, 1), shape)
    return folded.view(shape)


def _filled(x: Tensor, live: Tensor | None) -> Tensor:
    """Values that are not known become the mean of those that are, channel by channel."""
    if live is None:
        return x
    count = live.sum((-2, -1), keepdim=True).clamp(min=1)
    return torch.where(live, x, torch.where(live, x, 0).sum((-2, -1), keepdim=True) / count)


def _noise(samples: Samples) -> Tensor:
    """(N,) deviation of a sample: rms residual of least squares, of K - 3 degrees of freedom at every pixel."""
    trust = None if samples.lit is None else samples.lit.to(samples.images.dtype)
    b, _ = fit(samples.images, samples.lights, trust)
    residual = samples.images - shading(b, samples.lights)
    if trust is None:
        free = (residual.shape[1] - 3) * residual[0, 0].numel() * torch.ones_like(residual[:, 0, 0, 0])
    else:
        residual = trust * residual
        free = (trust.sum(1) - 3).clamp(min=0).sum((-2, -1))
    square = residual.square().sum((1, 2, 3)) / free.clamp(min=1)
    return torch.where(square > 0, torch.where(square > 0, square, 1).sqrt(), 0)


def _spread(lights: Tensor) -> Tensor:
    """(N,) root mean square over the components of the noise of b, for samples of unit noise."""
    gram = lights.mT @ lights
    eye = torch.eye(3, dtype=gram.dtype, device=gram.device)
    scale = gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    inverse = torch.linalg.inv(gram + 1e-6 * torch.where(scale > 0, scale, 1) * eye)
    return (inverse.diagonal(dim1=-2, dim2=-1).mean(-1)).clamp(min=0).sqrt()
