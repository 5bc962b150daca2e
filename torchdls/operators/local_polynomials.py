"""Derivative matrices from local polynomials, and orthonormal bases of the line."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls.operators.tables import table


def derivative_matrix(
    n: int, support: int = 3, degree: int | None = None, step: float = 1.0, *, like: Tensor
) -> Tensor:
    """(n, n) matrix D of the derivative along a line of n samples, by polynomials fitted to `support` samples.

        support 3, n = 5:   [-3   4  -1   .   .]
                            [-1   0   1   .   .]
                      1/2 * [ .  -1   0   1   .]
                            [ .   .  -1   0   1]
                            [ .   .   1  -4   3]

    In the middle the samples lie around the point, at the ends they are the first or last `support` ones: no sample is
    made up at a border, and D is exact for polynomials up to `degree` everywhere. A line that is shorter than the
    support uses all of its samples.

    Args:
        n: number of samples.
        support: how many samples each fit uses, odd.
        degree: of the polynomials, 1 .. support - 1; None for support - 1, interpolation.
        step: spacing of the samples.
        like: gives the dtype and the device.

    Source: Savitzky, Golay (1964); Harker, O'Leary (2008).
    """
    return _derivative(n, support, support - 1 if degree is None else degree, step, like=like)


def build_derivative(n: int, support: int, degree: int, step: float) -> Tensor:
    """The matrix of `derivative_matrix` in float64 on the CPU: a part of tables."""
    support = min(support, n)
    degree = min(degree, support - 1)
    D = torch.zeros(n, n, dtype=torch.float64, device="cpu")
    if degree == 0:
        return D  # a single sample
    t = torch.arange(support, dtype=torch.float64, device="cpu") - (support - 1) / 2
    fit = torch.linalg.pinv(torch.stack([t**k for k in range(degree + 1)], 1))  # samples -> coefficients
    powers = [k * t ** (k - 1) if k else torch.zeros_like(t) for k in range(degree + 1)]
    taps = torch.stack(powers, 1) @ fit / step  # row i: the derivative at sample i of the window
    i = torch.arange(n, device="cpu")
    start = (i - (support - 1) // 2).clamp(0, n - support)
    return D.scatter(1, start[:, None] + torch.arange(support, device="cpu"), taps[i - start])


_derivative = table(build_derivative)


def cosine_basis(n: int, modes: int) -> Tensor:
    """(n, modes) orthonormal columns c_k cos(pi k (2 i + 1) / 2n), in float64 on the CPU."""
    k = torch.arange(modes, device="cpu")
    angle = ((2 * torch.arange(n, device="cpu")[:, None] + 1) * k) % (4 * n)
    basis = math.sqrt(2 / n) * torch.cos(angle.double() * (math.pi / (2 * n)))
    basis[:, 0] = math.sqrt(1 / n)
    return basis


def polynomial_basis(n: int, modes: int) -> Tensor:
    """(n, modes) orthonormal polynomials of degree 0, 1, .. on n equidistant samples (Gram), in float64 on the CPU.

    Each is the previous one times t, orthogonalised twice against all before it and made exactly even or odd.
    """
    t = torch.linspace(-1, 1, n, dtype=torch.float64, device="cpu") if n > 1 else torch.zeros(1).double()
    basis = torch.empty(n, modes, dtype=torch.float64, device="cpu")
    basis[:, 0] = math.sqrt(1 / n)
    for k in range(1, modes):
        q = t * basis[:, k - 1]
        for _ in range(2):
            q = q - basis[:, :k] @ (basis[:, :k].mT @ q)
        q = q + q.flip(0) if k % 2 == 0 else q - q.flip(0)
        basis[:, k] = q / q.norm()
    return basis
