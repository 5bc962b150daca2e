"""Square patches at places clipped into the image: orthonormal bases, and the exact noise of every coefficient."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from torchdls.integrators.slope_dls.lines import Line, atoms, inside
from torchdls.noise import height_noise
from torchdls.operators.cosine import cosine_matrix
from torchdls.operators.modes import mode_sines
from torchdls.operators.tables import table

_GOLDEN = 0.381966  # of a stride: the shifts of the patch grid from one iteration to the next, never in step
_EXACT = 192  # pixels: along longer sides the patches in the middle share their noise
_AT_ONCE = 1 << 18  # coefficients that are held at a time: they stay in the cache


@dataclass(frozen=True)
class Places:
    """Square patches of one size on a grid of half their side, clipped into the image.

    Patches in a row share the transform of their columns: `down` transforms the columns of strips of rows, once for
    the whole strip, and `across` goes on from there, a few strips at a time. Coefficients stand as
    (size, N, C, rows of patches, columns of patches, size).

    Args:
        shape: (H, W) of the image.
        size: side of a patch, at most min(H, W).
        offset: rows and columns by which the grid starts before the image, one number or one for each.
        smooth: bases of patches from 16 pixels on begin with polynomials.
    """

    shape: tuple[int, int]
    size: int
    offset: int | tuple[int, int] = 0
    smooth: bool = True

    @classmethod
    def at(cls, iteration: int, shape: tuple[int, int], size: int, smooth: bool) -> Places:
        """The grid of an iteration."""
        stride = max(1, size // 2)
        offset = 0 if shape == (size, size) else round(iteration * _GOLDEN * stride) % stride  # one patch has one place
        return cls(shape, size, offset, smooth)

    def around(self) -> tuple[Places, Tensor, Tensor]:
        """The same grid on a torus, laid out flat.

        Returns:
            Patches of an image that holds every patch of the torus once, and the row and the column of the torus that
            each of its rows and columns is.
        """
        stride, positions = max(1, self.size // 2), []
        for n, offset in zip(self.shape, self.offsets, strict=True):
            length = (-(-n // stride) - 1) * stride + self.size
            positions.append((torch.arange(length, device="cpu") - offset) % n)
        rows, columns = positions
        return Places((len(rows), len(columns)), self.size, 0, self.smooth), rows, columns

    @property
    def offsets(self) -> tuple[int, int]:
        """Of rows and columns."""
        return (self.offset, self.offset) if isinstance(self.offset, int) else self.offset

    @cached_property
    def lines(self) -> tuple[Line, Line]:
        """The segments of the rows and the columns."""
        (h, w), (down, across) = self.shape, self.offsets
        return Line(h, self.size, down, self.smooth), Line(w, self.size, across, self.smooth)

    def within(self, live: Tensor) -> tuple[Places, tuple[slice, slice], tuple[slice, slice]]:
        """The same patches on the smallest window that holds the live ones.

        Args:
            live: (rows, columns) bool of patches.

        Returns:
            The patches of the window, its rows and columns of pixels, and those of its patches.
        """
        pixels, patches, offsets = [], [], []
        for line, dim, offset in zip(self.lines, (1, 0), self.offsets, strict=True):
            alive = live.any(dim).nonzero().flatten()
            first, last = (int(alive[0]), int(alive[-1])) if len(alive) else (0, 0)
            patches.append(slice(first, last + 1))
            pixels.append(slice(line.positions[first], line.positions[last] + self.size))
            offsets.append(0 if first else offset)
        (rows, columns), (down, across) = pixels, offsets
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        part = Places(shape, self.size, (down, across), self.smooth)
        return part, (rows, columns), (patches[0], patches[1])

    def strips(self, surfaces: int) -> Iterator[slice]:
        """Rows of patches, as many at a time as are to be held for so many surfaces of two components."""
        rows, columns = (len(line.positions) for line in self.lines)
        surfaces = 1 if torch.compiler.is_compiling() else surfaces  # a graph serves every batch size
        step = max(1, _AT_ONCE // (2 * surfaces * columns * self.size**2))
        return (slice(k, min(k + step, rows)) for k in range(0, rows, step))

    def down(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (size, N, C, rows of patches, W): the columns of all strips transformed."""
        return self.lines[0].rows(x)

    def across(self, strips: Tensor) -> Tensor:
        """(size, N, C, P, W) -> (size, N, C, P, columns of patches, size): coefficients of the patches of strips."""
        return self.lines[1].columns(strips)

    def back_across(self, coefficients: Tensor) -> Tensor:
        """The transpose of `across`."""
        return self.lines[1].lay_columns(coefficients)

    def back_down(self, strips: Tensor) -> Tensor:
        """The transpose of `down`."""
        return self.lines[0].lay_rows(strips)

    def spread(self, weight: Tensor) -> Tensor:
        """Sums (N, C, H, W) over the patches of one number for each, (N, C, rows, columns) of patches."""
        rows, columns = self.lines
        return rows.spread(columns.spread(weight).mT).mT

    def coverage(self, like: Tensor) -> Tensor:
        """(1, 1, H, W), the number of patches over each pixel."""
        rows, columns = (inside(line, like=like).sum(0) for line in self.lines)
        return (rows[:, None] * columns)[None, None]

    def noise(
        self, like: Tensor, steps: tuple[float, float], turned: bool = False, strips: slice = slice(None)
    ) -> Tensor:
        r"""Standard deviation of every coefficient of the projected slopes at its place, for white noise of level 1.

            var c_x = F_d S F_a^T / dx^2,   var c_y = F_a S F_d^T / dy^2
            F_a = (T M^T)^2,   F_d = (T E M^T)^2   elementwise

        T has an atom of a patch in every row, placed in the image; M is the cosine matrix, E the difference of
        neighbours, continued at the end, and S the noise of the height (`height_noise`). Near the border slow atoms
        of large patches carry up to 1.8 times the noise that they carry far from it.

        Args:
            like: a tensor of the wanted dtype and device.
            steps: (dx, dy).
            turned: for the slopes along the diagonals, (p + q, p - q) / sqrt 2, in the place of p and q.
            strips: rows of patches.

        Returns:
            (size, 1, 2, rows of patches, columns of patches, size).
        """
        (h, spared), (w, out) = (_less(line) for line in self.lines)
        rows, columns = self.lines
        found: Tensor = _noise((h, w), self.size, self.offsets, self.smooth, tuple(steps), turned, like=like)
        found = _prolonged(found, 3, spared, *strips.indices(len(rows.positions))[:2])
        return _prolonged(found, 4, out, 0, len(columns.positions))

    def far_noise(self, like: Tensor, steps: tuple[float, float]) -> Tensor:
        """`noise` of a patch far from every border, (size, 1, 2, 1, 1, size)."""
        found: Tensor = _far_noise(self.size, self.smooth, tuple(steps), like=like)
        return found

    def torus_noise(self, like: Tensor, steps: tuple[float, float], turned: bool) -> Tensor:
        """`noise` on a torus, where it is the same in all patches: (size, 1, 2, 1, 1, size)."""
        found: Tensor = _torus_noise(self.shape, self.size, self.smooth, tuple(steps), turned, like=like)
        return found


@dataclass(frozen=True)
class PatchNoise:
    """The noise of every coefficient of some patches.

    Args:
        places: the patches, on the torus or in the image; far from every border their number is of no account.
        steps: (dx, dy).
        turned: for the slopes along the diagonals; not far from every border.
        where: "here" (`Places.noise`), "far" (`Places.far_noise`) or "torus" (`Places.torus_noise`).
    """

    places: Places
    steps: tuple[float, float]
    turned: bool = False
    where: Literal["here", "far", "torus"] = "here"

    def of(self, strips: slice, like: Tensor) -> Tensor:
        """(size, 1, 2, 1 or rows of patches, 1 or columns, size) of these strips."""
        if self.where == "far":
            return self.places.far_noise(like, self.steps)
        if self.where == "torus":
            return self.places.torus_noise(like, self.steps, self.turned)
        return self.places.noise(like, self.steps, self.turned, strips)

    def shortened(self) -> PatchNoise:
        """The same of a smaller image that lacks only patches in the middle, all with the same noise."""
        if self.where == "torus":
            return self
        if self.where == "far":
            return replace(self, places=Places((self.places.size,) * 2, self.places.size, 0, self.places.smooth))
        rows, columns = (_less(line)[0] for line in self.places.lines)
        return replace(self, places=replace(self.places, shape=(rows, columns)))

    def build(self) -> Tensor:
        """All of it in float64, not kept: (size, 1, 2, 1 or rows of patches, 1 or columns, size)."""
        places, steps = self.places, self.steps
        if self.where == "torus":
            return _build_torus_noise(places.shape, places.size, places.smooth, steps, self.turned)
        if self.where == "far":
            return _build_far_noise(places.size, places.smooth, steps)
        return _build_noise(places.shape, places.size, places.offsets, places.smooth, steps, self.turned)


def _build_far_noise(size: int, smooth: bool, steps: tuple[float, float]) -> Tensor:
    middle = Places((4 * size, 4 * size), size, 0, smooth)
    found = _build_noise(middle.shape, size, middle.offsets, smooth, steps, False)
    row, column = (len(line.positions) // 2 for line in middle.lines)
    return found[..., row : row + 1, column : column + 1, :].contiguous()


def _less(line: Line) -> tuple[int, int]:
    """A side that is shorter by whole strides, and the number of these; it has so many patches fewer in the middle."""
    spared = max(0, line.n - max(_EXACT, 4 * line.size)) // line.stride
    return line.n - spared * line.stride, spared


def _prolonged(x: Tensor, dim: int, spared: int, start: int, end: int) -> Tensor:
    """Entries start to end along a dimension of which the one in the middle stands for `spared` more."""
    if not spared:
        return x.narrow(dim, start, end - start)
    middle = x.shape[dim] // 2
    ends = [min(max(start, k), end) for k in (start, middle, middle + spared + 1, end)]
    before, same, after = (b - a for a, b in pairwise(ends))
    parts = [x.narrow(dim, start, before)] if before else []
    parts += [x.narrow(dim, middle, 1).expand(*x.shape[:dim], same, *x.shape[dim + 1 :])] if same else []
    parts += [x.narrow(dim, ends[2] - spared, after)] if after else []
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim)


def _build_noise(
    shape: tuple[int, int], size: int, offsets: tuple[int, int], smooth: bool, steps: tuple[float, float], turned: bool
) -> Tensor:
    double = torch.empty(0, dtype=torch.float64, device="cpu")
    variance = height_noise(shape, double, steps)
    value_y, slope_y = _seen(Line(shape[0], size, offsets[0], smooth), double)
    value_x, slope_x = _seen(Line(shape[1], size, offsets[1], smooth), double)
    slope_x, slope_y = slope_x / steps[0], slope_y / steps[1]
    in_x = value_y.square() @ variance @ slope_x.square().mT
    in_y = slope_y.square() @ variance @ value_x.square().mT
    shared = (slope_y * value_y) @ variance @ (slope_x * value_x).mT if turned else None
    return _by_patch(in_x, in_y, shared, size)


def _by_patch(in_x: Tensor, in_y: Tensor, shared: Tensor | None, size: int) -> Tensor:
    """Standard deviations from variances of the slopes, or, with what they share, of those along the diagonals."""
    if shared is not None:
        mean = (in_x + in_y) / 2
        in_x, in_y = mean + shared, mean - shared
    by_patch = torch.stack([in_x, in_y]).clamp(min=0).sqrt().unflatten(-1, (-1, size)).unflatten(-3, (-1, size))
    return by_patch.movedim(2, 0)[:, None].contiguous()


def _build_torus_noise(
    shape: tuple[int, int], size: int, smooth: bool, steps: tuple[float, float], turned: bool
) -> Tensor:
    double = torch.empty(0, dtype=torch.float64, device="cpu")
    variance, basis = height_noise(shape, double, steps, "periodic"), atoms(size, smooth, like=double)
    y, x = (torch.fft.fft(basis, n, norm="ortho").abs().square() for n in shape)
    half_y, half_x = (2 * mode_sines(n, "periodic") / d for n, d in zip(shape, steps[::-1], strict=True))
    slope_y, slope_x = 2 * half_y / steps[1], 2 * half_x / steps[0]  # |e^iw - 1|^2 / d^2
    in_x, in_y = y @ variance @ (slope_x * x).mT, (slope_y * y) @ variance @ x.mT
    # Of (e^iw - 1) / d the part that is even in w is all that slopes in x and in y share.
    return _by_patch(in_x, in_y, (half_y * y) @ variance @ (half_x * x).mT if turned else None, size)


def _seen(line: Line, double: Tensor) -> tuple[Tensor, Tensor]:
    """What each placed atom sees of each cosine mode, and of its differences: T M^T and T E M^T."""
    n, size = line.n, line.size
    basis, modes = atoms(size, line.smooth, like=double), cosine_matrix(n, like=double)
    difference = modes.diff(dim=1)
    last = difference[:, -1:] if n > 1 else torch.zeros_like(modes)
    difference = torch.cat([difference, last], 1)
    value, slope = (torch.cat([basis @ m[:, p : p + size].mT for p in line.positions]) for m in (modes, difference))
    return value, slope


_noise, _far_noise, _torus_noise = (table(build) for build in (_build_noise, _build_far_noise, _build_torus_noise))
