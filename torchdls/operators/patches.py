"""Overlapping patches of an image, put back by the exact transpose."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class Patches:
    """The maps P_j that cut an image into overlapping patches, covering every pixel.

    Patches start at 0, s, 2s, .. along each axis; where the last of them does not reach the border, one more patch is
    placed flush with it. So every pixel lies in a patch at every image size of at least one patch.

        axis of 11 pixels, size 4, stride 3:   [0 1 2 3] . . . . . . .
                                                . . . [3 4 5 6] . . . .
                                                . . . . . . [6 7 8 9] .
                                                . . . . . . . [7 8 9 10]      the extra one

    Patches are numbered row by row over the grid of `grid(shape)`; a patch is flattened row by row, as in `F.unfold`.

    Args:
        size: rows and columns of a patch, or one number for both.
        stride: step between patches along rows and columns, or one number for both; at most the size.

    Raises:
        ValueError: a size or stride is not a positive integer, or a stride exceeds its size (pixels would be left out).
    """

    size: int | tuple[int, int] = 8
    stride: int | tuple[int, int] = 2

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", _pair("size", self.size))
        object.__setattr__(self, "stride", _pair("stride", self.stride))
        if any(s > p for s, p in zip(self._stride, self._size, strict=True)):
            raise ValueError(
                f"stride: {self._stride} exceeds the patch size {self._size} and would leave pixels uncovered"
            )

    @property
    def _size(self) -> tuple[int, int]:
        return self.size  # type: ignore[return-value]

    @property
    def _stride(self) -> tuple[int, int]:
        return self.stride  # type: ignore[return-value]

    @property
    def n_pixels(self) -> int:
        """n, the number of pixels of a patch."""
        return self._size[0] * self._size[1]

    def grid(self, shape: Sequence[int]) -> tuple[int, int]:
        """Patches down and across an image of shape (.., H, W); ValueError if it is smaller than a patch."""
        h, w = shape[-2:]
        if h < self._size[0] or w < self._size[1]:
            raise ValueError(f"image of {h} x {w} pixels is smaller than a patch of {self._size[0]} x {self._size[1]}")
        rows, columns = ((m - p + s - 1) // s + 1 for m, p, s in zip((h, w), self._size, self._stride, strict=True))
        return rows, columns

    def extract(self, z: Tensor) -> Tensor:
        """All patches: (N, 1, H, W) -> (N, n, L), L = rows * columns of `grid`."""
        n = z.shape[0]
        rows, columns = self.grid(z.shape)
        pieces = [
            [
                F.unfold(z[..., r, c], self._size, stride=self._stride).unflatten(-1, (nr, nc))
                for c, nc in self._spans(z, 1)
            ]
            for r, nr in self._spans(z, 0)
        ]
        strips = [torch.cat(p, -1) if len(p) > 1 else p[0] for p in pieces]
        return (torch.cat(strips, -2) if len(strips) > 1 else strips[0]).reshape(n, self.n_pixels, rows * columns)

    def adjoint(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        """Exact transpose, summing overlaps: (N, n, L) -> (N, 1, H, W), with (H, W) the last two of `shape`."""
        h, w = shape[-2:]
        x = x.unflatten(-1, self.grid(shape))
        image: Tensor | None = None
        row = 0
        for r, nr in self._spans_of(h, 0):
            column = 0
            for c, nc in self._spans_of(w, 1):
                block = x[:, :, row : row + nr, column : column + nc].flatten(-2)
                part = F.fold(block, (r.stop - r.start, c.stop - c.start), self._size, stride=self._stride)
                part = F.pad(part, (c.start, w - c.stop, r.start, h - r.stop))
                image = part if image is None else image + part
                column += nc
            row += nr
        assert image is not None
        return image

    def coverage(self, shape: Sequence[int], *, dtype: torch.dtype, device: torch.device | str = "cpu") -> Tensor:
        """(1, 1, H, W): how many patches hold each pixel; the diagonal of sum_j P_j^T P_j."""
        counts = [self._axis_coverage(m, axis, dtype, device) for axis, m in enumerate(shape[-2:])]
        return (counts[0][:, None] * counts[1])[None, None]

    def _axis_coverage(self, m: int, axis: int, dtype: torch.dtype, device: torch.device | str) -> Tensor:
        size = self._size[axis]
        starts = torch.tensor(
            [s.start + i * self._stride[axis] for s, k in self._spans_of(m, axis) for i in range(k)],
            device="cpu",
        )
        pixels = torch.arange(m, device="cpu")
        held = (pixels >= starts[:, None]) & (pixels < starts[:, None] + size)
        return held.sum(0).to(dtype).to(device)

    def _spans(self, z: Tensor, axis: int) -> list[tuple[slice, int]]:
        return self._spans_of(z.shape[-2 + axis], axis)

    def _spans_of(self, m: int, axis: int) -> list[tuple[slice, int]]:
        """Pixels and patch count of the regular part of an axis and, where needed, of the extra patch at its end."""
        size, stride = self._size[axis], self._stride[axis]
        regular = (m - size) // stride + 1
        reach = (regular - 1) * stride + size
        spans = [(slice(0, reach), regular)]
        return spans if reach == m else [*spans, (slice(m - size, m), 1)]


def _pair(name: str, value: int | Sequence[int]) -> tuple[int, int]:
    pair = tuple(value) if isinstance(value, Iterable) else (value, value)
    if len(pair) != 2 or not all(isinstance(v, int) and not isinstance(v, bool) and v > 0 for v in pair):
        raise ValueError(f"{name}: {value!r} given, a positive integer or a pair (rows, columns) of them is needed")
    return pair[0], pair[1]
