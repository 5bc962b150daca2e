"""Normals of surfaces that are not matte: the reflectance of each pixel is fitted with its normal."""

from __future__ import annotations

from math import comb

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchdls._precision import full_precision
from torchdls.photometric.least_squares import lit_samples
from torchdls.photometric.model import PhotometricResult, check, result

_CHUNK = 16384  # pixels at a time
_RELAX = 1.6
_PENALTY = 0.02  # of the splitting, in units of the mean curvature


@full_precision
def bivariate_normals(
    images: Tensor,
    lights: Tensor,
    *,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    shadow: float = 0.05,
    degree: int = 3,
    smoothness: float = 1e-3,
    n_iter: int = 300,
) -> PhotometricResult:
    r"""Normals under any reflectance that grows with the brightness: constrained bivariate regression.

    The law of reflection is turned round: the cosine between normal and light is a function of the brightness and of
    the angle between light and viewer,

        l_k . n = g(I_k, l_k . v),    g(I, c) = \sum_{pq} C_pq b_p(I) b_q((1 + c) / 2)

    with b_p the Bernstein polynomials of the degree, and g grows with I from g = 0 at I = 0: C_{p+1,q} >= C_pq, C_0q =
    0. Per pixel, with the brightness in parts of its brightest sample,

        min over n, C   \sum_{k lit} (l_k . n - g(I_k, l_k . v))^2 + smoothness ||second differences of C||^2

    under the scale mean_q C_{degree,q} = 1, a quadratic programme in the steps of C, which must not be negative; it is
    solved by `n_iter` splitting steps (ADMM) on all pixels at once. Exact for matte surfaces; it repairs broad
    highlights and rough surfaces, which `sparse_normals` cannot, and wants 25 lights or more. Lights are taken to have
    equal strength once divided by their length. Differentiable, unrolled, the choice of samples held fixed.

    Args:
        images: (N, K, H, W) or (K, H, W), one per light.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read.
        lit: (N, K, H, W) bool, False where a sample must not be used.
        shadow: samples of at most this part of the pixel's brightest are left out, from 0 to below 1.
        degree: of the polynomials in both variables, at least 1.
        smoothness: at least 0.
        n_iter: splitting steps, at least 1.

    Returns:
        PhotometricResult(normals, albedo, confidence, covariance); the albedo is the brightness along the normal that
        least squares gives for these normals.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or an option is out of range.

    Source: Ikehata, Aizawa, "Photometric stereo using constrained bivariate regression for general isotropic
    surfaces", CVPR 2014. Its degrees and smoothness are not known to us; these were found on rendered spheres.

    Example:
        >>> normals = torchdls.gradient_to_normals(torchdls.SURFACES["gaussians"](12).gradient)
        >>> lights = torch.cat([torchdls.ring_of_lights(15, tilt) for tilt in (20.0, 45.0)])
        >>> rough = torchdls.render(normals, lights) ** 0.7  # not matte
        >>> errors = [(method(rough, lights).normals - normals).norm(dim=1).mean()
        ...           for method in (torchdls.woodham, torchdls.bivariate_normals)]
        >>> bool(errors[1] < 0.6 * errors[0])
        True
    """
    samples = check("bivariate_normals", images, lights, mask, lit)
    if not isinstance(degree, int) or degree < 1 or not isinstance(n_iter, int) or n_iter < 1 or not smoothness >= 0:
        raise ValueError(
            f"bivariate_normals: degree={degree!r} and n_iter={n_iter!r} must be integers of at least 1, "
            f"smoothness={smoothness!r} at least 0"
        )
    used = lit_samples("bivariate_normals", samples.images, samples.lit, shadow)
    strength = samples.lights.norm(dim=-1, keepdim=True)
    directions = (samples.lights / torch.where(strength > 0, strength, 1)).expand(len(samples.images), -1, -1)
    even = samples.images / torch.where(strength > 0, strength, 1)[..., None]
    even = torch.where(used, even, 0)
    n, _, h, w = even.shape
    found = []
    for i in range(n):
        pixels, live = even[i].flatten(1).mT, used[i].flatten(1).mT
        parts = zip(pixels.split(_CHUNK), live.split(_CHUNK), strict=True)
        found.append(torch.cat([_regress(p, u, directions[i], degree, smoothness, n_iter) for p, u in parts]))
    direction = normalize(torch.stack(found).mT.unflatten(2, (h, w)), dim=1, eps=1e-20).to(even.dtype)
    shade = torch.einsum("nkc,nchw->nkhw", samples.lights.expand(n, -1, -1), direction).clamp(min=0)
    shade = torch.where(used, shade, 0)
    power = shade.square().sum(1, keepdim=True)
    albedo = (shade * samples.images).sum(1, keepdim=True) / torch.where(power > 0, power, 1)
    return result(direction * albedo.clamp(min=0), samples)


def _bernstein(x: Tensor, degree: int) -> Tensor:
    """(..., degree + 1) the polynomials at x."""
    return torch.stack([comb(degree, p) * x**p * (1 - x) ** (degree - p) for p in range(degree + 1)], -1)


def _regress(pixels: Tensor, live: Tensor, lights: Tensor, degree: int, smoothness: float, n_iter: int) -> Tensor:
    """Normals (L, 3), of any length, of pixels (L, K); 0 where fewer than three samples are lit."""
    pixels, lights = pixels.double(), lights.double()
    bright = pixels.amax(1, keepdim=True)
    x = pixels / torch.where(bright > 0, bright, 1)
    # C = cumulative sum of steps d over p, so that C_pq = sum of d_rq for r <= p: b_p become tails of the polynomials.
    tails = _bernstein(x, degree).flip(-1).cumsum(-1).flip(-1)[..., 1:]
    angle = _bernstein((1 + lights[:, 2]) / 2, degree)
    rows = -(tails[..., None] * angle[None, :, None]).flatten(2)
    A = torch.cat([lights.expand(len(x), -1, -1), rows], -1) * live[..., None]
    Q = A.mT @ A + smoothness * _roughness(degree).to(A)
    a = Q.new_zeros(Q.shape[-1])
    a[3:] = 1 / (degree + 1)
    free = torch.zeros_like(a, dtype=torch.bool)
    free[:3] = True
    known = (live.sum(1) >= 3)[:, None]
    return torch.where(known, _split(Q, a, free, n_iter)[:, :3], 0)


def _roughness(degree: int) -> Tensor:
    """Of ||second differences of C along both axes||^2, as a matrix in (n, d); C_0q = 0 belongs to C."""
    m = degree + 1
    total = torch.tril(torch.ones(m, degree, dtype=torch.float64, device="cpu"), -1)  # d -> C along p
    C = torch.einsum("pr,qs->pqrs", total, torch.eye(m, dtype=torch.float64, device="cpu"))
    bends = torch.cat([C.diff(n=2, dim=0).flatten(0, 1), C.diff(n=2, dim=1).flatten(0, 1)]).flatten(1)
    matrix = torch.zeros(3 + degree * m, 3 + degree * m, dtype=torch.float64, device="cpu")
    matrix[3:, 3:] = bends.mT @ bends
    return matrix


def _split(Q: Tensor, a: Tensor, free: Tensor, n_iter: int) -> Tensor:
    """argmin of 1/2 x^T Q x with a^T x = 1 and x >= 0 where not free, by ADMM; (L, m)."""
    m = Q.shape[-1]
    scale = Q.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None]
    scale = torch.where(scale > 0, scale, 1)
    rho = _PENALTY * scale * torch.where(free, 0, 1)
    ridge = 1e-9 * scale
    H = torch.linalg.inv(Q + torch.diag_embed(rho + ridge))
    Ha = H @ a
    norm = (Ha * a).sum(-1, keepdim=True)
    s = torch.full_like(rho, 1.0)
    u, x = torch.zeros_like(s), s
    for _ in range(n_iter):
        y = (H @ (rho * (s - u))[..., None])[..., 0]
        x = y + Ha * ((1 - (a * y).sum(-1, keepdim=True)) / norm)
        ahead = _RELAX * x + (1 - _RELAX) * s
        s = torch.where(free, ahead, (ahead + u).clamp(min=0))
        u = torch.where(free, 0, u + ahead - s)
    assert x.shape[-1] == m
    return x
