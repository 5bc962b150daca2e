"""The cosine transform of an array on disk: bands of rows along W, strips of columns along H."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor
from torchdls.large.files import Field, parts
from torchdls.operators import dct2, idct2, slope_divergence

# Numbers in memory for each one of a band or strip, with those inside the transforms (measured: 11 of float32).
_COPIES = 16
_MULTIPLE = 256  # of which a tile chosen by memory is one


def rows_forward(band: Tensor) -> Array:
    """(rows, W) transformed along W."""
    found: Array = dct2(band[:, None])[:, 0].numpy()
    return found


def rows_back(band: Array) -> Array:
    """The inverse of `rows_forward`."""
    found: Array = idct2(as_tensor(band)[:, None])[:, 0].numpy()
    return found


def columns_forward(strip: Array) -> Tensor:
    """(H, columns) -> (columns, H), transformed along H."""
    return dct2(as_tensor(strip.T)[:, None])[:, 0]


def columns_back(spectrum: Tensor) -> Array:
    """The inverse of `columns_forward`."""
    found: Array = idct2(spectrum[:, None])[:, 0].T.numpy()
    return found


def integrated(
    spectrum: Tensor, columns: slice, size: tuple[int, int], step: tuple[float, float], shift: float = 0.0
) -> Tensor:
    """(columns, H) of A^T v -> of the height: over the eigenvalues of A^T A + shift, 0 for 0; written in place."""
    y, x = eigenvalues(size, slice(0, size[0]), columns, step)
    for part, own in zip(spectrum, x, strict=True):  # a column at a time: no table of the size of the strip
        total = y + (own + shift)
        singular = total == 0
        part.mul_(torch.where(singular, 0, 1 / torch.where(singular, 1, total)).to(part))
    return spectrum


def eigenvalues(size: tuple[int, int], rows: slice, columns: slice, step: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Of some rows and columns of modes in float64; that of a mode is the sum of its two (`neumann_eigenvalues`)."""
    y, x = (
        (2 / d * torch.sin(torch.arange(part.start, part.stop, dtype=torch.float64) * (math.pi / (2 * n)))).square()
        for d, part, n in zip(reversed(step), (rows, columns), size, strict=True)
    )
    return y, x


def rows_at_once(memory: int, size: tuple[int, int], dtype: Any, arrays: int = 1) -> int:
    """Rows of a band and columns of a strip of so many arrays that `memory` bytes hold."""
    most = memory // (_COPIES * arrays * np.dtype(dtype).itemsize * max(size))
    if most < 1:
        raise ValueError(f"large.integrate: memory={memory} holds not one row of {max(size)} pixels")
    return min(most // _MULTIPLE * _MULTIPLE or most, max(size))


@dataclass(frozen=True)
class Passes:
    """What the passes over one surface share.

    Args:
        field: the slopes.
        step: (dx, dy), the unit of the height.
        tile: rows of a band and columns of a strip.
        place: folder for arrays in between.
        say: told of each pass.
    """

    field: Field
    step: tuple[float, float]
    tile: int
    place: Path
    say: Callable[[str], None]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.field.shape

    def bands(self) -> list[slice]:
        """Rows, a band at a time."""
        return self._parts(self.size[0], "bands of rows")

    def strips(self) -> list[slice]:
        """Columns, a strip at a time."""
        return self._parts(self.size[1], "strips of columns")

    def _parts(self, n: int, what: str) -> list[slice]:
        found = list(parts(n, self.tile))
        self.say(f"{len(found)} {what}")
        return found

    def scratch(self, name: str, dtype: Any = None) -> Array:
        """An array of zeros (H, W) in a file of its own, of the dtype of the field if none is given.

        Its room on the disk is taken at once: a page of a file in memory that finds none ends the process.

        Raises:
            OSError: the disk has no room for it; it names the file.
        """
        dtype, path = self.field.dtype if dtype is None else dtype, self.place / f"{name}.npy"
        try:
            found: Array = np.lib.format.open_memmap(path, "w+", dtype, self.size)
            if hasattr(os, "posix_fallocate"):  # not on macOS and Windows
                with open(path, "r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error
        return found

    def divergence(self, rows: slice, step: tuple[float, float]) -> Tensor:
        """A^T v (rows, W) of a band, for pixels of the sides (dx, dy)."""
        start, stop = max(rows.start - 1, 0), min(rows.stop + 1, self.size[0])
        b = slope_divergence(self.field.slopes(slice(start, stop))[None], step)[0, 0]
        return b[rows.start - start :][: rows.stop - rows.start]
