r"""Folders of photographs for photometric stereo, and normal maps out.

A folder holds one picture for each light (PNG, JPEG, TIFF, EXR, BMP, TGA, WebP, or NPY), linear in brightness, and

| file | content |
|---|---|
| `lights.txt` or `light_directions.txt` | a line x y z for each picture: x right, y up, z to the viewer |
| `light_intensities.txt` | optional: a number, or one for each of red, green and blue, for each picture |
| `filenames.txt` | optional: the pictures by name, in the order of the lights; default: all, in natural order |
| `mask.png` | optional: the object in white |
| `ball_mask.png` | in place of the lights: a mirror ball in white, which shows in the same pictures |
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdls._checks import check_alike, check_real
from torchdls._files import Array, as_array, atomic_file, check_output, naming, require, single_map
from torchdls.io.containers import write_npz
from torchdls.io.fields import load_mask
from torchdls.io.formats import SIGNATURES, read_file

NORMAL_SUFFIXES = (".png", ".npy", ".npz")
_PICTURES = tuple(s for s in SIGNATURES if s not in (".npz", ".mat"))
_MASKS = ("mask", "ball_mask")


class Photographs(NamedTuple):
    """What a folder holds.

    Attributes:
        images: (1, K, H, W) float32, grey, divided by the intensity of their lights.
        lights: (K, 3) directions of length 1, or None.
        mask: (1, 1, H, W) bool, or None.
        ball: (1, 1, H, W) bool, the pixels of a mirror ball, or None.
        names: the K files.
    """

    images: Tensor
    lights: Tensor | None
    mask: Tensor | None
    ball: Tensor | None
    names: tuple[str, ...]


def load_photographs(folder: str | os.PathLike[str], lights: str | os.PathLike[str] | None = None) -> Photographs:
    """Read a folder of photographs under single lights; see the table at the top of this module.

    Args:
        folder: where the pictures are.
        lights: a file of directions, in place of the folder's own.

    Raises:
        FileNotFoundError: there is no such folder or file.
        ValueError: fewer than three pictures, pictures of several sizes, or numbers of lights that do not fit them. The
            message names the file.

    Example:
        >>> import tempfile
        >>> import numpy
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for k in range(3):
        ...         numpy.save(f"{folder}/{k}.npy", numpy.full((4, 5), 0.5))
        ...     numpy.savetxt(f"{folder}/lights.txt", [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
        ...     found = torchdls.load_photographs(folder)
        >>> found.images.shape, found.lights.shape
        (torch.Size([1, 3, 4, 5]), torch.Size([3, 3]))
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: there is no such folder")
    names = _names(folder)
    if len(names) < 3:
        raise ValueError(f"{folder}: holds {len(names)} pictures, at least 3 are needed")
    intensities = _table(folder / "light_intensities.txt", len(names), (1, 3))
    pictures = [_grey(folder / name, None if intensities is None else intensities[k]) for k, name in enumerate(names)]
    for name, picture in zip(names, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise ValueError(f"{folder / name}: size {picture.shape} differs from {pictures[0].shape} of {names[0]}")
    images = torch.from_numpy(np.stack(pictures))[None]
    given = [folder / name for name in ("lights.txt", "light_directions.txt")] if lights is None else [Path(lights)]
    place = next((path for path in given if path.exists()), given[0] if lights is not None else None)
    table = None if place is None else _table(place, len(names), (3,), needed=True)
    mask, ball = (_mask(folder / f"{name}.png", images) for name in _MASKS)
    return Photographs(images, None if table is None else _directions(place, table), mask, ball, tuple(names))


def save_normals(
    path: str | os.PathLike[str],
    normals: Tensor,
    *,
    mask: Tensor | None = None,
    convention: str = "opengl",
    overwrite: bool = False,
    **arrays: Tensor,
) -> None:
    """Write a normal map: PNG of 16 bits (code = (n + 1)/2, alpha 0 outside the mask), NPY (3, H, W) or NPZ.

    Args:
        path: ends in .png, .npy or .npz.
        normals: (1, 3, H, W) or (3, H, W), canonical (x right, y up, z to the viewer).
        mask: bool, (1, 1, H, W), (1, H, W) or (H, W); default: where the normal is not 0.
        convention: how the file has it, in the conventions of normals.
        overwrite: replace an existing file.
        **arrays: more entries of an NPZ file, such as albedo and covariance; other formats leave them out.

    Raises:
        TypeError: the normals are no floats, or the mask is not bool.
        ValueError: the suffix or convention is unknown, or a shape is wrong.
        OSError: the directory does not exist, the file exists, or writing fails. ImportError: a library is missing.

    Example:
        >>> import tempfile
        >>> normals = torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1).expand(1, 3, 4, 5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torchdls.save_normals(f"{folder}/normals.png", normals)
        ...     field = torchdls.load_field(f"{folder}/normals.png")
        >>> field.values[0, :, 0, 0].round(decimals=3)
        tensor([0., 0., 1.])
    """
    from torchdls.geometry import convert_normals

    path = check_output(path, overwrite, suffixes=NORMAL_SUFFIXES)
    check_real("save_normals", "normals", normals)
    if mask is not None:
        check_alike("save_normals", "mask", mask, torch.bool)
    n = normals if normals.ndim == 4 else normals[None]
    if n.ndim != 4 or n.shape[:2] != (1, 3):
        raise ValueError(f"normals: {tuple(normals.shape)} given, (1, 3, H, W) or (3, H, W) is needed")
    values = convert_normals(n, "opengl", convention)[0].detach().cpu().numpy()
    valid = (values != 0).any(0) if mask is None else single_map("mask", mask).astype(bool)
    if valid.shape != values.shape[1:]:
        raise ValueError(f"mask: shape {tuple(valid.shape)} given beside normals {tuple(normals.shape)}")
    values = np.where(valid, values, 0)
    write: Callable[[BinaryIO], Any]
    if path.suffix.lower() == ".png":
        codes = np.rint(np.clip((values + 1) / 2, 0, 1) * 65535).astype(np.uint16)
        pixels = np.concatenate([codes, np.where(valid, 65535, 0).astype(np.uint16)[None]])
        content = require("imagecodecs", "files").png_encode(np.ascontiguousarray(np.moveaxis(pixels, 0, -1)))
        write = lambda file: file.write(content)  # noqa: E731
    elif path.suffix.lower() == ".npy":
        write = lambda file: np.save(file, values)  # noqa: E731
    else:
        entries = {"normals": values, "mask": valid} | {name: as_array(value) for name, value in arrays.items()}
        write = lambda file: write_npz(file, entries)  # noqa: E731
    with atomic_file(path, overwrite) as file:
        write(file)


def _names(folder: Path) -> list[str]:
    """The pictures, in the order of the lights."""
    listed = folder / "filenames.txt"
    if listed.exists():
        names = [line.strip() for line in listed.read_text(encoding="utf-8").splitlines() if line.strip()]
        missing = [name for name in names if not (folder / name).is_file()]
        if missing:
            raise FileNotFoundError(f"{listed}: names {missing[0]}, which is not there")
        return names
    found = [p.name for p in folder.iterdir() if p.suffix.lower() in _PICTURES and p.stem.lower() not in _MASKS]
    found = [name for name in found if not name.startswith(".")]
    return sorted(
        found, key=lambda name: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
    )


def _grey(path: Path, intensity: Array | None) -> Array:
    """(H, W) float32: the mean of the colours, each divided by the intensity of its light."""
    content = read_file(path, _PICTURES)
    assert not isinstance(content, Mapping)
    top = np.iinfo(content.dtype).max if content.dtype.kind == "u" else 1
    pixels = content.astype(np.float64) / top
    if pixels.ndim not in (2, 3) or not pixels.size:
        raise ValueError(f"{path}: shape {content.shape} is no picture, (H, W) or (H, W, C) is needed")
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    pixels = pixels[..., : 1 if pixels.shape[-1] < 3 else 3]
    if intensity is not None:
        pixels = pixels / (intensity if len(intensity) == pixels.shape[-1] else intensity.mean())
    return pixels.mean(-1).astype(np.float32)


def _table(path: Path, rows: int, columns: tuple[int, ...], needed: bool = False) -> Array | None:
    """The numbers of a text file, or None if there is none."""
    if not path.exists() and not needed:
        return None
    with naming(path, "text"):
        values = np.atleast_2d(np.loadtxt(path, delimiter="," if "," in path.read_text(encoding="utf-8") else None))
    if 1 in columns and values.shape == (1, rows):
        values = values.T
    if values.shape[0] != rows or values.shape[1] not in columns or not np.isfinite(values).all():
        wanted = " or ".join(f"({rows}, {c})" for c in columns)
        raise ValueError(
            f"{path}: holds numbers {values.shape}, {wanted} finite ones are needed, a row for each picture"
        )
    return values


def _directions(path: Path | None, table: Array) -> Tensor:
    lengths = np.linalg.norm(table, axis=1, keepdims=True)
    if (lengths == 0).any() or (table[:, 2] <= 0).any():
        raise ValueError(f"{path}: a light is not in front of the surface; z to the viewer must be positive")
    return torch.from_numpy(table / lengths).float()


def _mask(path: Path, images: Tensor) -> Tensor | None:
    if not path.exists():
        return None
    mask = load_mask(path)
    if mask.shape[-2:] != images.shape[-2:]:
        raise ValueError(
            f"{path}: size {tuple(mask.shape[-2:])} differs from {tuple(images.shape[-2:])} of the pictures"
        )
    return mask
