"""Heights in files, written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdls._checks import check_alike, check_real
from torchdls._files import (
    Array,
    as_array,
    as_tensor,
    atomic_file,
    check_output,
    naming,
    one_of,
    pair,
    require,
    single_map,
)
from torchdls.geometry import height_to_points
from torchdls.io.containers import write_npz
from torchdls.io.formats import read_file, silent
from torchdls.io.meshes import MESH_SUFFIXES, save_mesh

OUTPUT_SUFFIXES = (".npz", ".npy", ".tiff", ".tif", ".png", *MESH_SUFFIXES)


class HeightMap(NamedTuple):
    """A height (1, 1, H, W), NaN outside the mask; the mask (1, 1, H, W); the pixel size (dx, dy)."""

    height: Tensor
    mask: Tensor
    pixel_size: tuple[float, float]


def load_height(path: str | os.PathLike[str]) -> HeightMap:
    """Read back a height that `save_height` wrote as NPZ, NPY, TIFF or PNG.

    Raises: as `load_field`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torchdls.save_height(f"{folder}/height.npz", torch.ones(4, 5))
        ...     torchdls.load_height(f"{folder}/height.npz").height.shape
        torch.Size([1, 1, 4, 5])
    """
    path = Path(path)
    content = read_file(path, (".npz", ".npy", ".tif", ".tiff", ".png"))
    pixel_size = (1.0, 1.0)
    if isinstance(content, Mapping):
        pixel_size = pair(path, content["pixel_size"]) if "pixel_size" in content else pixel_size
        content = content[one_of(path, content, ("height", "depth"))]
    elif path.suffix.lower() == ".png":
        notes, codes = _png_notes(path), content.reshape(content.shape[:2])
        pixel_size = pair(path, notes["pixel_size"])
        height = notes["offset"] + notes["scale"] * codes.astype(np.float64)
        content = np.where(codes == notes["invalid"], np.nan, height)
    elif path.suffix.lower() != ".npy":
        pixel_size = pair(path, _tiff_notes(path).get("pixel_size", pixel_size))
    if content.ndim != 2 or content.dtype.kind != "f" or not content.size:
        raise ValueError(f"{path}: {content.dtype} of shape {content.shape} is no height, floats (H, W) are needed")
    height = as_tensor(content)[None, None]
    return HeightMap(height, height.isfinite(), pixel_size)


def save_height(
    path: str | os.PathLike[str],
    height: Tensor,
    *,
    mask: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    points: Tensor | None = None,
    quantity: str = "height",
    overwrite: bool = False,
    **arrays: Tensor | Array | float,
) -> None:
    """Write one surface in the format of the suffix; formats in the table at the top of this module.

    Args:
        path: ends in .npz, .npy, .tiff, .tif, .png, .ply, .obj, .stl or .glb.
        height: (1, 1, H, W), (1, H, W) or (H, W).
        mask: bool, of the same shape; pixels outside are written as NaN and cut out of meshes. Default: where finite.
        pixel_size: (dx, dy), the spacing of the mesh's vertices.
        points: (3, H, W) or (1, 3, H, W), vertices of the mesh in place of `height_to_points(height, pixel_size)`.
        quantity: the name of what is written: "height", or "depth" under a perspective camera.
        overwrite: replace an existing file.
        **arrays: more entries of an NPZ file; other formats leave them out.

    Raises:
        TypeError: the height or the points are no floats, or the mask is not bool.
        ValueError: the suffix is unknown, a shape is wrong, or no pixel (for a mesh: no triangle) is valid.
        OSError: the directory does not exist, the file exists, or writing fails. ImportError: a library is missing.

    Example:
        >>> import pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torchdls.save_height(f"{folder}/height.ply", torch.ones(4, 5), pixel_size=(0.5, 0.5))
        ...     pathlib.Path(folder, "height.ply").read_bytes()[:3]
        b'ply'
    """
    path = check_output(path, overwrite, suffixes=OUTPUT_SUFFIXES)
    check_real("save_height", "height", height)
    if mask is not None:
        check_alike("save_height", "mask", mask, torch.bool)
    values = single_map("height", height)
    valid = np.isfinite(values)
    if mask is not None:
        inside = single_map("mask", mask).astype(bool)
        if inside.shape != values.shape:
            raise ValueError(f"mask: shape {tuple(inside.shape)} given beside a height {tuple(values.shape)}")
        valid &= inside
    if not valid.any():
        raise ValueError("mask: no valid pixel to write")
    if path.suffix.lower() in MESH_SUFFIXES:
        vertices = height_to_points(torch.from_numpy(values)[None], pixel_size) if points is None else points
        return save_mesh(path, vertices, torch.from_numpy(valid), overwrite=overwrite)
    values = values if valid.all() else np.where(valid, values, np.nan).astype(values.dtype)
    notes = {"quantity": quantity, "pixel_size": [float(d) for d in pixel_size]}
    if path.suffix.lower() == ".npz":
        extra = {name: as_array(value) for name, value in arrays.items()}
        entries = {quantity: values, "mask": valid, "pixel_size": np.asarray(pixel_size, np.float64)} | extra
        write: Callable[[BinaryIO], Any] = lambda file: write_npz(file, entries)  # noqa: E731
    elif path.suffix.lower() == ".npy":
        write = lambda file: np.save(file, values)  # noqa: E731
    else:
        write = _png_writer(values, notes) if path.suffix.lower() == ".png" else _tiff_writer(values, notes)
    with atomic_file(path, overwrite) as file:
        write(file)


def _png_writer(values: Array, notes: dict[str, Any]) -> Callable[[BinaryIO], Any]:
    from PIL import Image, PngImagePlugin

    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    scale = (high - low) / 65534 or 1.0
    codes = np.nan_to_num(np.rint((values.astype(np.float64) - low) / scale) + 1).astype(np.uint16)
    text = PngImagePlugin.PngInfo()
    text.add_text("torchdls", json.dumps(notes | {"scale": scale, "offset": low - scale, "invalid": 0}))
    return lambda file: Image.fromarray(codes).save(file, "PNG", pnginfo=text)


def _tiff_writer(values: Array, notes: dict[str, Any]) -> Callable[[BinaryIO], Any]:
    tifffile = require("tifffile", "files")
    data, options = values.astype(np.float32), {"photometric": "minisblack", "metadata": None}
    return lambda file: tifffile.imwrite(file, data, description=json.dumps(notes), **options)


def _png_notes(path: Path) -> dict[str, Any]:
    from PIL import Image

    with naming(path, "PNG"), Image.open(path) as image:
        if "torchdls" not in image.info:
            raise ValueError("it has no text chunk `torchdls` that says what its codes mean")
        notes = json.loads(image.info["torchdls"])
        numbers = {name: float(notes[name]) for name in ("offset", "scale", "invalid")}
        return {"pixel_size": notes["pixel_size"], **numbers}


def _tiff_notes(path: Path) -> dict[str, Any]:
    tifffile = require("tifffile", "files")
    with naming(path, "TIFF"), silent("tifffile"), tifffile.TiffFile(path) as file:
        description = file.pages[0].description
    with suppress(ValueError, TypeError):  # another program's words
        return dict(json.loads(description))
    return {}
