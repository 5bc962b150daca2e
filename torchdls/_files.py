"""The ground under reading and writing: raw arrays, complaints of one line, files that are whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]
SIGNATURES: dict[str, tuple[bytes, ...]] = {
    ".png": (b"\x89PNG\r\n\x1a\n",),
    ".jpg": (b"\xff\xd8",),
    ".jpeg": (b"\xff\xd8",),
    ".tif": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    ".tiff": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    ".npy": (b"\x93NUMPY",),
    ".npz": (b"PK",),
}


def check_output(
    path: str | os.PathLike[str], overwrite: bool = False, *, suffixes: Sequence[str] | None = None
) -> Path:
    """Say before the work what would fail after it: unknown format, missing directory, file that exists.

    Raises:
        ValueError: the suffix is not one of `suffixes` (default: any is).
        FileNotFoundError: the directory does not exist.
        FileExistsError: the file exists and `overwrite` is False.
    """
    path = Path(path)
    if suffixes is not None and path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: unknown format {path.suffix!r}, choose from {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the directory {path.parent} does not exist")
    if path.is_dir() or (path.exists() and not overwrite):
        raise FileExistsError(f"{path}: exists already; overwrite=True (--force on the command line) replaces a file")
    return path


@contextmanager
def atomic_file(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[BinaryIO]:
    """A binary file that takes its place when the block ends without an error, and else leaves no trace.

    Raises:
        FileNotFoundError: the directory does not exist.
        FileExistsError: the file exists and `overwrite` is False.
    """
    path = check_output(path, overwrite)
    draft = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        with open(draft, "xb") as file:
            yield file
        check_output(path, overwrite)  # it may have come into being meanwhile
        os.replace(draft, path)
    except BaseException:
        with suppress(OSError):
            draft.unlink()
        raise


def read_file(path: Path, suffixes: Sequence[str]) -> Array | dict[str, Array]:
    """The raw array of a file, images as (H, W) or (H, W, C); all the arrays of an NPZ."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ValueError(f"{path}: unknown format {suffix!r}, choose from {', '.join(suffixes)}")
    with open(path, "rb") as file:
        head = file.read(26)
    if not head.startswith(SIGNATURES[suffix]):
        raise ValueError(f"{path}: not a {suffix[1:].upper()} file")
    tifffile = require("tifffile", "files") if suffix in (".tif", ".tiff") else None
    with naming(path, suffix[1:].upper()):
        if tifffile is not None:
            return np.asarray(tifffile.imread(path))
        if suffix in (".npy", ".npz"):
            with open(path, "rb") as file:  # NumPy leaves a damaged archive open
                loaded = np.load(file, allow_pickle=False)
                return loaded if suffix == ".npy" else {name: loaded[name] for name in loaded.files}
        return _read_image(path, head)


def _read_image(path: Path, head: bytes) -> Array:
    # kornia keeps the 16 bits that imageio, scikit-image and Pillow drop from colours. Palettes, gray with alpha and
    # fewer than 8 bits it cannot decode: those are left to Pillow, which is exact for them.
    depth, color = (head[24], head[25]) if path.suffix.lower() == ".png" else (8, 2)
    if depth >= 8 and color in (0, 2, 6):
        from kornia.io import ImageLoadType, load_image

        return np.asarray(load_image(path, ImageLoadType.UNCHANGED).permute(1, 2, 0).numpy())
    if depth == 16:
        raise ValueError("16-bit gray with alpha is not supported; store gray or RGBA")
    from PIL import Image

    with Image.open(path) as image:
        mode = {0: "L", 3: "RGBA" if "transparency" in image.info else "RGB", 4: "LA"}[color]
        pixels = np.asarray(image.convert(mode))
    return pixels if pixels.ndim == 3 else pixels[..., None]


@contextmanager
def naming(path: Path, form: str) -> Iterator[None]:
    """Every complaint of a decoder about the content becomes one ValueError that names the file."""
    try:
        yield
    except (FileNotFoundError, PermissionError, IsADirectoryError, MemoryError):
        raise
    except Exception as error:
        reason = str(error).strip().splitlines()
        raise ValueError(
            f"{path}: cannot be read as {form}: {reason[0] if reason else type(error).__name__}"
        ) from error


def require(name: str, extra: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} is not installed: pip install 'torchdls[{extra}]'") from error


def one_of(path: Path, content: dict[str, Array], names: Sequence[str]) -> str:
    for name in names:
        if name in content:
            return name
    raise ValueError(f"{path}: holds {', '.join(content) or 'nothing'}, {' or '.join(names)} is needed")


def pair(path: Path, value: Any) -> tuple[float, float]:
    pair = np.asarray(value, np.float64).ravel()
    if pair.size not in (1, 2) or not (np.isfinite(pair) & (pair > 0)).all():
        raise ValueError(f"{path}: pixel_size {value!r}, one or two positive numbers are needed")
    return float(pair[0]), float(pair[-1])


def as_tensor(array: Array) -> Tensor:
    """Bool, float32 or float64 in native byte order; half precision is widened."""
    wanted = array.dtype if array.dtype.kind == "b" else np.float64 if array.dtype.itemsize >= 8 else np.float32
    return torch.from_numpy(np.ascontiguousarray(array, dtype=wanted))


def as_array(value: Tensor | Array | float) -> Array:
    return value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)


def single_map(name: str, tensor: Tensor) -> Array:
    array = as_array(tensor)
    if array.ndim < 2 or array.size != np.prod(array.shape[-2:]) or not array.size:
        raise ValueError(f"{name}: shape {tuple(array.shape)} given, one surface (1, 1, H, W) or (H, W) is needed")
    return array.reshape(array.shape[-2:])
