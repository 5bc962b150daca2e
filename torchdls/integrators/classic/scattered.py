"""Integration of slopes that lie on no grid."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_real, require
from torchdls._precision import full_precision

Auto = Literal["auto"]


@full_precision
def integrate_scattered(
    points: Tensor, slopes: Tensor, at: Tensor, *, sigma: float | None = None, lam: float | Auto = "auto"
) -> Tensor:
    r"""Heights from slopes at scattered points: a plane and a Gaussian bump on each point.

        z(x) = p^T x + sum_j a_j G(x - x_j) + constant,     G(x) = exp(-|x|^2 / (2 sigma^2))
        min over a   sigma^2 sum_i |grad z(x_i) - g_i|^2 + lam a^T K a,     K_ij = G(x_i - x_j)

    with p the mean slope, so that planes are exact. For slopes that no grid holds (a few hundred to a few thousand
    tracked markers, dots of a deflectometer); on a grid the integrators are better in every way. It works with dense
    M x M matrices in float64: time grows as M^3, memory as M^2. Between the points the surface is as smooth as the
    bumps, far from them it is the plane.

    "auto" takes of fifteen lam from 1e-6 to 10 the one with the least generalised cross-validation

        GCV(lam) = sum_i sigma^2 |grad z(x_i) - g_i|^2 / (2 M - 2 - degrees of freedom of a)^2

    for each field of slopes: next to none without noise, under noise one near the best.

    K is all but singular for bumps that are wide beside the spacing of the points; its eigenvectors below 1e-13 of the
    largest are left out. Differentiable in the slopes, in which it is linear once lam is chosen; points are taken as
    fixed.

    Args:
        points: (M, 2) positions (x, y), in any unit; x to the right and y down, if they are those of pixels.
        slopes: (M, 2) or (N, M, 2): dz/dx and dz/dy at the points.
        at: (K, 2) positions at which the height is wanted.
        sigma: width of the bumps, in the unit of the points; None for twice the root of the area that a point has in
            the bounding box of all.
        lam: weight of the penalty, positive, or "auto"; the larger, the more noise it takes out, and detail with it.

    Returns:
        (K,) or (N, K) heights in the unit of the points; their mean over the `points` is 0.

    Raises:
        TypeError: a tensor is not float32 or float64, or of another dtype than the points.
        ValueError: shapes do not fit, a value is not finite, `sigma` or `lam` is not positive, or the points lie on a
            line along x or y and `sigma` is not given.

    Source: after Ng, Wu, Tang, "Surface-from-gradients without discrete integrability enforcement: a Gaussian kernel
    approach", IEEE TPAMI 32(11), 2010. Their penalty is not confirmed; the plane is ours. Choice of
    lam: Golub, Heath, Wahba, Technometrics 21, 1979.

    Example:
        >>> points = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)).double() * 6
        >>> slopes = torch.stack([points[:, 0].cos(), 0 * points[:, 1]], -1)  # of sin(x)
        >>> at = torch.tensor([[1.0, 3.0], [4.0, 3.0]]).double()
        >>> heights = torchdls.integrate_scattered(points, slopes, at)
        >>> round(float(heights[0] - heights[1]), 2)  # sin(1) - sin(4)
        1.6
    """
    _check(points, slopes, at, sigma, lam)
    x, g, y = points.detach().double(), slopes.double(), at.detach().double()
    width = _width(x) if sigma is None else float(sigma)
    middle, mean = x.mean(0), g.mean(-2, keepdim=True)
    K = _bumps(x, x, width)
    steps = (x[:, None] - x) / width
    D = -(steps * K[..., None]).movedim(-1, 1).flatten(0, 1)  # sigma times the slopes of the bumps: (2 M, M)
    s, V = torch.linalg.eigh(K)
    live = s > 1e-13 * s[-1]
    V = V[:, live] * s[live].rsqrt()  # a = V c, a^T K a = |c|^2
    E = D @ V
    right = width * (g - mean).flatten(-2)
    t, W = torch.linalg.eigh(E.mT @ E)
    t, b = t.clamp(min=0), right @ E @ W
    chosen = _choose(right.detach(), t, b.detach()) if isinstance(lam, str) else lam
    read = _bumps(y, x, width) - K.mean(0)
    height = (b / (t + chosen)) @ (read @ V @ W).mT + ((y - middle) * mean).sum(-1)
    return height.to(slopes.dtype)


def _choose(right: Tensor, t: Tensor, b: Tensor) -> Tensor:
    """(.., 1), the lam of least generalised cross-validation, for eigenvalues t and their share b of the right side."""
    lams = torch.logspace(-6, 1, 15, dtype=t.dtype, device=t.device)[:, None]
    part = b[..., None, :] / (t + lams)  # (.., 15, M)
    whole = right.square().sum(-1)[..., None]
    misfit = whole - (part * (2 * b[..., None, :] - t * part)).sum(-1)
    free = (right.shape[-1] - 2 - (t / (t + lams)).sum(-1)).clamp(min=0.5)
    # What rounding leaves of a misfit of 0 is none: of equal ones the least lam is taken.
    score = misfit.clamp(min=1e-12 * whole) / free.square()
    return lams[score.argmin(-1)]


def _bumps(x: Tensor, centres: Tensor, width: float) -> Tensor:
    return torch.exp(-(x[:, None] - centres).square().sum(-1) / (2 * width**2))


def _width(x: Tensor) -> float:
    extent = x.amax(0) - x.amin(0)
    width = 2 * float((extent.prod() / len(x)).sqrt())
    require(width > 0, f"integrate_scattered: points {tuple(x.shape)} lie on a line: sigma is needed")
    return width


def _check(points: Tensor, slopes: Tensor, at: Tensor, sigma: float | None, lam: float | Auto) -> None:
    name = "integrate_scattered"
    check_real(name, "points", points)
    for label, field in (("slopes", slopes), ("at", at)):
        check_alike(name, label, field, points.dtype)
    shapes = f"points {tuple(points.shape)}, slopes {tuple(slopes.shape)} and at {tuple(at.shape)}"
    fits = points.ndim == at.ndim == 2 and points.shape[1] == at.shape[1] == 2 and len(points) > 0
    fits = fits and slopes.ndim in (2, 3) and slopes.shape[-2:] == points.shape
    require(fits, f"{name}: {shapes} given, (M, 2), (M, 2) or (N, M, 2), and (K, 2) are needed")
    for label, field in (("points", points), ("slopes", slopes), ("at", at)):
        require(bool(field.isfinite().all()), f"{name}: {label} {tuple(field.shape)} is not finite")
    require(sigma is None or sigma > 0, f"{name}: sigma={sigma!r} given, a positive number is needed")
    fits = lam == "auto" if isinstance(lam, str) else lam > 0
    require(fits, f"{name}: lam={lam!r} given, 'auto' or a positive number is needed")
