"""The modes of a grid: what diagonalises its second differences, with free borders and on a torus."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.operators.cosine import dct2, idct2
from torchdls.operators.tables import table

# How a grid ends: at free borders, or not at all (its last column is beside the first, its last row above the first).
Boundary = Literal["neumann", "periodic"]


@full_precision
def hartley2(x: Tensor) -> Tensor:
    r"""Orthonormal two-dimensional Hartley transform, the real twin of the Fourier transform.

        C[k, l] = \frac{1}{\sqrt{HW}} \sum_{i, j} x[i, j] cas(2 \pi k i / H) cas(2 \pi l j / W),    cas = cos + sin

    a symmetric orthogonal matrix, so its own inverse and transpose, which diagonalises the second differences of a
    periodic grid. Modes k and H - k belong to one frequency.

    Args:
        x: (..., H, W), float32 or float64.

    Returns:
        (..., H, W), in the dtype and on the device of `x`.

    Source: Bracewell, "Discrete Hartley transform", JOSA 73(12), 1983.
    """
    spectrum = torch.fft.fft2(x, norm="ortho")
    turned = torch.cat([spectrum[..., :1], spectrum[..., 1:].flip(-1)], -1)
    return turned.real - spectrum.imag  # cas a cas b = cos(a - b) + sin(a + b)


def to_modes(x: Tensor, boundary: Boundary) -> Tensor:
    """Coefficients (..., H, W): of cosines with free borders, of `hartley2` on a torus."""
    return dct2(x) if boundary == "neumann" else hartley2(x)


def from_modes(x: Tensor, boundary: Boundary) -> Tensor:
    """Inverse, and transpose, of `to_modes`."""
    return idct2(x) if boundary == "neumann" else hartley2(x)


def half_periods(n: int, boundary: Boundary) -> Tensor:
    """(n,) half periods that each mode of an axis has on it, in float64 on the CPU: a part of tables."""
    k = torch.arange(n, dtype=torch.float64, device="cpu")
    return k if boundary == "neumann" else 2 * torch.minimum(k, n - k)


def mode_sines(n: int, boundary: Boundary) -> Tensor:
    """(n,) sin^2(w / 2) of the frequency w of each mode of an axis, in radians per pixel: a part of tables."""
    return (half_periods(n, boundary) * (math.pi / (2 * n))).sin().square()


def mode_eigenvalues(
    shape: tuple[int, int], like: Tensor, pixel_size: tuple[float, float], boundary: Boundary
) -> Tensor:
    """(H, W) eigenvalues 4 sin^2(w_y / 2) / dy^2 + 4 sin^2(w_x / 2) / dx^2 of A^T A, A the forward differences."""
    found: Tensor = _eigenvalues(*shape, *pixel_size, boundary, like=like)
    return found


@table
def _eigenvalues(h: int, w: int, dx: float, dy: float, boundary: Boundary) -> Tensor:
    return 4 / dy**2 * mode_sines(h, boundary)[:, None] + 4 / dx**2 * mode_sines(w, boundary)
