"""What is in a file: pictures and arrays of every format that is read, as they are stored."""

from __future__ import annotations

import logging
import math
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from torchdls._files import Array, naming, require
from torchdls.io.containers import RATIO, check_declared, open_npz, read_npy
from torchdls.io.matlab import open_mat
from torchdls.io.png import check_png

_JPEG, _TIFF = (b"\xff\xd8",), (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
SIGNATURES: dict[str, tuple[bytes, ...]] = {
    ".png": (b"\x89PNG\r\n\x1a\n",),
    ".jpg": _JPEG,
    ".jpeg": _JPEG,
    ".tif": _TIFF,
    ".tiff": _TIFF,
    ".bmp": (b"BM",),
    ".tga": (b"",),
    ".webp": (b"RIFF",),
    ".exr": (b"v/1\x01",),
    ".npy": (b"\x93NUMPY",),
    ".npz": (b"PK",),
    ".mat": (b"MATLAB",),
}
ARRAYS = (".npy", ".npz", ".mat")


def read_file(path: Path, suffixes: Sequence[str]) -> Array | Mapping[str, Array]:
    """The raw array of a file, pictures as (H, W) or (H, W, C); of NPZ and MAT the arrays by name, read on demand.

    Raises:
        OSError: the file cannot be opened.
        ValueError: the suffix is not one of `suffixes`, or the content is damaged.
        ImportError: the library for this format is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ValueError(f"{path}: unknown format {suffix!r}, choose from {', '.join(suffixes)}")
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError(f"{path}: not a file")
    with open(path, "rb") as file:
        head = file.read(26)
    form = suffix[1:].upper()
    if not head or not head.startswith(SIGNATURES[suffix]):
        raise ValueError(f"{path}: no {form} file, whatever its name")
    with naming(path, form):
        if suffix == ".npy":
            return read_npy(path)
        if suffix in ARRAYS:
            return open_npz(path) if suffix == ".npz" else open_mat(path)
        if suffix in (".tif", ".tiff"):
            return _read_tiff(path)
        return _read_exr(path) if suffix == ".exr" else _read_picture(path, head)


def _read_picture(path: Path, head: bytes) -> Array:
    # kornia keeps the 16 bits that imageio, scikit-image and Pillow drop from colours; Pillow is exact for the others.
    depth, color = (head[24], head[25]) if path.suffix.lower() == ".png" and len(head) > 25 else (8, 2)
    if depth >= 8 and color in (0, 2, 6) and path.suffix.lower() == ".png":
        from kornia.io import ImageLoadType, load_image

        check_png(path)
        return np.asarray(load_image(path, ImageLoadType.UNCHANGED).permute(1, 2, 0).numpy())
    if depth == 16 and color == 4:
        raise ValueError("16-bit gray with alpha is not supported; store gray or RGBA")
    image_module: Any = require("PIL.Image", "files")
    form = {".jpg": "JPEG", ".jpeg": "JPEG"}.get(path.suffix.lower(), path.suffix[1:].upper())
    try:
        image = image_module.open(path, formats=(form,))
    except image_module.UnidentifiedImageError:
        raise ValueError("its header is damaged") from None
    with image:
        check_declared(image.width * image.height * 4, os.path.getsize(path))
        if image.mode == "P":
            image = image.convert("RGBA" if "transparency" in image.info else "RGB")
        elif image.mode not in ("L", "LA", "RGB", "RGBA") and not image.mode.startswith("I"):
            image = image.convert("L" if image.mode == "1" else "RGB")
        pixels = np.asarray(image)
    if pixels.dtype.kind not in "ui" or not pixels.size:
        raise ValueError("it holds no picture")
    pixels = pixels.astype(np.uint16) if pixels.dtype not in (np.uint8, np.uint16) else pixels
    return pixels if pixels.ndim == 3 else pixels[..., None]


def _read_tiff(path: Path) -> Array:
    tifffile: Any = require("tifffile", "files")
    with silent("tifffile"), tifffile.TiffFile(path) as file:
        series = file.series[0]
        plain = all(page.compression == 1 for page in series.pages if page is not None)
        check_declared(math.prod(series.shape) * series.dtype.itemsize, os.path.getsize(path), 1 if plain else RATIO)
        for page in series.pages:
            if page is not None and (len(page.dataoffsets) < 1 or not all(page.databytecounts)):
                raise ValueError("a part of the picture is missing")
        pixels = np.asarray(series.asarray())
        # Planes, one for each channel, become channels of pixels.
        return np.moveaxis(pixels, series.axes.index("S"), -1) if "S" in series.axes else pixels


@contextmanager
def silent(name: str) -> Iterator[None]:
    """Nothing of what a reader logs: the error that follows says it in one line."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextmanager
def _mute() -> Iterator[None]:
    """Nothing of what OpenEXR prints about damage, past Python, before it raises."""
    with redirect_stdout(StringIO()), open(os.devnull, "wb") as nothing:
        try:
            error_output = os.dup(2)
        except OSError:  # there is none
            yield
            return
        try:
            os.dup2(nothing.fileno(), 2)
            yield
        finally:
            os.dup2(error_output, 2)
            os.close(error_output)


def _read_exr(path: Path) -> Array:
    """The normals of an OpenEXR file (H, W, 3), or with its alpha (H, W, 4)."""
    exr: Any = require("OpenEXR", "files")
    with _mute(), exr.File(str(path), header_only=True) as file:
        names = [channel.name for channel in file.header()["channels"]]
        low, high = file.header()["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    check_declared(4 * len(names) * width * height, os.path.getsize(path))
    chosen = _exr_layer(names)
    with _mute(), exr.File(str(path), separate_channels=True) as file:
        if not file.parts:
            raise ValueError("its content is damaged")
        planes = [np.asarray(file.channels()[name].pixels, np.float32) for name in chosen]
    if len({plane.shape for plane in planes}) > 1:
        raise ValueError("its channels differ in size")
    return np.stack(planes, -1)


def _exr_layer(names: Sequence[str]) -> list[str]:
    """The channels to read: x, y, z or r, g, b of the layer called normal, or else of the one that has them."""
    layers: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, part = name.rpartition(".")
        layers.setdefault(layer, {})[part.upper()] = name
    found = [
        (layer, [parts[c] for c in triple])
        for layer, parts in layers.items()
        for triple in ("XYZ", "RGB")
        if set(triple) <= set(parts)
    ]
    named = [entry for entry in found if "normal" in entry[0].lower()] or found
    if len(named) == 1:
        layer, channels = named[0]
        return channels + ([layers[layer]["A"]] if "A" in layers[layer] else [])
    if not named and set(names) == {"Y"}:
        return ["Y"]
    several = "several layers" if named else "no layer"
    raise ValueError(f"{several} of x, y, z or r, g, b among its channels {', '.join(names)}; one is needed")
