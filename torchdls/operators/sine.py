"""Orthonormal sine transform of the last two dimensions, and the Laplacian that it diagonalises."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.operators.tables import table

# Up to this length a product with the sine matrix beats the FFT of twice the length (measured on a CPU).
_MATRIX_LIMIT = 64


@full_precision
def dst2(x: Tensor) -> Tensor:
    r"""Orthonormal two-dimensional DST-I.

        S[k, l] = \frac{2}{\sqrt{(H + 1)(W + 1)}} \sum_{i, j} x[i, j] \sin(\pi k i / (H + 1)) \sin(\pi l j / (W + 1))

    with i, k = 1 .. H and j, l = 1 .. W: the transform is a symmetric orthogonal matrix, so it is its own inverse and
    transpose, and it diagonalises the second differences of a grid whose surrounding pixels are held at 0.

    Args:
        x: (..., H, W), float32 or float64.

    Returns:
        (..., H, W), in the dtype and on the device of `x`.
    """
    return _sine_transform(_sine_transform(x).mT).mT


def dirichlet_eigenvalues(shape: tuple[int, int], like: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """(H, W) eigenvalues of the negative Laplacian whose outside neighbours are 0, in the basis of `dst2`.

        4 sin^2(pi k / 2(H + 1)) / dy^2 + 4 sin^2(pi l / 2(W + 1)) / dx^2,     k = 1 .. H,  l = 1 .. W

    Built in float64 and then cast to the dtype of `like`. Source: Simchony, Chellappa, Shao, IEEE TPAMI 12(5), 1990.
    """
    return _eigenvalues(*shape, *pixel_size, like=like)


def _sine_transform(x: Tensor) -> Tensor:
    """Orthonormal DST-I of the last dimension: sqrt(2/n) sum_i x_i sin(pi k i/n) for i, k = 1 .. n - 1."""
    n = x.shape[-1] + 1
    if n <= _MATRIX_LIMIT:
        return x @ _sine_matrix(n, like=x)
    odd = torch.cat([F.pad(x, (1, 1)), -x.flip(-1)], -1)
    return torch.fft.rfft(odd).imag[..., 1:n] * -math.sqrt(1 / (2 * n))


@table
def _eigenvalues(h: int, w: int, dx: float, dy: float) -> Tensor:
    return 4 / dy**2 * squared_sines(h + 1)[:, None] + 4 / dx**2 * squared_sines(w + 1)


@table
def _sine_matrix(n: int) -> Tensor:
    k = torch.arange(1, n, device="cpu")
    angle = (k[:, None] * k) % (2 * n)  # exact integers: no accuracy lost to a large argument of the sine
    return math.sqrt(2 / n) * torch.sin(angle.double() * (math.pi / n))


def squared_sines(n: int) -> Tensor:
    """(n - 1,) values sin^2(pi k / 2n), k = 1 .. n - 1, in float64 on the CPU: a part of tables."""
    return torch.sin(torch.arange(1, n, dtype=torch.float64, device="cpu") * (math.pi / (2 * n))).square()
