"""What patches cannot see: waves longer than they are; and how far to trust a smoothed height as a whole."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchdls._checks import check_alike, check_field, check_fit
from torchdls._precision import full_precision
from torchdls.noise import height_noise, height_noise_part
from torchdls.operators import dct2, idct2
from torchdls.operators.modes import Boundary, half_periods, to_modes
from torchdls.operators.tables import table

_THRESHOLDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)
_DEGREES = (0, 4, 8)  # of the polynomials before cosines
_BOX = 48  # modes along each axis of which polynomials are made: they hold hardly anything of finer ones
_TEMPERATURE = 8.0  # of the mean over bases and thresholds, in units of the noise of one mode: SURE of few scatters
_LEAST_CUT = 0.2  # share of the risk of least squares that must go, as predicted, for anything to be changed


@full_precision
def shrink_slow_waves(
    height: Tensor,
    reference: Tensor,
    noise: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    period: float = 16.0,
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Shrink what a height holds of long waves by what least squares says of their signal and noise.

        y -> sum_BT p_BT (y shrunk in B with threshold T),   p_BT ~ exp(-R_BT / 8)
        c_k -> f_k c_k,   f_k = max(0, 1 - T^2 v_k / c_k^2)
        R_BT = ||y' - y||^2 + 2 sum_k v_k (1 + T^2 v_k / c_k^2) [c_k^2 > T^2 v_k] - K

    y are the cosine modes of long period of the least-squares height, K of them, each over its noise: white noise of
    variance 1. Shrunk, they are y'; the modes of `height` take the same factors. A basis B is either the cosines
    themselves (c = y, v = 1), or polynomials of the position up to degree 4 or 8, orthonormal in y, and the cosines of
    what is left: c = U^T y with v = 1, and y - U c with v_k = 1 - sum_p U_kp^2, from which polynomials are taken out
    again when it is shrunk. Polynomials are few where a surface is smooth and bends up to the border. R_BT is Stein's
    unbiased estimate of the risk. Bases and thresholds 0, 1/2, .. 5/2 are averaged rather than chosen among, since the
    risk of few modes scatters. `SlopeDLS` ends with it; any other height of patches gains too.

    Args:
        height: (N, 1, H, W), on a full rectangle.
        reference: (N, 1, H, W), the least-squares height of the same data, with equal trust in all slopes.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).
        period: in pixels; modes of longer period are shrunk.
        boundary: "neumann", or "periodic" for a surface that repeats. Its modes are those of the Fourier transform, of
            two coefficients each: y_k^2 is their mean square, (1 + T^2 v / c^2) in R becomes 1, and there are no
            polynomials.

    Returns:
        (N, 1, H, W); differentiable, with the p_BT held fixed.

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
    variance = noise.square()[:, None, None, None] * height_noise(shape, height, pixel_size, boundary)
    if boundary == "periodic":  # a sine and a cosine share their fate, or waves would shift
        slow = slow_modes(shape, shape, period, height, boundary)
        factors = _torus_factors(torch.fft.fft2(reference, norm="ortho"), variance, slow)
        return torch.fft.ifft2(torch.fft.fft2(height) * factors).real
    modes, (h, w) = dct2(height), slow_part(shape, period)
    part = (..., slice(h), slice(w))
    shrunk = shrunk_modes(modes[part], dct2(reference)[part], variance[part], shape, pixel_size, period)
    return idct2(modes + functional.pad(shrunk - modes[part], (0, shape[1] - w, 0, shape[0] - h)))


def slow_part(shape: tuple[int, int], period: float) -> tuple[int, int]:
    """(h, w) of the first cosine modes of a surface (H, W), which hold all of longer period."""
    h, w = (max(1, min(n, math.ceil(2 * n / period))) for n in shape)
    return h, w


def shrunk_modes(
    height: Tensor,
    reference: Tensor,
    variance: Tensor,
    shape: tuple[int, int],
    pixel_size: tuple[float, float],
    period: float,
) -> Tensor:
    """`shrink_slow_waves` of the first cosine modes, which hold the slow ones.

    Args:
        height: (N, 1, h, w) modes, those of `slow_part`.
        reference: (N, 1, h, w), those of least squares.
        variance: (N, 1, h, w) of the noise of the reference's.
        shape: (H, W) of the surface.
        pixel_size: (dx, dy).
        period: in pixels.

    Returns:
        (N, 1, h, w).
    """
    part = (height.shape[-2], height.shape[-1])
    slow = slow_modes(part, shape, period, height) & (variance > 0)
    scale = torch.where(slow, variance, 1).sqrt()
    y, z = (torch.where(slow, x / scale, 0) for x in (reference, height))
    shrunk, risks = [], []
    for degree in _DEGREES:
        atoms, left = _polynomials(shape, part, degree, tuple(pixel_size), period, like=height)
        basis = _Basis(atoms, left, _box(part))
        for threshold in _THRESHOLDS:
            found, risk = basis.shrunk(z, y, threshold)
            shrunk.append(found)
            risks.append(risk)
    share = torch.softmax(-torch.stack(risks) / _TEMPERATURE, 0)
    mean = (share[..., None, None, None] * torch.stack(shrunk)).sum(0)
    return torch.where(slow, mean * scale, height)


class _Basis(NamedTuple):
    """Polynomials, and the cosines for what they leave.

    Attributes:
        atoms: (a b, P) orthonormal polynomials, as white modes.
        left: (h, w) v of the modes of the remainder.
        box: (a, b) of the first modes, of which the atoms are.
    """

    atoms: Tensor
    left: Tensor
    box: tuple[int, int]

    def along(self, y: Tensor) -> Tensor:
        """(N, 1, h, w) -> (N, P)."""
        a, b = self.box
        return y[..., :a, :b].flatten(1) @ self.atoms

    def sum(self, c: Tensor) -> Tensor:
        """(N, P) -> (N, 1, h, w), the transpose of `along`."""
        (h, w), (a, b) = self.left.shape, self.box
        return functional.pad((c @ self.atoms.mT).view(-1, 1, a, b), (0, w - b, 0, h - a))

    def shrunk(self, z: Tensor, y: Tensor, threshold: float) -> tuple[Tensor, Tensor]:
        """The modes z (N, 1, h, w) with the factors that the white modes y ask for, and R (N,) of y + K."""
        c = self.along(y)
        rest = y - self.sum(c)
        f, slope = _factors(c, torch.ones_like(c), threshold)
        g, slopes = _factors(rest, self.left, threshold)

        def followed(z: Tensor) -> Tensor:
            along = self.along(z)
            rest = g * (z - self.sum(along))
            return rest + self.sum(f * along - self.along(rest))

        risk = (followed(y) - y).detach().square().sum((1, 2, 3)) + 2 * (slope.sum(1) + slopes.sum((1, 2, 3)))
        return followed(z), risk


def _factors(c: Tensor, v: Tensor, threshold: float) -> tuple[Tensor, Tensor]:
    """max(0, 1 - T^2 v / c^2), and without a derivative v times that of c times it."""
    cut = threshold * threshold * v
    above = c.square() > cut
    ratio = torch.where(above, cut / torch.where(above, c.square(), 1), 1)
    return 1 - ratio, torch.where(above, v * (1 + ratio), 0).detach()


@table
def _polynomials(
    shape: tuple[int, int], part: tuple[int, int], degree: int, pixel_size: tuple[float, float], period: float
) -> tuple[Tensor, Tensor]:
    """`atoms` and `left` of a `_Basis` of at most half as many polynomials as there are slow modes."""
    a, b = box = _box(part)
    most = math.pi * shape[0] * shape[1] / (2 * period * period)
    degree = max(d for d in range(degree + 1) if d == 0 or d * (d + 3) / 2 <= most)
    y, x = (_legendre(n, k, min(degree, k - 1)) for n, k in zip(shape, box, strict=True))
    pairs = [(i, d - i) for d in range(1, degree + 1) for i in range(d + 1) if i < y.shape[1] and d - i < x.shape[1]]
    variance = height_noise_part(shape, (0, a), (0, b), pixel_size)
    slow = slow_modes(box, shape, period, variance)
    white = torch.where(slow, torch.where(slow, variance, 1).rsqrt(), 0)
    found = [(white * y[:, i, None] * x[:, j]).flatten() for i, j in pairs]
    atoms = torch.linalg.qr(torch.stack(found, 1))[0] if found else white.new_zeros(a * b, 0)
    left = torch.where(slow, (1 - atoms.square().sum(1)).clamp(min=0).view(a, b), 0)
    return atoms, functional.pad(left, (0, part[1] - b, 0, part[0] - a), value=1.0)


def _legendre(n: int, modes: int, degree: int) -> Tensor:
    """(modes, degree + 1) first cosine coefficients of the Legendre polynomials on n pixels."""
    position = (torch.arange(n, dtype=torch.float64, device="cpu") + 0.5) / n
    cosines = torch.cos(math.pi * torch.arange(modes, dtype=torch.float64, device="cpu")[:, None] * position)
    cosines[:1] *= math.sqrt(0.5)  # all modes have length 1, but for a common factor
    t, found = 2 * position - 1, [torch.ones_like(position), 2 * position - 1]
    for k in range(1, degree):
        found.append(((2 * k + 1) * t * found[k] - k * found[k - 1]) / (k + 1))
    return cosines @ torch.stack(found[: degree + 1], 1)


def _box(part: tuple[int, int]) -> tuple[int, int]:
    return min(part[0], _BOX), min(part[1], _BOX)


def _torus_factors(reference: Tensor, variance: Tensor, slow: Tensor) -> Tensor:
    """f_k of `shrink_slow_waves` on a torus, 1 for modes that are not slow: (N, 1, H, W), of complex modes."""
    seen = slow & (variance > 0)
    power = reference.real.square() + reference.imag.square()
    y2 = torch.where(seen, power / torch.where(seen, variance, 1), 0)
    factors, risks = [], []
    for threshold in _THRESHOLDS:
        above = y2 > threshold * threshold
        f = torch.where(above, 1 - threshold * threshold / torch.where(above, y2, 1), 0)
        factors.append(f)
        risks.append((((1 - f).square() * y2).detach() + torch.where(above, 2, 0)).sum((1, 2, 3)))
    share = torch.softmax(-torch.stack(risks) / _TEMPERATURE, 0)
    mean = (share[..., None, None, None] * torch.stack(factors)).sum(0)
    return torch.where(seen, mean, 1)


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
