"""Overlapping patches of an image, put back by the exact transpose."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_dtype, check_field, check_real, require
from torchdls._precision import full_precision
from torchdls._tracing import is_recorded


@dataclass(frozen=True)
class Patches:
    """The maps P_j that cut an image into overlapping patches, covering every pixel.

    Patches start at 0, s, 2s, .. along each axis; where the last of them does not reach the border, one more patch is
    placed flush with it. So every pixel lies in a patch at every image size of at least one patch.

        axis of 11 pixels, size 4, stride 3:   [0 1 2 3] . . . . . . .
                                                . . . [3 4 5 6] . . . .
                                                . . . . . . [6 7 8 9] .
                                                . . . . . . . [7 8 9 10]      the extra one

    With `wrap` the image repeats: patches reach over its last row and column to the first, all on the one grid, and
    every pixel lies in equally many.

    Patches are numbered row by row over the grid of `grid(shape)`; a patch is flattened row by row, as in `F.unfold`.

    Args:
        size: rows and columns of a patch, or one number for both.
        stride: step between patches along rows and columns, or one number for both; at most the size.
        wrap: the image repeats; then the stride divides the size, and the sides of the image.

    Raises:
        ValueError: a size or stride is not a positive integer, a stride exceeds its size (pixels would be left out),
            or does not divide it where patches wrap.

    Example:
        >>> patches = torchdls.Patches(4, stride=2)
        >>> x = patches.extract(torch.zeros(1, 1, 8, 6))
        >>> x.shape  # 3 x 2 patches of 16 pixels
        torch.Size([1, 16, 6])
        >>> patches.adjoint(x, (8, 6)).shape
        torch.Size([1, 1, 8, 6])
    """

    size: int | tuple[int, int] = 8
    stride: int | tuple[int, int] = 2
    wrap: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", _pair("size", self.size))
        object.__setattr__(self, "stride", _pair("stride", self.stride))
        if any(s > p for s, p in zip(self._stride, self._size, strict=True)):
            raise ValueError(
                f"stride: {self._stride} exceeds the patch size {self._size} and would leave pixels uncovered"
            )
        if self.wrap and any(p % s for s, p in zip(self._stride, self._size, strict=True)):
            raise ValueError(
                f"stride: {self._stride} does not divide the patch size {self._size}; patches that wrap need it"
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
        if not self.fit(shape):
            raise ValueError(f"image of {h} x {w} pixels is smaller than a patch of {self._size[0]} x {self._size[1]}")
        if self.wrap:
            down, across = self._stride
            if h % down or w % across:
                raise ValueError(
                    f"image of {h} x {w} pixels: patches that wrap need sides that the stride {self._stride} divides"
                )
            return h // down, w // across
        rows, columns = ((m - p + s - 1) // s + 1 for m, p, s in zip((h, w), self._size, self._stride, strict=True))
        return rows, columns

    def fit(self, shape: Sequence[int]) -> bool:
        """Whether an image of shape (.., H, W) holds a patch."""
        return all(m >= p for m, p in zip(shape[-2:], self._size, strict=True))

    def even(self, shape: Sequence[int]) -> bool:
        """Whether every pixel of an image of shape (.., H, W) is in equally many patches: side by side, or wrapped."""
        beside = self.stride == self.size and all(m % p == 0 for m, p in zip(shape[-2:], self._size, strict=True))
        return self.wrap or beside

    def touching(self, axis: int, length: int, low: int, high: int) -> tuple[slice, slice]:
        """Pixels and numbers of the patches that hold a pixel from `low` to `high`, along an axis of `length` pixels.

        Cut to these pixels, the axis has just these patches, in the same places.
        """
        size, stride = self._size[axis], self._stride[axis]
        last_start = length - size  # of the last patch, flush with the border
        count = -(-last_start // stride) + 1
        first = min(max(0, -(-(low - size + 1) // stride)), count - 1)
        last = count - 1 if high >= last_start else high // stride
        return slice(min(first * stride, last_start), min(last * stride, last_start) + size), slice(first, last + 1)

    @full_precision
    def extract(self, z: Tensor) -> Tensor:
        """All patches: (N, 1, H, W) -> (N, n, L), L = rows * columns of `grid`; each patch is contiguous in memory.

        TypeError for a dtype other than float32 and float64, ValueError for another shape.
        """
        check_field("Patches", "z", z, 1)
        require(z.ndim == 4, f"Patches: z {tuple(z.shape)} given, (N, 1, H, W) is needed")
        return self._gather(z) if torch.compiler.is_compiling() else _Extract.apply(z, self)

    @full_precision
    def adjoint(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        """Exact transpose, summing overlaps: (N, n, L) -> (N, 1, H, W), with (H, W) the last two of `shape`."""
        size = (shape[-2], shape[-1])
        self._check(x, size)
        return self._scatter(x, size) if torch.compiler.is_compiling() else _Adjoint.apply(x, self, size)

    def extract_onto(self, x: Tensor, z: Tensor) -> Tensor:
        """X + extract(z); where no derivative is recorded, x is overwritten and no copy of the patches is made."""
        check_field("Patches", "z", z, 1)
        self._check(x, z.shape[-2:])
        check_alike("Patches", "z", z, x.dtype)
        if is_recorded(x, z):
            return x + self.extract(z)
        self._gather(z, x)
        return x

    def _check(self, x: Tensor, size: Sequence[int]) -> None:
        check_real("Patches", "x", x)
        rows, columns = self.grid(size)
        needed = f"(N, {self.n_pixels}, {rows * columns}) is needed"
        fits = x.ndim == 3 and x.shape[1:] == (self.n_pixels, rows * columns)
        require(fits, f"Patches: x {tuple(x.shape)} given, {needed}")

    @property
    def _reach(self) -> tuple[int, int]:
        """Pixels by which wrapped patches reach beyond the last row and column."""
        return self._size[0] - self._stride[0], self._size[1] - self._stride[1]

    # Patches lie in memory one after the other, so that a column of the (n, L) matrix is contiguous: products with few
    # atoms stream through them, and the patches that use an atom can be gathered.

    def _gather(self, z: Tensor, onto: Tensor | None = None) -> Tensor:
        if self.wrap:
            return Patches(self.size, self.stride)._gather(_extended(z, self._reach), onto)
        rows, columns = self.grid(z.shape)
        x = z.new_empty(z.shape[0], rows * columns, self.n_pixels).mT if onto is None else onto
        grid = x.mT.unflatten(1, (rows, columns)).unflatten(3, self._size)
        for patches, pixels in self._blocks(z.shape):
            windows = z[:, 0, *pixels]
            for axis in (0, 1):
                windows = windows.unfold(1 + axis, self._size[axis], self._stride[axis])
            part = grid[:, *patches]
            (part.copy_ if onto is None else part.add_)(windows)
        return x

    def _scatter(self, x: Tensor, size: tuple[int, int]) -> Tensor:
        if self.wrap:
            down, across = self._reach
            whole = Patches(self.size, self.stride)._scatter(x, (size[0] + down, size[1] + across))
            return _folded(whole, self._reach)
        grid = x.mT.unflatten(1, self.grid(size)).unflatten(3, self._size)
        z = x.new_zeros(x.shape[0], 1, *size)
        for patches, pixels in self._blocks(size):
            z[:, 0, *pixels].add_(self._fold(grid[:, *patches]))
        return z

    def _fold(self, x: Tensor) -> Tensor:
        """(N, rows, columns, c_y, c_x) regular patches -> (N, h, w), one axis after the other.

        The image is cut into bands of s_y rows: s_y rows of all patches at once go into the bands below. Then pixel j
        of all patches is a strided slice of the image.
        """
        (rows, columns), (c_y, c_x), (s_y, s_x) = x.shape[1:3], self._size, self._stride
        strips = x.new_zeros(x.shape[0], rows + (c_y - 1) // s_y, columns, s_y, c_x)
        for band, top in enumerate(range(0, c_y, s_y)):
            part = x[:, :, :, top : top + s_y]
            strips[:, band : band + rows, :, : part.shape[3]].add_(part)
        h, w = (rows - 1) * s_y + c_y, (columns - 1) * s_x + c_x
        bands = x.new_zeros(x.shape[0], strips.shape[1], s_y, w)
        for j in range(c_x):
            bands[..., j : j + (columns - 1) * s_x + 1 : s_x].add_(strips[..., j].mT)
        return bands.flatten(1, 2)[:, :h]

    def _blocks(self, shape: Sequence[int]) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
        """Patches on a regular grid, and the pixels they cover: one block, or up to four where there are extra ones."""
        top = 0
        for down, rows in self._spans_of(shape[-2], 0):
            left = 0
            for across, columns in self._spans_of(shape[-1], 1):
                yield (slice(top, top + rows), slice(left, left + columns)), (down, across)
                left += columns
            top += rows

    def coverage(self, shape: Sequence[int], *, dtype: torch.dtype, device: torch.device | str = "cpu") -> Tensor:
        """(1, 1, H, W): how many patches hold each pixel; the diagonal of sum_j P_j^T P_j."""
        check_dtype("Patches", dtype)
        counts = [self._axis_coverage(m, axis, dtype, device) for axis, m in enumerate(shape[-2:])]
        return (counts[0][:, None] * counts[1])[None, None]

    def _axis_coverage(self, m: int, axis: int, dtype: torch.dtype, device: torch.device | str) -> Tensor:
        size = self._size[axis]
        if self.wrap:
            return torch.full((m,), size // self._stride[axis], dtype=dtype, device=device)
        starts = torch.tensor(
            [s.start + i * self._stride[axis] for s, k in self._spans_of(m, axis) for i in range(k)],
            device="cpu",
        )
        pixels = torch.arange(m, device="cpu")
        held = (pixels >= starts[:, None]) & (pixels < starts[:, None] + size)
        return held.sum(0).to(dtype).to(device)

    def _spans_of(self, m: int, axis: int) -> list[tuple[slice, int]]:
        """Pixels and patch count of the regular part of an axis and, where needed, of the extra patch at its end."""
        size, stride = self._size[axis], self._stride[axis]
        regular = (m - size) // stride + 1
        reach = (regular - 1) * stride + size
        spans = [(slice(0, reach), regular)]
        return spans if reach == m else [*spans, (slice(m - size, m), 1)]


def _extended(z: Tensor, reach: tuple[int, int]) -> Tensor:
    """The first rows and columns of a repeating image once more behind its last ones."""
    z = torch.cat([z, z[..., : reach[0], :]], -2)
    return torch.cat([z, z[..., : reach[1]]], -1)


def _folded(z: Tensor, reach: tuple[int, int]) -> Tensor:
    """The transpose of `_extended`; writes to z."""
    h, w = z.shape[-2] - reach[0], z.shape[-1] - reach[1]
    z[..., : reach[1]] += z[..., w:]
    z[..., : reach[0], :] += z[..., h:, :]
    return z[..., :h, :w].contiguous()


class _Extract(torch.autograd.Function):
    """`Patches.extract`: linear, so its derivative is itself and its transpose is `_Adjoint`."""

    @staticmethod
    def forward(z: Tensor, patches: Patches) -> Tensor:
        return patches._gather(z)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.patches, ctx.size = inputs[1], tuple(inputs[0].shape[-2:])

    @staticmethod
    def backward(ctx: Any, dx: Tensor) -> tuple[Tensor, None]:
        return _Adjoint.apply(dx, ctx.patches, ctx.size), None

    @staticmethod
    def jvp(ctx: Any, dz: Tensor, *_: Any) -> Tensor:
        return _Extract.apply(dz, ctx.patches)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], z: Tensor, patches: Patches) -> tuple[Tensor, int]:
        z = z.movedim(in_dims[0] or 0, 0)
        return _Extract.apply(z.flatten(0, 1), patches).unflatten(0, z.shape[:2]), 0


class _Adjoint(torch.autograd.Function):
    """`Patches.adjoint`: linear, so its derivative is itself and its transpose is `_Extract`."""

    @staticmethod
    def forward(x: Tensor, patches: Patches, size: tuple[int, int]) -> Tensor:
        return patches._scatter(x, size)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.patches, ctx.size = inputs[1:]

    @staticmethod
    def backward(ctx: Any, dz: Tensor) -> tuple[Tensor, None, None]:
        return _Extract.apply(dz, ctx.patches), None, None

    @staticmethod
    def jvp(ctx: Any, dx: Tensor, *_: Any) -> Tensor:
        return _Adjoint.apply(dx, ctx.patches, ctx.size)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], x: Tensor, patches: Patches, size: tuple[int, int]
    ) -> tuple[Tensor, int]:
        x = x.movedim(in_dims[0] or 0, 0)
        return _Adjoint.apply(x.flatten(0, 1), patches, size).unflatten(0, x.shape[:2]), 0


def _pair(name: str, value: int | Sequence[int]) -> tuple[int, int]:
    pair = tuple(value) if isinstance(value, Iterable) else (value, value)
    if len(pair) != 2 or not all(isinstance(v, int) and not isinstance(v, bool) and v > 0 for v in pair):
        raise ValueError(f"{name}: {value!r} given, a positive integer or a pair (rows, columns) of them is needed")
    return pair[0], pair[1]
