r"""Surfaces larger than memory: least squares, exact, in three passes over a file.

The least-squares height of a full rectangle is diagonal in the cosine basis, and the transform is separable:

    z = (C_H^T ((C_H (A^T v C_W^T)) / e)) C_W,      e[k, l] = 4 sin^2(pi k / 2H) / dy^2 + 4 sin^2(pi l / 2W) / dx^2

so bands of rows give A^T v C_W^T (a band needs one row of its neighbours), strips of columns are transformed, divided
and transformed back, and bands of rows once more give the height. Nothing is approximated: the tiles leave no trace.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor, atomic_file, check_output, require
from torchdls.geometry import convert_gradient, normals_to_gradient
from torchdls.operators import as_pixel_size, dct2, idct2, slope_divergence

INPUTS, OUTPUTS = (".npy", ".zarr", ".tif", ".tiff"), (".npy", ".zarr", ".tif", ".tiff")
# Numbers in memory for each one of a band or strip, with those inside the transforms (measured: 11 of float32).
_COPIES = 16
_TIFF_TILE = 256


class LargeResult(NamedTuple):
    """What `integrate` did.

    Attributes:
        shape: (H, W).
        tile: rows of a band, and columns of a strip.
        passes: the bands, strips and bands that it went through.
    """

    shape: tuple[int, int]
    tile: int
    passes: tuple[int, int, int]


def integrate(
    source: str | os.PathLike[str] | Any,
    out: str | os.PathLike[str] | Any,
    *,
    convention: str | None = None,
    pixel_size: float | Sequence[float] = 1.0,
    tile: int | None = None,
    memory: int = 2**30,
    scratch: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> LargeResult:
    r"""The least-squares height of a full rectangle that need not fit into memory; equal to `LeastSquares` to rounding.

    Besides the files it takes `scratch` space of one height, and `memory` for its own arrays; time grows as
    H W log(H W). Masks, weights and anchors are not taken: their solve is iterative.

    Args:
        source: gradient (2, H, W) or normals (3, H, W) of floats: an NPY file, a Zarr array, an uncompressed TIFF, or
            anything with `shape` that gives arrays for slices.
        out: NPY, Zarr or a tiled BigTIFF, written whole or not at all (Zarr: a new array), or anything of shape (H, W)
            that takes arrays for slices of rows.
        convention: of the gradient (default: image) or of the normals (default: opengl).
        pixel_size: (dx, dy) or one number.
        tile: rows of a band and columns of a strip; None for as many as `memory` holds.
        memory: bytes for arrays of its own; pages of files in the system's cache are not counted.
        scratch: folder for the file in between; None for that of `out`, or the usual one for temporary files.
        overwrite: replace an existing file.
        progress: told of each pass.

    Returns:
        `LargeResult`.

    Raises:
        TypeError: the entries are no floats.
        ValueError: the shape, format, convention or an option is not usable, a value is not finite, or a normal faces
            away.
        OSError: a file cannot be opened or written. ImportError: the library for a format is not installed.

    Source: Simchony, Chellappa, Shao (1990).

    Example:
        >>> import numpy
        >>> slopes, height = torchdls.SURFACES["peaks"](96).gradient[0], numpy.empty((96, 96), "float32")
        >>> torchdls.large.integrate(slopes.numpy().astype("float32"), height, tile=32).passes
        (3, 3, 3)
        >>> bool(torch.allclose(torch.from_numpy(height), torchdls.LeastSquares()(slopes.float())[0], atol=1e-4))
        True
    """
    field = _opened(source)
    h, w, dtype = _checked(field)
    tile = _tile(tile, memory, (h, w), dtype)
    step = as_pixel_size(pixel_size)
    beside = _checked_output(out, (h, w), overwrite)
    folder = beside if scratch is None else scratch
    bands, strips = (list(_parts(n, tile)) for n in (h, w))
    with tempfile.TemporaryDirectory(prefix=".torchdls-", dir=folder) as place, torch.no_grad():
        between = np.lib.format.open_memmap(Path(place, "spectrum.npy"), "w+", dtype, (h, w))
        progress(f"{len(bands)} bands of rows")
        for rows in bands:
            b = slope_divergence(_slopes(field, rows, convention)[None], step)[0, 0]
            between[rows] = dct2(b[rows.start - max(rows.start - 1, 0) :][: rows.stop - rows.start, None])[:, 0].numpy()
        progress(f"{len(strips)} strips of columns")
        for columns in strips:
            between[:, columns] = _divided(as_tensor(between[:, columns].T), columns, (h, w), step).T.numpy()
        progress(f"{len(bands)} bands of rows")
        heights = ((rows, idct2(as_tensor(between[rows])[:, None])[:, 0].numpy()) for rows in bands)
        _write(out, heights, (h, w), dtype, overwrite)
        del between
    return LargeResult((h, w), tile, (len(bands), len(strips), len(bands)))


def _divided(strip: Tensor, columns: slice, size: tuple[int, int], step: tuple[float, float]) -> Tensor:
    """(columns, H) transformed along H, divided by the eigenvalues, transformed back."""
    (h, w), (dx, dy) = size, step
    y, x = (
        (2 / d * torch.sin(torch.arange(*span, dtype=torch.float64) * (math.pi / (2 * n)))).square()
        for d, span, n in ((dy, (0, h), h), (dx, (columns.start, columns.stop), w))
    )
    spectrum = dct2(strip[:, None])[:, 0]
    for part, own in zip(spectrum, x, strict=True):  # a column at a time: no table of the size of the strip
        eigenvalues = y + own
        singular = eigenvalues == 0
        part.mul_(torch.where(singular, 0, 1 / torch.where(singular, 1, eigenvalues)).to(part))
    return idct2(spectrum[:, None])[:, 0]


def _slopes(field: Any, rows: slice, convention: str | None) -> Tensor:
    """(2, rows and one more on either side, W) in the library's convention."""
    start, stop = max(rows.start - 1, 0), min(rows.stop + 1, field.shape[1])
    values = as_tensor(np.asarray(field[:, start:stop]))
    where = f"rows {start} to {stop - 1}"
    if not bool(values.isfinite().all()):
        raise ValueError(f"large.integrate: not finite in {where}; a full rectangle is needed")
    if len(values) == 2:
        return convert_gradient(values, convention or "image")
    found = normals_to_gradient(values, convention or "opengl")
    if int(found.invalid):
        raise ValueError(f"large.integrate: {int(found.invalid)} normals face away, or are none, in {where}")
    return found.gradient


def _parts(n: int, size: int) -> Iterator[slice]:
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))


def _tile(tile: int | None, memory: int, size: tuple[int, int], dtype: Any) -> int:
    if tile is None:
        most = memory // (_COPIES * np.dtype(dtype).itemsize * max(size))
        if most < 1:
            raise ValueError(f"large.integrate: memory={memory} holds not one row of {max(size)} pixels")
        return min(most // _TIFF_TILE * _TIFF_TILE or most, max(size))
    if not tile > 0:
        raise ValueError(f"large.integrate: tile={tile!r} given, a positive number of pixels is needed")
    return tile


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


def _checked(field: Any) -> tuple[int, int, Any]:
    shape, dtype = tuple(field.shape), np.dtype(field.dtype)
    if len(shape) != 3 or shape[0] not in (2, 3) or 0 in shape:
        raise ValueError(f"large.integrate: source {shape} given, (2, H, W) or (3, H, W) is needed")
    if dtype.kind != "f":
        raise TypeError(f"large.integrate: source has dtype {dtype}; floats are needed")
    return shape[1], shape[2], np.float64 if dtype.itemsize >= 8 else np.float32


def _checked_output(out: Any, size: tuple[int, int], overwrite: bool) -> Path | None:
    """The folder of an output, once it is found to be usable; None for an array."""
    if _is_path(out):
        return check_output(out, overwrite, suffixes=OUTPUTS).resolve().parent
    if tuple(out.shape) != size:
        raise ValueError(f"large.integrate: out {tuple(out.shape)} given for a height of {size}")
    return None


def _write(
    out: Any, heights: Iterator[tuple[slice, Array]], size: tuple[int, int], dtype: Any, overwrite: bool
) -> None:
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
            options = {"tile": (_TIFF_TILE, _TIFF_TILE), "bigtiff": True, "photometric": "minisblack", "metadata": None}
            tiff.imwrite(file, _tiles(heights, size[1]), shape=size, dtype=dtype, **options)


def _tiles(heights: Iterator[tuple[slice, Array]], width: int) -> Iterator[Array]:
    """Tiles in rows from bands of any height; those at the border are as large as they are."""
    held: Array | None = None
    for _, height in heights:
        held = height if held is None else np.concatenate([held, height])
        while len(held) >= _TIFF_TILE:
            row, held = held[:_TIFF_TILE], held[_TIFF_TILE:]
            yield from (np.ascontiguousarray(row[:, part]) for part in _parts(width, _TIFF_TILE))
    if held is not None and len(held):
        yield from (np.ascontiguousarray(held[:, part]) for part in _parts(width, _TIFF_TILE))
