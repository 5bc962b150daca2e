"""Gradient operators: a pair of convolution kernels, its exact adjoint, and the slopes on the edges of the grid."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import hypot, inf
from numbers import Real

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._checks import check_field
from torchdls._precision import full_precision

Kernel = tuple[tuple[float, ...], ...]

_TAPS: dict[str, tuple[float, ...]] = {
    "forward": (0.0, -1.0, 1.0),
    "backward": (-1.0, 1.0, 0.0),
    "central": (-0.5, 0.0, 0.5),
    "pixel": (-0.5, 0.0, 0.5),
}
_FIRST = (-1.5, 2.0, -0.5)  # the slope at the first of three pixels; at the last one turned around


@dataclass(frozen=True)
class GradientOperator:
    r"""The linear map A from a height to its slopes: one convolution per direction.

        (A z)[0] = (k_x * z) / dx        (A z)[1] = (k_y * z) / dy

    A kernel is centred on its pixel and applied as PyTorch applies it (cross-correlation). No equation is made up at
    the border: where the nonzero part of a kernel would reach outside the image, the slope is absent and 0.

        forward,   W = 4:  [-1  1  .  .]        central:  [ .   .   .   .]
                           [ . -1  1  .]                  [-.5  .  .5   .]
                           [ .  . -1  1]                  [ .  -.5  .  .5]
                           [ .  .  .  .]                  [ .   .   .   .]

    Two-tap stencils along one axis are evaluated as shifted differences, which are the same convolution (pinned equal
    by a test), faster by two orders of magnitude on a CPU; all others run as `conv2d` and `conv_transpose2d`.

    "pixel" gives the slope *at* every pixel, which is what integrators read (the other stencils give slopes between
    pixels, or none at the border): central differences, and at the border (-3 z_0 + 4 z_1 - z_2) / 2 and its mirror
    image, all exact for quadratics (`numpy.gradient` with `edge_order=2`; two pixels share their difference, a single
    one has slope 0). So `integrator(GradientOperator("pixel")(z))` is z but for its constant, exactly where z is a
    quadratic and up to third derivatives elsewhere.

    With `boundary="periodic"` the height repeats: the pixel after the last is the first, and no slope is absent.

    Args:
        stencil: "forward", "backward", "central", "pixel", or a pair (k_x, k_y) of two-dimensional kernels with odd
            sides.
        pixel_size: (dx, dy), the spacing of the columns and of the rows, or one number for both.
        boundary: "neumann" (slopes beyond the border are absent) or "periodic".

    Raises:
        ValueError: the boundary or the stencil is unknown, a kernel is not a rectangle with odd sides, or a pixel size
            is not positive.

    Example:
        >>> ramp = torch.arange(4.0).expand(1, 1, 3, 4)
        >>> torchdls.GradientOperator("forward")(ramp)[0, 0]
        tensor([[1., 1., 1., 0.],
                [1., 1., 1., 0.],
                [1., 1., 1., 0.]])
        >>> torchdls.LeastSquares()(torchdls.GradientOperator("pixel")(ramp.square()))[0, 0, 0].diff().round(decimals=3)
        tensor([1., 3., 5.])
    """

    stencil: str | tuple[Kernel, Kernel] = "forward"
    pixel_size: tuple[float, float] = (1.0, 1.0)
    boundary: str = "neumann"

    def __post_init__(self) -> None:
        if isinstance(self.stencil, str):
            if self.stencil not in _TAPS:
                raise ValueError(
                    f"stencil: {self.stencil!r} is unknown; choose from {', '.join(_TAPS)}, or give two kernels"
                )
        else:
            if len(self.stencil) != 2:
                raise ValueError(f"stencil: {len(self.stencil)} kernels given, two (k_x, k_y) are needed")
            object.__setattr__(self, "stencil", tuple(_kernel(k) for k in self.stencil))
        object.__setattr__(self, "pixel_size", as_pixel_size(self.pixel_size))
        if self.boundary not in ("neumann", "periodic"):
            raise ValueError(f"boundary: {self.boundary!r} is unknown; choose from 'neumann', 'periodic'")

    @property
    def kernels(self) -> tuple[Kernel, Kernel]:
        """The pair (k_x, k_y), without the division by the pixel size; of "pixel" those away from the border."""
        if isinstance(self.stencil, str):
            taps = _TAPS[self.stencil]
            return (taps,), tuple((t,) for t in taps)
        return self.stencil

    @property
    def norm_bound(self) -> float:
        """Upper bound of the spectral norm ||A||: sqrt((|k_x|_1 / dx)^2 + (|k_y|_1 / dy)^2).

        A kernel's frequency response is at most the sum of its absolute taps. Forward differences: sqrt(8), central:
        sqrt(2), pixel: sqrt(32), from its borders.
        """
        if self._one_sided:
            return hypot(*(4 / d for d in self.pixel_size))
        return hypot(
            *(sum(abs(t) for row in k for t in row) / d for k, d in zip(self.kernels, self.pixel_size, strict=True))
        )

    @property
    def _one_sided(self) -> bool:
        """Whether the slopes of the border pixels come from within."""
        return self.stencil == "pixel" and self.boundary != "periodic"

    @full_precision
    def __call__(self, z: Tensor) -> Tensor:
        """Slopes (N, 2, H, W) of a height (N, 1, H, W); TypeError or ValueError if it is not one."""
        check_field("GradientOperator", "z", z, 1)
        if self._one_sided:
            return torch.cat([_at_pixels(z, dim, d) for dim, d in zip((-1, -2), self.pixel_size, strict=True)], -3)
        if self.boundary == "periodic":
            return torch.cat([_roll(z, k, d, -1) for k, d in zip(self.kernels, self.pixel_size, strict=True)], -3)
        return torch.cat([_correlate(z, k, d) for k, d in zip(self.kernels, self.pixel_size, strict=True)], -3)

    @full_precision
    def adjoint(self, g: Tensor) -> Tensor:
        """Exact transpose: (N, 2, H, W) -> (N, 1, H, W). Slopes that `__call__` leaves absent are not read."""
        check_field("GradientOperator", "g", g, 2)
        gx, gy = g.split(1, -3)
        (kx, ky), (dx, dy) = self.kernels, self.pixel_size
        if self._one_sided:
            return _at_pixels_transpose(gx, -1, dx) + _at_pixels_transpose(gy, -2, dy)
        if self.boundary == "periodic":
            return _roll(gx, kx, dx, 1) + _roll(gy, ky, dy, 1)
        return _correlate_transpose(gx, kx, dx) + _correlate_transpose(gy, ky, dy)


def as_pixel_size(pixel_size: float | Sequence[float]) -> tuple[float, float]:
    """One number or a pair (dx, dy) as a pair of floats; ValueError unless both are positive and finite."""
    pair = tuple(pixel_size) if isinstance(pixel_size, Iterable) else (pixel_size, pixel_size)
    if len(pair) != 2 or not all(_is_length(d) for d in pair):
        raise ValueError(f"pixel_size: {pixel_size!r} given, a positive number or a pair (dx, dy) of them is needed")
    return float(pair[0]), float(pair[1])


def _is_length(d: object) -> bool:
    return isinstance(d, Real) and not isinstance(d, bool) and 0 < float(d) < inf


def _kernel(values: Sequence[Sequence[float]] | Tensor) -> Kernel:
    kernel = tuple(tuple(float(v) for v in row) for row in values)
    widths = {len(row) for row in kernel}
    if len(kernel) % 2 == 0 or len(widths) != 1 or not all(w % 2 for w in widths):
        raise ValueError(
            f"stencil: a kernel must be a rectangle with odd sides, got rows of {[len(r) for r in kernel]} taps"
        )
    if not any(v for row in kernel for v in row):
        raise ValueError("stencil: a kernel has no nonzero tap")
    return kernel


def _support(kernel: Kernel) -> tuple[Kernel, int, int]:
    """The kernel without its outer zeros, and the offset (row, column) of its first tap from the pixel."""
    rows = [i for i, row in enumerate(kernel) if any(row)]
    columns = [j for j in range(len(kernel[0])) if any(row[j] for row in kernel)]
    top, left = rows[0], columns[0]
    trimmed = tuple(row[left : columns[-1] + 1] for row in kernel[top : rows[-1] + 1])
    return trimmed, top - len(kernel) // 2, left - len(kernel[0]) // 2


def _margins(taps: Kernel, top: int, left: int) -> tuple[int, int, int, int]:
    """Absent slopes (left, right, top, bottom): the pixels at which the kernel would reach outside."""
    a, b = len(taps), len(taps[0])
    return max(0, -left), max(0, left + b - 1), max(0, -top), max(0, top + a - 1)


def _window(taps: Kernel, top: int, left: int, h: int, w: int) -> tuple[slice, slice]:
    """Rows and columns of the image that the kernel reads at the pixels where it fits."""
    before, after, above, below = _margins(taps, top, left)
    rows = slice(above + top, h - below + top + len(taps) - 1)
    return rows, slice(before + left, w - after + left + len(taps[0]) - 1)


def _fits(margins: tuple[int, int, int, int], h: int, w: int) -> bool:
    left, right, top, bottom = margins
    return left + right < w and top + bottom < h


def _two_taps(taps: Kernel) -> tuple[int, float, float] | None:
    """(dim, first, last) when only the ends of a one-dimensional kernel are nonzero."""
    line, dim = (taps[0], -1) if len(taps) == 1 else (tuple(row[0] for row in taps), -2)
    one_dimensional = len(taps) == 1 or len(taps[0]) == 1
    if one_dimensional and len(line) > 1 and not any(line[1:-1]):
        return dim, line[0], line[-1]
    return None


def _correlate(z: Tensor, kernel: Kernel, spacing: float) -> Tensor:
    taps, top, left = _support(kernel)
    h, w = z.shape[-2:]
    margins = _margins(taps, top, left)
    if not _fits(margins, h, w):
        return F.pad(z[..., :0], (0, w))  # zeros of which z is still a variable
    rows, columns = _window(taps, top, left, h, w)
    window = z[..., rows, columns]
    if pair := _two_taps(taps):
        dim, first, last = pair
        inner = window.shape[dim] - max(len(taps), len(taps[0])) + 1
        start, end = window.narrow(dim, 0, inner), window.narrow(dim, window.shape[dim] - inner, inner)
        slope = (
            (end - start) * (last / spacing) if first == -last else start * (first / spacing) + end * (last / spacing)
        )
    else:
        slope = F.conv2d(window, _weight(taps, spacing, z))
    return F.pad(slope, margins)


def _correlate_transpose(g: Tensor, kernel: Kernel, spacing: float) -> Tensor:
    taps, top, left = _support(kernel)
    h, w = g.shape[-2:]
    margins = _margins(taps, top, left)
    if not _fits(margins, h, w):
        return F.pad(g[..., :0], (0, w))
    g = g[..., margins[2] : h - margins[3], margins[0] : w - margins[1]]
    if pair := _two_taps(taps):
        dim, first, last = pair
        gap = max(len(taps), len(taps[0])) - 1
        after, before = ((0, gap), (gap, 0)) if dim == -1 else ((0, 0, 0, gap), (0, 0, gap, 0))
        image = F.pad(g * (first / spacing), after) + F.pad(g * (last / spacing), before)
    else:
        image = F.conv_transpose2d(g, _weight(taps, spacing, g))
    rows, columns = _window(taps, top, left, h, w)
    return F.pad(image, (columns.start, w - columns.stop, rows.start, h - rows.stop))


def _at_pixels(z: Tensor, dim: int, spacing: float) -> Tensor:
    n = z.shape[dim]
    if n < 3:
        return (z.narrow(dim, 1, 1) - z.narrow(dim, 0, 1)).expand_as(z) / spacing if n == 2 else torch.zeros_like(z)
    inner = (z.narrow(dim, 2, n - 2) - z.narrow(dim, 0, n - 2)) * 0.5
    a, b, c = _FIRST
    first = z.narrow(dim, 0, 1) * a + z.narrow(dim, 1, 1) * b + z.narrow(dim, 2, 1) * c
    last = z.narrow(dim, n - 1, 1) * -a - z.narrow(dim, n - 2, 1) * b - z.narrow(dim, n - 3, 1) * c
    return torch.cat([first, inner, last], dim) / spacing


def _at_pixels_transpose(g: Tensor, dim: int, spacing: float) -> Tensor:
    n, z = g.shape[dim], torch.zeros_like(g)
    if n < 3:
        return torch.cat([-g.sum(dim, keepdim=True), g.sum(dim, keepdim=True)], dim) / spacing if n == 2 else z
    inner, first, last = (g.narrow(dim, *part) for part in ((1, n - 2), (0, 1), (n - 1, 1)))
    z.narrow(dim, 2, n - 2).add_(inner, alpha=0.5)
    z.narrow(dim, 0, n - 2).sub_(inner, alpha=0.5)
    for i, tap in enumerate(_FIRST):
        z.narrow(dim, i, 1).add_(first, alpha=tap)
        z.narrow(dim, n - 1 - i, 1).sub_(last, alpha=tap)
    return z / spacing


def _roll(z: Tensor, kernel: Kernel, spacing: float, direction: int) -> Tensor:
    """The periodic correlation (direction -1) or its transpose (1): one turn of the image for each tap."""
    total = torch.zeros_like(z)
    for i, row in enumerate(kernel):
        for j, tap in enumerate(row):
            if tap:
                shifts = (direction * (i - len(kernel) // 2), direction * (j - len(row) // 2))
                total = total + z.roll(shifts, (-2, -1)) * (tap / spacing)
    return total


def _weight(taps: Kernel, spacing: float, like: Tensor) -> Tensor:
    return torch.tensor(taps, dtype=like.dtype, device=like.device)[None, None] / spacing
