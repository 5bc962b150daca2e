"""Eigenvectors of the rows and columns of a grid, in which the equation of global least squares is diagonal."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls.operators.local_polynomials import build_derivative, cosine_basis, polynomial_basis
from torchdls.operators.tables import table

Basis = Literal["cosine", "polynomial"]
BASES = {"cosine": cosine_basis, "polynomial": polynomial_basis}
_ZERO = 1e-12  # an eigenvalue below this part of the largest one is 0: D has lost that mode


def expand(right: Tensor, rows: Modes, columns: Modes) -> Tensor:
    """The surface of a right-hand side that is given in the modes: divided by their eigenvalues, and expanded."""
    total = rows.eigenvalues[:, None] + columns.eigenvalues
    return rows.expand(columns.expand(right / total.masked_fill(total == 0, torch.inf)))


class Modes(NamedTuple):
    """Eigenvectors of the rows or the columns: first the even ones, then the odd ones, each by its first half.

    Attributes:
        vectors: (ceil(n / 2), k), the upper half of U.
        slopes: (ceil(n / 2), k), the upper half of D U, odd where U is even and even where it is odd.
        eigenvalues: (k,), at least 0.
        n: rows or columns of the image.
        dim: -2 for rows, -1 for columns: the dimension that the maps below act on.
    """

    vectors: Tensor
    slopes: Tensor
    eigenvalues: Tensor
    n: int
    dim: int

    def project(self, x: Tensor) -> Tensor:
        """U^T x: n pixels -> k coefficients."""
        return self._apply(self.vectors.mT, *self._fold(x))

    def project_slopes(self, x: Tensor) -> Tensor:
        """(D U)^T x: n pixels -> k coefficients."""
        even, odd = self._fold(x)
        return self._apply(self.slopes.mT, odd, even)

    def expand(self, c: Tensor) -> Tensor:
        """U c: k coefficients -> n pixels."""
        count = (c.shape[self.dim] + 1) // 2
        even = self._multiply(self.vectors[:, :count], c.narrow(self.dim, 0, count))
        odd = self._multiply(self.vectors[:, count:], c.narrow(self.dim, count, c.shape[self.dim] - count))
        return torch.cat([even + odd, (even - odd).narrow(self.dim, 0, self.n // 2).flip(self.dim)], self.dim)

    def _fold(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Sum and difference of the first half and the mirrored second half; a middle pixel counts once."""
        half = self.vectors.shape[0]
        first, second = x.narrow(self.dim, 0, half), x.narrow(self.dim, half, self.n - half).flip(self.dim)
        if self.n % 2:
            second = F.pad(second, (0, 1) if self.dim == -1 else (0, 0, 0, 1))
        return first + second, first - second

    def _apply(self, transposed: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """The even modes' rows of a matrix times one field, the odd modes' times the other."""
        count = (transposed.shape[0] + 1) // 2
        parts = self._multiply(transposed[:count], first), self._multiply(transposed[count:], second)
        return torch.cat(parts, self.dim)

    def _multiply(self, matrix: Tensor, x: Tensor) -> Tensor:
        return matrix @ x if self.dim == -2 else x @ matrix.mT


def axis_modes(
    n: int,
    step: float,
    dim: int,
    support: int,
    degree: int,
    basis: Basis,
    count: int,
    lam: float,
    order: int,
    *,
    like: Tensor,
) -> Modes:
    """Eigenvectors of D^T D + lam (D^order)^T D^order in the span of the first `count` vectors of a basis."""
    packed = _packed_modes(n, step, support, degree, basis, count, lam, order, like=like)
    half = (n + 1) // 2
    return Modes(packed[:half], packed[half : 2 * half], packed[-1], n, dim)


def _build_modes(
    n: int, step: float, support: int, degree: int, basis: Basis, count: int, lam: float, order: int
) -> Tensor:
    """(2 ceil(n / 2) + 1, count): the three fields of `Modes`, one under the other.

    The constant is an eigenvector for certain, so it is taken out first and stays exact.
    """
    D = build_derivative(n, support, degree, step)
    B = BASES[basis](n, count)
    constant = B[:, :1]
    parts = [(constant, constant.new_full((1,), lam if order == 0 else 0.0))]
    parts += [_eigenvectors(D, block, lam, order) for block in (B[:, 2::2], B[:, 1::2])]
    U, s = torch.cat([p[0] for p in parts], 1), torch.cat([p[1] for p in parts])
    s = torch.where(s > _ZERO * s.max(), s, 0)
    half = (n + 1) // 2
    return torch.cat([U[:half], (D @ U)[:half], s[None]])


def _eigenvectors(D: Tensor, B: Tensor, lam: float, order: int) -> tuple[Tensor, Tensor]:
    powers = [B, D @ B]
    powers += [D @ powers[-1]]
    gram = powers[1].mT @ powers[1] + lam * powers[order].mT @ powers[order]
    s, Q = torch.linalg.eigh(gram)
    return B @ Q, s


_packed_modes = table(_build_modes)
