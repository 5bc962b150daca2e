"""What white noise of the slopes leaves in heights and in projected slopes, mode by mode."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls.operators.cosine import cosine_matrix
from torchdls.operators.modes import Boundary, mode_sines
from torchdls.operators.tables import table

_CUT = 3.0  # samples beyond so many standard deviations belong to the surface (creases, waves), not to the noise
_KEPT = math.erf(_CUT / math.sqrt(2))
_TRIMMED_VARIANCE = 1 - _CUT * math.sqrt(2 / math.pi) * math.exp(-_CUT * _CUT / 2) / _KEPT  # of a cut standard normal

_PERIOD = 128  # side of the periodic grid on which the spectrum of the projected noise is sampled


def height_noise(
    shape: tuple[int, int],
    like: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Variance of the cosine coefficients of a least-squares height, for white noise of variance 1 in the gradient.

        S_kl = (a_x c_x + a_y c_y) / (a_x + a_y)^2,   S_00 = 0
        a_x = 4 sin^2(w_x / 2) / dx^2,   c_x = cos^2(w_x / 2),   w_x = pi l / W,   and alike in y

    c is what averaging the slopes of two neighbours leaves of their noise, 1 / a what integration makes of it. The
    coefficients (of `dct2`) are exactly uncorrelated on a rectangle with equal trust in all slopes. On a torus they are
    those of `hartley2`, with w_x = 2 pi l / W.

    Args:
        shape: (H, W).
        like: a tensor of the wanted dtype and device.
        pixel_size: (dx, dy).
        boundary: "neumann" or "periodic".

    Returns:
        (H, W).
    """
    return _height_noise(tuple(shape), tuple(pixel_size), boundary, like=like)


@table
def _height_noise(shape: tuple[int, int], pixel_size: tuple[float, float], boundary: Boundary) -> Tensor:
    y, x = (mode_sines(n, boundary) for n in shape)
    return _noise_of_modes(y, x, pixel_size)


def height_noise_part(
    shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int], pixel_size: tuple[float, float]
) -> Tensor:
    """`height_noise` in float64 of the modes from and up to (without) a row, and alike for columns; not kept."""
    y, x = (
        torch.sin(torch.arange(*part, dtype=torch.float64, device="cpu") * (math.pi / (2 * n))).square()
        for part, n in zip((rows, columns), shape, strict=True)
    )
    return _noise_of_modes(y, x, pixel_size)


def _noise_of_modes(y: Tensor, x: Tensor, pixel_size: tuple[float, float]) -> Tensor:
    """From the sin^2(w / 2) of rows and columns."""
    a_y, a_x = 4 * y[:, None] / pixel_size[1] ** 2, 4 * x / pixel_size[0] ** 2
    total = a_x + a_y
    total = torch.where(total > 0, total, 1)  # 0 for the mean alone
    return (a_x * (1 - x) + a_y * (1 - y)[:, None]) / total.square()


def cosine_noise(size: tuple[int, int], like: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    r"""Standard deviation of the cosine coefficients of a patch of projected slopes, for white noise of level 1.

    The slopes A z of the least-squares height carry the part of the noise that is a gradient. Its spectrum (far from
    the border) is that of `slope_covariance`, and with the discrete-time Fourier transform of an atom d

        std^2 = mean over w of S_xx(w) |d(w)|^2   (S_yy for the slopes in y)

    Args:
        size: (rows, columns) of a patch.
        like: a tensor of the wanted dtype and device.
        pixel_size: (dx, dy).

    Returns:
        (2, rows, columns): for dz/dx and dz/dy, coefficients in the order of `dct2`.
    """
    return _cosine_noise(tuple(size), tuple(pixel_size), like=like)


@table
def _cosine_noise(size: tuple[int, int], pixel_size: tuple[float, float]) -> Tensor:
    n = _spectrum_side(size)
    xx, yy, _ = _projected_spectra(n, pixel_size)
    down, across = (torch.fft.fft(cosine_matrix(k, like=xx), n).abs().square() for k in size)
    return torch.stack([(down @ s @ across.mT).sqrt() / n for s in (xx, yy)])


def slope_covariance(size: tuple[int, int], like: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    r"""Covariance of the projected noise in a patch of slopes (x above y), for white noise of level 1.

    The inverse Fourier transforms of

        S_xx = a_x q,   S_yy = a_y q,   S_xy = g_x conj(g_y) q,   q = (a_x c_x + a_y c_y) / (a_x + a_y)^2

    with g_x = (exp(i w_x) - 1) / dx, a_x = |g_x|^2, c_x = cos^2(w_x / 2), alike in y, and S_xx(0) = S_yy(0) = 1/2 (the
    mean over all directions).

    Args:
        size: (rows, columns) of a patch, n pixels.
        like: a tensor of the wanted dtype and device.
        pixel_size: (dx, dy).

    Returns:
        (2n, 2n).
    """
    return _slope_covariance(tuple(size), tuple(pixel_size), like=like)


@table
def _slope_covariance(size: tuple[int, int], pixel_size: tuple[float, float]) -> Tensor:
    n = _spectrum_side(size)
    i, j = (t.flatten() for t in torch.meshgrid(*(torch.arange(k, device="cpu") for k in size), indexing="ij"))
    lag = (i[:, None] - i) % n, (j[:, None] - j) % n
    xx, yy, xy = (torch.fft.ifft2(s).real[lag] for s in _projected_spectra(n, pixel_size))
    return torch.cat([torch.cat([xx, xy], 1), torch.cat([xy.mT, yy], 1)])


def _spectrum_side(size: tuple[int, int]) -> int:
    """Side of the periodic grid: at least twice the patch, so that no lag wraps around."""
    return max(_PERIOD, 2 * max(size))


def _projected_spectra(n: int, pixel_size: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """S_xx, S_yy (real) and S_xy (complex) on an n x n grid of frequencies, rows first."""
    w = torch.arange(n, dtype=torch.float64, device="cpu") * (2 * math.pi / n)
    difference, c = torch.polar(torch.ones_like(w), w) - 1, torch.cos(w / 2).square()
    g_x, g_y = (difference / pixel_size[0]).expand(n, n), (difference / pixel_size[1])[:, None].expand(n, n)
    a_x, a_y = g_x.abs().square(), g_y.abs().square()
    total = a_x + a_y
    total[0, 0] = 1
    q = (a_x * c + a_y * c[:, None]) / total.square()
    xx, yy = a_x * q, a_y * q
    xx[0, 0] = yy[0, 0] = 0.5
    return xx, yy, g_x * g_y.conj() * q
