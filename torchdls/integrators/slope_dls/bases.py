"""Square patches at places clipped into the image: orthonormal bases, and the exact noise of every coefficient."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchdls.noise import height_noise
from torchdls.operators.cosine import cosine_matrix
from torchdls.operators.tables import table

_GOLDEN = 0.381966  # of a stride: the shifts of the patch grid from one iteration to the next, never in step
_SMOOTH_FROM = 16  # pixels: smaller patches have too few atoms to spend six on polynomials
_DEGREE = 5
_EXACT = 192  # pixels: along longer sides the patches in the middle share their noise


@dataclass(frozen=True)
class Places:
    """Square patches of one size on a grid of half their side, clipped into the image.

    Coefficients stand as (N, C, W', H'), W' = columns of patches x size: transposed, patch after patch.

    Args:
        shape: (H, W) of the image.
        size: side of a patch, at most min(H, W).
        offset: rows and columns by which the grid starts before the image.
        smooth: bases of patches from 16 pixels on begin with polynomials.
    """

    shape: tuple[int, int]
    size: int
    offset: int = 0
    smooth: bool = True

    @classmethod
    def at(cls, iteration: int, shape: tuple[int, int], size: int, smooth: bool) -> Places:
        """The grid of an iteration."""
        stride = max(1, size // 2)
        return cls(shape, size, round(iteration * _GOLDEN * stride) % stride, smooth)

    @cached_property
    def positions(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """First rows and first columns of the patches."""
        rows, columns = (_positions(n, self.size, self.offset) for n in self.shape)
        return rows, columns

    def analyse(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> coefficients of all patches."""
        rows, columns = self.positions
        return self._forward(self._forward(x, columns).mT, rows)

    def synthesise(self, coefficients: Tensor) -> Tensor:
        """Sum of the patches that the coefficients describe, (N, C, H, W): the transpose of `analyse`."""
        (rows, columns), (h, w) = self.positions, self.shape
        return self._backward(self._backward(coefficients, rows, h).mT, columns, w)

    def spread(self, weight: Tensor) -> Tensor:
        """Sums (N, C, H, W) over the patches of one number for each, (N, C, columns, rows) of patches."""
        rows, columns = (_inside(n, self.size, p, like=weight) for n, p in zip(self.shape, self.positions, strict=True))
        return (columns.mT @ weight @ rows).mT

    def patchwise(self, coefficients: Tensor) -> Tensor:
        """Coefficients as (N, C, columns of patches, size, rows of patches, size)."""
        return coefficients.unflatten(-1, (-1, self.size)).unflatten(-3, (-1, self.size))

    def noise(self, like: Tensor, steps: tuple[float, float], turned: bool = False) -> Tensor:
        r"""Standard deviation of every coefficient of the projected slopes at its place, for white noise of level 1.

            var c_x = F_a S F_d^T / dx^2,   var c_y = F_d S F_a^T / dy^2
            F_a = (T M^T)^2,   F_d = (T E M^T)^2   elementwise

        T has an atom of a patch in every row, placed in the image; M is the cosine matrix, E the difference of
        neighbours, continued at the end, and S the noise of the height (`height_noise`). Near the border slow atoms
        of large patches carry up to 1.8 times the noise that they carry far from it.

        Args:
            like: a tensor of the wanted dtype and device.
            steps: (dx, dy).
            turned: for the slopes along the diagonals, (p + q, p - q) / sqrt 2, in the place of p and q.

        Returns:
            (2, W', H').
        """
        (h, rows), (w, columns) = (_less(n, self.size, self.offset) for n in self.shape)
        found: Tensor = _noise((h, w), self.size, self.offset, self.smooth, tuple(steps), turned, like=like)
        if (h, w) == self.shape:
            return found
        by_patch = found.unflatten(-1, (-1, self.size)).unflatten(-3, (-1, self.size))
        down, across = (torch.tensor(k, device=like.device) for k in (rows, columns))
        return by_patch.index_select(1, across).index_select(3, down).flatten(1, 2).flatten(2)

    def _forward(self, x: Tensor, positions: tuple[int, ...]) -> Tensor:
        index, atoms = _samples(self.size, positions, like=x), _atoms(self.size, self.smooth, like=x)
        return (x.index_select(-1, index).unflatten(-1, (-1, self.size)) @ atoms.mT).flatten(-2)

    def _backward(self, c: Tensor, positions: tuple[int, ...], n: int) -> Tensor:
        atoms = _atoms(self.size, self.smooth, like=c)
        patches = (c.unflatten(-1, (-1, self.size)) @ atoms).flatten(-2)
        if len(positions) == 1:
            return patches
        index = _owners(n, self.size, positions, like=c)
        return torch.nn.functional.pad(patches, (0, 1)).index_select(-1, index).unflatten(-1, (-1, n)).sum(-2)


def _positions(n: int, size: int, offset: int) -> tuple[int, ...]:
    stride = max(1, size // 2)
    steps = range(-(-(n - size + offset) // stride) + 1)
    return tuple(sorted({min(max(0, k * stride - offset), n - size) for k in steps}))


def _less(n: int, size: int, offset: int) -> tuple[int, list[int]]:
    """A side that is shorter by whole strides, and the patch of it that stands for each patch of the whole side."""
    stride = max(1, size // 2)
    left_out = max(0, n - max(_EXACT, 4 * size)) // stride
    less = n - left_out * stride
    count = len(_positions(less, size, offset))
    half = count // 2
    return less, [*range(half), *[half] * left_out, *range(half, count)]


@table
def _samples(size: int, positions: tuple[int, ...]) -> Tensor:
    """(patches x size,) the sample that each entry of a patch is."""
    return (torch.tensor(positions, device="cpu")[:, None] + torch.arange(size, device="cpu")).flatten()


def _owners_build(n: int, size: int, positions: tuple[int, ...]) -> Tensor:
    """(most x n,) the entries of patches that lie on each sample, filled up with the entry after the last."""
    found: list[list[int]] = [[] for _ in range(n)]
    for k, p in enumerate(positions):
        for i in range(size):
            found[p + i].append(k * size + i)
    most, none = max(map(len, found)), len(positions) * size
    return torch.tensor([[f[j] if j < len(f) else none for f in found] for j in range(most)], device="cpu").flatten()


@table
def _inside(n: int, size: int, positions: tuple[int, ...]) -> Tensor:
    """(patches, n) 1 inside the patch."""
    k = torch.arange(n, device="cpu") - torch.tensor(positions, device="cpu")[:, None]
    return ((k >= 0) & (k < size)).double()


@table
def _atoms(size: int, smooth: bool) -> Tensor:
    """(size, size) orthonormal rows: cosines, from 16 pixels on after polynomials of degree 0 to 5 (Gram-Schmidt)."""
    cosines = cosine_matrix(size, like=torch.empty(0, dtype=torch.float64, device="cpu"))
    if not smooth or size < _SMOOTH_FROM:
        return cosines
    t = torch.linspace(-1, 1, size, dtype=torch.float64, device="cpu")
    powers = torch.stack([t**k for k in range(_DEGREE + 1)])
    q, r = torch.linalg.qr(torch.cat([powers, cosines[1 : size - _DEGREE]]).mT)
    return (q * r.diagonal().sign()).mT.contiguous()


def _build_noise(
    shape: tuple[int, int], size: int, offset: int, smooth: bool, steps: tuple[float, float], turned: bool
) -> Tensor:
    double = torch.empty(0, dtype=torch.float64, device="cpu")
    variance = height_noise(shape, double, steps).mT
    value_y, slope_y = _seen(shape[0], size, offset, smooth, double)
    value_x, slope_x = _seen(shape[1], size, offset, smooth, double)
    slope_x, slope_y = slope_x / steps[0], slope_y / steps[1]
    in_x = slope_x.square() @ variance @ value_y.square().mT
    in_y = value_x.square() @ variance @ slope_y.square().mT
    if turned:
        shared, mean = (slope_x * value_x) @ variance @ (slope_y * value_y).mT, (in_x + in_y) / 2
        in_x, in_y = mean + shared, mean - shared
    return torch.stack([in_x, in_y]).clamp(min=0).sqrt()


def _seen(n: int, size: int, offset: int, smooth: bool, double: Tensor) -> tuple[Tensor, Tensor]:
    """What each placed atom sees of each cosine mode, and of its differences: T M^T and T E M^T."""
    positions, atoms, modes = (
        _positions(n, size, offset),
        _atoms(size, smooth, like=double),
        cosine_matrix(n, like=double),
    )
    difference = modes.diff(dim=1)
    last = difference[:, -1:] if n > 1 else torch.zeros_like(modes)
    difference = torch.cat([difference, last], 1)
    value, slope = (torch.cat([atoms @ m[:, p : p + size].mT for p in positions]) for m in (modes, difference))
    return value, slope


_owners = table(_owners_build)
_noise = table(_build_noise)
