"""The files of `torchdls.large`: arrays of which only a part is read, results that are written band by band."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor, atomic_file, check_output, require
from torchdls.geometry import convert_gradient, normals_to_gradient

INPUTS, OUTPUTS = (".npy", ".zarr", ".tif", ".tiff"), (".npy", ".zarr", ".tif", ".tiff")
TIFF_TILE = 256


@dataclass(frozen=True)
class Field:
    """A gradient or normals, and what comes beside them, of which only what is asked for is read.

    Args:
        array: anything with `shape` and `dtype` that gives arrays for slices.
        convention: of the gradient or the normals; None for the default.
        mask: likewise, (H, W), not 0 where the slopes are valid; None for a full rectangle.
        weight: (H, W), (1, H, W) or (2, H, W), trust in the slopes; None for equal trust.
        anchor: (H, W), known heights, or None.
        anchor_weight: (H, W) or one number, trust in them.
    """

    array: Any
    convention: str | None = None
    mask: Any = None
    weight: Any = None
    anchor: Any = None
    anchor_weight: Any = None

    @classmethod
    def open(
        cls,
        source: Any,
        convention: str | None,
        mask: Any = None,
        weight: Any = None,
        anchor: Any = None,
        anchor_weight: Any = None,
    ) -> Field:
        """The field in a file, or of an array; and what comes beside it.

        Raises:
            TypeError: the entries are no floats.
            ValueError: the shape or format is not usable.
        """
        array = _opened(source)
        shape, dtype = tuple(array.shape), np.dtype(array.dtype)
        if len(shape) != 3 or shape[0] not in (2, 3) or 0 in shape:
            raise ValueError(f"large.integrate: source {shape} given, (2, H, W) or (3, H, W) is needed")
        if dtype.kind != "f":
            raise TypeError(f"large.integrate: source has dtype {dtype}; floats are needed")
        if (anchor is None) != (anchor_weight is None):
            given, missing = ("anchor", "anchor_weight") if anchor_weight is None else ("anchor_weight", "anchor")
            raise ValueError(f"large.integrate: {given} is given without {missing}; they come together")
        if isinstance(anchor_weight, int | float):
            anchor_weight = np.broadcast_to(np.float64(anchor_weight), shape[1:])
        beside = {"mask": mask, "weight": weight, "anchor": anchor, "anchor_weight": anchor_weight}
        found = {name: None if part is None else _opened(part) for name, part in beside.items()}
        for name, part in found.items():
            planes = (shape[1:], (1, *shape[1:]), (2, *shape[1:])) if name == "weight" else (shape[1:],)
            if part is not None and tuple(part.shape) not in planes:
                raise ValueError(f"large.integrate: {name} {tuple(part.shape)} given for a source {shape}")
        return cls(array, convention, **found)

    @property
    def even(self) -> bool:
        """A full rectangle with equal trust."""
        return self.mask is None and self.weight is None

    @property
    def bare(self) -> bool:
        """And without anchors."""
        return self.even and self.anchor is None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return tuple(self.array.shape[1:])

    @property
    def dtype(self) -> Any:
        """Of what is computed: float64 for float64, else float32."""
        return np.float64 if np.dtype(self.array.dtype).itemsize >= 8 else np.float32

    def slopes(self, rows: slice, columns: slice = slice(None)) -> Tensor:
        """(2, h, w) of a part in the library's convention."""
        values = as_tensor(np.array(self.array[:, rows, columns], order="C"))
        where = _named(rows)
        inside = None if self.mask is None else self.inside(rows, columns)
        if inside is not None:
            values = torch.where(inside, values, 0)
        if not bool(values.isfinite().all()):
            raise ValueError(f"large.integrate: not finite in {where}, in the mask or without one")
        if len(values) == 2:
            return convert_gradient(values, self.convention or "image")
        found = normals_to_gradient(values, self.convention or "opengl", mask=inside)
        if int(found.invalid):
            raise ValueError(f"large.integrate: {int(found.invalid)} normals face away, or are none, in {where}")
        return found.gradient

    def trusts(self, rows: slice) -> Tensor:
        """(1 or 2, h, W) weights of a band, 0 outside the mask.

        Raises:
            ValueError: one is negative or not finite.
        """
        weight = self.weight[rows][None] if len(self.weight.shape) == 2 else self.weight[:, rows]
        found = torch.from_numpy(np.array(weight, self.dtype, order="C"))
        if self.mask is not None:
            found = torch.where(self.inside(rows), found, 0)
        return _trusted("weight", found, rows)

    def anchors(self, rows: slice) -> tuple[Array, Array]:
        """(h, W) heights, 0 where they are not trusted, and the trust in them, 0 outside the mask.

        Raises:
            ValueError: a trust is negative or not finite, or a height is not finite where it is trusted.
        """
        r = torch.from_numpy(np.array(self.anchor_weight[rows], self.dtype, order="C"))
        r = _trusted("anchor_weight", r if self.mask is None else torch.where(self.inside(rows)[0], r, 0), rows)
        a = torch.where(r > 0, torch.from_numpy(np.array(self.anchor[rows], self.dtype, order="C")), 0)
        if not bool(a.isfinite().all()):
            raise ValueError(f"large.integrate: anchor is not finite in {_named(rows)}, where it is trusted")
        return a.numpy(), r.numpy()

    def inside(self, rows: slice, columns: slice = slice(None)) -> Tensor:
        """(1, h, w) bool of a part of the mask."""
        return torch.from_numpy(np.array(self.mask[rows, columns]) != 0)[None]


def parts(n: int, size: int) -> Iterator[slice]:
    """0 to n in parts of one size; the last may be shorter."""
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))


def _named(rows: slice) -> str:
    return f"rows {rows.start} to {rows.stop - 1}"


def _trusted(name: str, trust: Tensor, rows: slice) -> Tensor:
    if not bool((trust.isfinite() & (trust >= 0)).all()):
        raise ValueError(f"large.integrate: {name} is negative or not finite in {_named(rows)}")
    return trust


def _is_path(value: Any) -> bool:
    return isinstance(value, str | os.PathLike)


def _opened(source: Any) -> Any:
    """The array behind a path, of which only what is asked for is read."""
    if not _is_path(source):
        return source
    path = Path(source)
    suffix = path.suffix.lower()
    if suffix not in INPUTS:
        raise ValueError(f"{path}: unknown format {suffix!r}, choose from {', '.join(INPUTS)}")
    if suffix == ".zarr":
        return require("zarr", "large").open_array(path, mode="r")
    try:
        return np.load(path, mmap_mode="r") if suffix == ".npy" else require("tifffile", "files").memmap(path, mode="r")
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read in parts: {error}") from error


def checked_output(out: Any, size: tuple[int, int], overwrite: bool) -> Path | None:
    """The folder of an output, once it is found to be usable; None for an array."""
    if _is_path(out):
        return check_output(out, overwrite, suffixes=OUTPUTS).resolve().parent
    if tuple(out.shape) != size:
        raise ValueError(f"large.integrate: out {tuple(out.shape)} given for a height of {size}")
    return None


def write(out: Any, heights: Iterator[tuple[slice, Array]], size: tuple[int, int], dtype: Any, overwrite: bool) -> None:
    """Bands of rows to an array or a new file, which is whole or not there."""
    if not _is_path(out):
        for rows, height in heights:
            out[rows] = height
        return
    path = Path(out)
    if path.suffix.lower() == ".zarr":
        zarr = require("zarr", "large")
        array = zarr.create_array(path, shape=size, dtype=dtype, chunks=(min(512, size[0]), min(512, size[1])))
        for rows, height in heights:
            array[rows] = height
        return
    with atomic_file(path, overwrite) as file:
        if path.suffix.lower() == ".npy":
            np.lib.format.write_array_header_1_0(
                file, {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": size}
            )
            for _, height in heights:
                file.write(np.ascontiguousarray(height).data)
        else:
            tiff = require("tifffile", "files")
            options = {"tile": (TIFF_TILE, TIFF_TILE), "bigtiff": True, "photometric": "minisblack", "metadata": None}
            tiff.imwrite(file, _tiles(heights, size[1]), shape=size, dtype=dtype, **options)


def _tiles(heights: Iterator[tuple[slice, Array]], width: int) -> Iterator[Array]:
    """Tiles in rows from bands of any height; those at the border are as large as they are."""
    held: Array | None = None
    for _, height in heights:
        held = height if held is None else np.concatenate([held, height])
        while len(held) >= TIFF_TILE:
            row, held = held[:TIFF_TILE], held[TIFF_TILE:]
            yield from (np.ascontiguousarray(row[:, part]) for part in parts(width, TIFF_TILE))
    if held is not None and len(held):
        yield from (np.ascontiguousarray(held[:, part]) for part in parts(width, TIFF_TILE))
