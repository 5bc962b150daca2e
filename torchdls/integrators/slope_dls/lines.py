"""Overlapping segments along one axis: their coefficients in an orthonormal basis, and the sum of them laid back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from torchdls._tracing import is_recorded
from torchdls.operators.cosine import cosine_matrix
from torchdls.operators.tables import table

_SMOOTH_FROM = 16  # samples: shorter segments have too few atoms to spend six on polynomials
_DEGREE = 5
_DENSE = 128  # samples: along axes up to this one product with all placed atoms is faster (measured on a CPU)


@dataclass(frozen=True)
class Line:
    """Segments of one length, half of it apart, clipped into an axis, and their orthonormal basis.

    All but the first and the last stand on a regular grid of blocks of half a segment. There a segment is block k and
    those after it, so that its coefficients are a sum of products with whole rows of blocks, and no sample is copied
    once for each segment that holds it. Along a short axis all is one product with a dense matrix.

    Args:
        n: length of the axis.
        size: length of a segment, at most n.
        offset: samples by which the grid starts before the axis.
        smooth: bases of segments from 16 samples on begin with polynomials.
    """

    n: int
    size: int
    offset: int = 0
    smooth: bool = True

    @property
    def stride(self) -> int:
        """Distance of the segments: half their length."""
        return max(1, self.size // 2)

    @property
    def positions(self) -> tuple[int, ...]:
        """First samples of the segments."""
        return _positions(self.n, self.size, self.offset, self.stride)

    def rows(self, x: Tensor) -> Tensor:
        """(.., n, W) -> (size, .., segments, W): coefficients of the segments of every column."""
        if self.n <= _DENSE:
            return _from_left(placed(self, like=x).flatten(0, 1), x).unflatten(0, (self.size, -1)).movedim(1, -2)
        parts = []
        for first, count in self._groups:
            blocks = self._blocks(x.mT, first, count).mT.unflatten(-2, (-1, self._step(count)))
            pieces = [_from_left(a, blocks[..., j : j + count, :, :]) for j, a in enumerate(self._pieces(count, x))]
            parts.append(_sum(pieces))
        return torch.cat(parts, -2)

    def columns(self, x: Tensor) -> Tensor:
        """(.., n) -> (.., segments, size): coefficients of the segments of every row."""
        if self.n <= _DENSE:
            return (x @ placed_by_segment(self, like=x).mT).unflatten(-1, (-1, self.size))
        parts = []
        for first, count in self._groups:
            blocks = self._blocks(x, first, count).contiguous().unflatten(-1, (-1, self._step(count)))
            pieces = [(blocks @ a.mT)[..., j : j + count, :] for j, a in enumerate(self._pieces(count, x))]
            parts.append(_sum(pieces))
        return torch.cat(parts, -2)

    def lay_rows(self, c: Tensor) -> Tensor:
        """(size, .., segments, W) -> (.., n, W): the sum of the segments, the transpose of `rows`."""
        if self.n <= _DENSE:
            return torch.tensordot(placed(self, like=c), c, ([0, 1], [0, c.ndim - 2])).movedim(0, -2)
        total = c.new_zeros(*c.shape[1:-2], self.n + self.stride, c.shape[-1])
        for part, (first, count) in zip(self._split(c, -2), self._groups, strict=True):
            step = self._step(count)
            for j, a in enumerate(self._pieces(count, c)):
                start, found = first + j * step, torch.tensordot(a, part, ([0], [0])).movedim(0, -2)
                total[..., start : start + count * step, :].unflatten(-2, (count, step)).add_(found)
        return total[..., : self.n, :]

    def lay_columns(self, c: Tensor) -> Tensor:
        """(.., segments, size) -> (.., n): the sum of the segments, the transpose of `columns`."""
        if self.n <= _DENSE:
            return c.flatten(-2) @ placed_by_segment(self, like=c)
        total = c.new_zeros(*c.shape[:-2], self.n + self.stride)
        for part, (first, count) in zip(self._split(c, -2), self._groups, strict=True):
            part, step = part.contiguous(), self._step(count)
            for j, a in enumerate(self._pieces(count, c)):
                total[..., first + j * step : first + (j + count) * step].add_((part @ a).flatten(-2))
        return total[..., : self.n]

    def spread(self, weight: Tensor) -> Tensor:
        """(.., segments) -> (.., n): sums over the segments of one number for each."""
        if self.n <= _DENSE:
            return weight @ inside(self, like=weight)
        total = weight.new_zeros(*weight.shape[:-1], self.n + self.stride)
        for part, (first, count) in zip(self._split(weight, -1), self._groups, strict=True):
            step = self._step(count)
            for start in range(0, self.size, step):
                blocks = total[..., first + start : first + start + count * step].unflatten(-1, (count, step))
                blocks[..., : self.size - start].add_(part[..., None])
        return total[..., : self.n]

    @property
    def _groups(self) -> list[tuple[int, int]]:
        """(first sample, number) of runs of segments that lie on the grid together."""
        positions, stride = self.positions, self.stride
        first = 0 if self.offset == 0 else 1  # the others before the last are on the grid
        count = len(positions) - first - ((positions[-1] + self.offset) % stride > 0)
        if count < 2:
            return [(p, 1) for p in positions]
        return [
            *((p, 1) for p in positions[:first]),
            (positions[first], count),
            *((p, 1) for p in positions[first + count :]),
        ]

    def _step(self, count: int) -> int:
        """Side of the blocks of a run: a single segment is one block."""
        return self.size if count == 1 else self.stride

    def _blocks(self, x: Tensor, first: int, count: int) -> Tensor:
        """(.., n) -> (.., blocks x step): the blocks that a run reaches."""
        step = self._step(count)
        end = first + (count - 1) * step + -(-self.size // step) * step
        return x[..., first:end] if end <= self.n else functional.pad(x[..., first:], (0, end - self.n))

    def _pieces(self, count: int, like: Tensor) -> Iterator[Tensor]:
        """What the atoms see of the first block of a segment, of the second, and (odd lengths) of a third."""
        whole, step = atoms(self.size, self.smooth, like=like), self._step(count)
        for start in range(0, self.size, step):
            piece = whole[:, start : start + step]
            yield piece if piece.shape[1] == step else functional.pad(piece, (0, step - piece.shape[1]))

    def _split(self, c: Tensor, dim: int) -> tuple[Tensor, ...]:
        return c.split([count for _, count in self._groups], dim)


@lru_cache(maxsize=256)
def _positions(n: int, size: int, offset: int, stride: int) -> tuple[int, ...]:
    steps = range(-(-(n - size + offset) // stride) + 1)
    return tuple(sorted({min(max(0, k * stride - offset), n - size) for k in steps}))


@table
def atoms(size: int, smooth: bool) -> Tensor:
    """(size, size) orthonormal rows: cosines, from 16 samples on after polynomials of degree 0 to 5 (Gram-Schmidt).

    Every atom is even or odd about the middle, and Gram-Schmidt goes over the even and over the odd ones apart: from 32
    samples on, both together would leave to rounding what the last atoms are, which the others all but span.
    """
    cosines = cosine_matrix(size, like=torch.empty(0, dtype=torch.float64, device="cpu"))
    if not smooth or size < _SMOOTH_FROM:
        return cosines
    t = torch.linspace(-1, 1, size, dtype=torch.float64, device="cpu")
    functions = torch.cat([torch.stack([t**k for k in range(_DEGREE + 1)]), cosines[1:]])
    parity = [*(k % 2 for k in range(_DEGREE + 1)), *(k % 2 for k in range(1, size))]
    kept: list[int] = []  # counted from the size: tensors may be without values
    found = torch.zeros_like(functions)
    for odd in (0, 1):
        half = (size + 1 - odd) // 2  # samples that are free; the middle one, if any, counts once
        own = [k for k, p in enumerate(parity) if p == odd][:half]
        scale = t.new_full((half,), 2).sqrt()
        scale[size // 2 :] = 1
        q, r = torch.linalg.qr((functions[own, :half] * scale).mT)
        left = (q * r.diagonal().sign()).mT / scale
        found[own, :half] = left
        found[own, size - half :] = left.flip(1) * (1 - 2 * odd)
        kept += own
    return found[sorted(kept)]


def _inside(line: Line) -> Tensor:
    """(segments, n) 1 inside the segment."""
    k = torch.arange(line.n, device="cpu") - torch.tensor(line.positions, device="cpu")[:, None]
    return ((k >= 0) & (k < line.size)).double()


def _placed(line: Line) -> Tensor:
    """(size, segments, n): all atoms at their places."""
    double = torch.empty(0, dtype=torch.float64, device="cpu")
    found = double.new_zeros(line.size, len(line.positions), line.n)
    for k, p in enumerate(line.positions):
        found[:, k, p : p + line.size] = atoms(line.size, line.smooth, like=double)
    return found


def _placed_by_segment(line: Line) -> Tensor:
    """(segments x size, n): the same, segment after segment."""
    return _placed(line).transpose(0, 1).flatten(0, 1)


inside, placed, placed_by_segment = (table(build) for build in (_inside, _placed, _placed_by_segment))


def _from_left(a: Tensor, x: Tensor) -> Tensor:
    """(k, n), (.., n, W) -> (k, .., W)."""
    return torch.tensordot(a, x, ([1], [x.ndim - 2]))


def _sum(pieces: list[Tensor]) -> Tensor:
    """Of fresh tensors, in the memory of the first where nothing is recorded."""
    total, in_place = pieces[0], not is_recorded(*pieces)
    for piece in pieces[1:]:
        total = total.add_(piece) if in_place else total + piece
    return total
