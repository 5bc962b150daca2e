"""Integration in a space of smooth splines, which have heights between the pixels, too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_numbers, check_real, require
from torchdls._precision import full_precision
from torchdls.integrators.base import Fields, Integrator
from torchdls.operators.tables import table


class BSpline(Integrator):
    r"""Least squares over cubic splines: one smooth surface through all slopes.

        z = B_y C B_x^T,     min over C   ||B_y C B_x'^T - g_x||^2 + ||B_y' C B_x^T - g_y||^2

    with the cubic B-splines of equal knots in the columns of B_x and B_y, sampled at the pixels, and their derivatives
    in B_x' and B_y'. With M = B^T B and K = B'^T B', the normal equations M_y C K_x + K_y C M_x = R are diagonal in the
    eigenvectors of K u = s M u along rows and columns, which are kept for each size: eight products with matrices.

    Slopes are those of the spline at the pixels, not differences of heights, so there is no error from a curved
    surface: cubic surfaces are exact. `evaluate` and `upsample` give heights between pixels. Good for smooth surfaces
    with little noise (optics) and for a finer grid. It removes little noise, creases and jumps ring: for those see
    `SlopeDLS` and `Bilateral`.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean.

    Args:
        spacing: pixels between two knots, at least 1.1 (with one knot to a pixel there are more splines than pixels);
            it is stretched so that knots fall on both borders, and below four pixels the degree falls, too.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: `spacing` is below 1.1 or `pixel_size` is not positive.

    Source: after Balzer, Moerwald, "Isogeometric finite-elements methods and variational reconstruction tasks in
    vision", CVPR 2012, whose integrals over elements are sums over pixels here (theirs is not confirmed).

    Example:
        >>> x = torch.arange(8.0)
        >>> slopes = torch.stack([(3 * x**2).expand(8, 8), torch.zeros(8, 8)])  # of x^3
        >>> height = torchdls.BSpline().upsample(slopes, 2)
        >>> height.shape, round(float(height[0, 0, 3] - height[0, 0, 0]), 2)  # at x = 1.5: 3.375
        (torch.Size([1, 15, 15]), 3.38)
    """

    accepts = frozenset()

    def __init__(self, spacing: float = 2.0, *, pixel_size: float | Sequence[float] = 1.0) -> None:
        super().__init__(pixel_size=pixel_size)
        check_numbers("BSpline", spacing=spacing)
        if not 1.1 <= spacing < math.inf:
            raise ValueError(f"BSpline: spacing={spacing!r} given, a number of at least 1.1 is needed")
        self.spacing = spacing

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        rows, columns = (self._modes(n, fields.gradient) for n in fields.gradient.shape[-2:])
        height = rows.values @ self._coefficients(fields) @ columns.values.mT
        return height - height.mean((-2, -1), keepdim=True)

    @full_precision
    def evaluate(self, gradient: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Heights where the given rows and columns cross, anywhere between the pixels.

        Args:
            gradient: (N, 2, H, W) or (2, H, W).
            rows: (R,) positions in pixels, from 0 to H - 1; of the dtype of the gradient.
            columns: (C,) positions from 0 to W - 1.

        Returns:
            (N, 1, R, C) or (1, R, C): the surface whose values at the pixels are those of the call.

        Raises:
            TypeError: as the call, or a position has another dtype.
            ValueError: as the call, or a position lies outside.
        """
        fields = self._check_fields(gradient)
        shape, values = fields.gradient.shape[-2:], []
        for label, positions, n in (("rows", rows, shape[0]), ("columns", columns, shape[1])):
            check_alike("BSpline.evaluate", label, positions, gradient.dtype)
            fits = positions.ndim == 1 and bool(((positions >= 0) & (positions <= n - 1)).all())
            given = f"{label} {tuple(positions.shape)} given"
            require(fits, f"BSpline.evaluate: {given}, a line of positions from 0 to {n - 1} is needed")
            modes = self._modes(n, fields.gradient)
            values.append(_splines(positions, n, self.spacing)[0] @ modes.vectors)
        coefficients = self._coefficients(fields)
        pixels = [self._modes(n, fields.gradient).values.mean(0, keepdim=True) for n in shape]
        mean = pixels[0] @ coefficients @ pixels[1].mT
        height = self._finite((values[0] @ coefficients @ values[1].mT - mean) * self._unit)
        return height if gradient.ndim == 4 else height[0]

    @full_precision
    def upsample(self, gradient: Tensor, factor: int) -> Tensor:
        """Heights on a grid that is `factor` times as fine, from the first pixel to the last.

        Args:
            gradient: (N, 2, H, W) or (2, H, W).
            factor: integer of at least 1.

        Returns:
            (N, 1, (H - 1) factor + 1, (W - 1) factor + 1), or without its batch dimension.

        Raises:
            TypeError: as the call.
            ValueError: as the call, or `factor` is no integer of at least 1.
        """
        fits = isinstance(factor, int) and factor >= 1
        require(fits, f"BSpline.upsample: factor={factor!r} given, an integer of at least 1 is needed")
        check_real("BSpline.upsample", "gradient", gradient)
        line = [torch.arange((n - 1) * factor + 1).to(gradient) / factor for n in gradient.shape[-2:]]
        return self.evaluate(gradient, line[0], line[1])

    def _coefficients(self, fields: Fields) -> Tensor:
        """(N, 1, k, l) of the eigenvectors along rows and columns."""
        gx, gy = fields.gradient.split(1, 1)
        dx, dy = fields.steps
        rows, columns = (self._modes(n, fields.gradient) for n in gx.shape[-2:])
        right = rows.values.mT @ gx @ columns.slopes / dx + rows.slopes.mT @ gy @ columns.values / dy
        total = rows.eigenvalues[:, None] / dy**2 + columns.eigenvalues / dx**2
        return right / total.masked_fill(total == 0, torch.inf)

    def _modes(self, n: int, like: Tensor) -> _Modes:
        packed = _packed(n, float(self.spacing), like=like)
        return _Modes(packed[:n], packed[n : 2 * n], packed[2 * n : -1], packed[-1])


class _Modes(NamedTuple):
    """U of K U = M U diag(s), U^T M U = 1: B U (n, k), B' U (n, k), U (k, k) and s (k,), the constant first."""

    values: Tensor
    slopes: Tensor
    vectors: Tensor
    eigenvalues: Tensor


@table
def _packed(n: int, spacing: float) -> Tensor:
    """(2 n + k + 1, k): the fields of `_Modes`, one under the other."""
    B, D = _splines(torch.arange(n, dtype=torch.float64, device="cpu"), n, spacing)
    back = torch.linalg.inv(torch.linalg.qr(B).R)  # M = R^T R
    slopes = D @ back
    s, Q = torch.linalg.eigh(slopes.mT @ slopes)
    s[0] = 0.0
    U = back @ Q
    return torch.cat([B @ U, D @ U, U, s[None]])


def _splines(x: Tensor, n: int, spacing: float) -> tuple[Tensor, Tensor]:
    """Values and derivatives (len(x), k) of the splines over pixels 0 .. n - 1, at the positions x."""
    degree = min(3, n - 1)
    if degree == 0:
        return torch.ones_like(x)[:, None], torch.zeros_like(x)[:, None]
    pieces = min(max(1, int((n - 1) / spacing)), n - degree)
    scale = pieces / (n - 1)
    t = (x * scale).clamp(max=pieces * (1 - 2 * torch.finfo(x.dtype).eps))  # the last piece holds its right end
    first = torch.arange(-degree, pieces, dtype=x.dtype, device=x.device)
    u = t[:, None] - first
    lower, lower_next = _cardinal(u, degree - 1), _cardinal(u - 1, degree - 1)
    return _cardinal(u, degree), (lower - lower_next) * scale


def _cardinal(u: Tensor, degree: int) -> Tensor:
    """The B-spline of the knots 0, 1, .., degree + 1."""
    if degree == 0:
        return ((u >= 0) & (u < 1)).to(u.dtype)
    return (u * _cardinal(u, degree - 1) + (degree + 1 - u) * _cardinal(u - 1, degree - 1)) / degree
