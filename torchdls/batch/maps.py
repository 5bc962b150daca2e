"""One map: where its files are, how it is read, what is written of it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls import io
from torchdls.geometry import GRADIENT_CONVENTIONS, convert_gradient, depth_to_points, log_depth_to_depth
from torchdls.io import Field
from torchdls.io.formats import SIGNATURES
from torchdls.io.reading import Reading, read_normals

NORMALS, MASK, CAMERA = "normal_map", "mask", "K.txt"
LOG_DEPTH_GRADIENT = "log_depth_gradient"  # in NPZ files; as `gradient` it would be read as slopes of a height


class Source(NamedTuple):
    """The files of one map: normals or gradient, and optionally a mask and a camera beside them."""

    path: str
    mask: str | None = None
    camera: str | None = None


@dataclass(frozen=True)
class Manner:
    """How maps are read, whatever files they come from.

    Attributes:
        packing: how the normals are packed, or None to find it.
        convention: of normals or gradients; None for the default, "auto" for the most integrable.
        pixel_size: (dx, dy), or None for that of the file.
        camera: intrinsics for all maps, in the place of a file's own.
        own_camera: whether a camera beside the normals counts.
        double: compute in float64.
    """

    packing: str | None = None
    convention: str | None = None
    pixel_size: tuple[float, float] | None = None
    camera: Tensor | None = None
    own_camera: bool = True
    double: bool = False


class Map(NamedTuple):
    """A map that is ready to be integrated: (1, C, H, W) each, the mask None where all pixels are valid."""

    gradient: Tensor
    mask: Tensor | None
    weight: Tensor | None
    pixel_size: tuple[float, float]
    camera: Tensor | None
    kind: str
    packing: str
    convention: str
    notes: tuple[str, ...]


def folder_source(folder: str | os.PathLike[str]) -> Source | None:
    """The map of a folder that holds normal_map.png (or another format), mask.png and K.txt, or None."""
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_file())
    except NotADirectoryError:
        return None
    found = {stem: [n for n in names if _is_layout(n, stem)] for stem in (NORMALS, MASK)}
    if not found[NORMALS]:
        return None
    for stem, several in found.items():
        if len(several) > 1:
            raise ValueError(f"{folder}: holds {' and '.join(several)}; one {stem} is needed")
    path = os.path.join(folder, found[NORMALS][0])
    mask = os.path.join(folder, found[MASK][0]) if found[MASK] else None
    return Source(path, mask, os.path.join(folder, CAMERA) if CAMERA in names else None)


def _is_layout(name: str, stem: str) -> bool:
    root, suffix = os.path.splitext(name)
    return root == stem and suffix.lower() in SIGNATURES


def read_map(source: Source, manner: Manner) -> Map:
    """Slopes and masks of one map in the library's convention.

    Raises:
        OSError: a file cannot be opened.
        ValueError: a file is damaged, holds no single map, no valid pixel, or the parts do not fit.
        ImportError: the library for a format is not installed.
    """
    field = io.load_field(source.path, packing=manner.packing)
    if field.values.shape[0] != 1:
        raise ValueError(f"{source.path}: holds {field.values.shape[0]} surfaces, one is needed")
    camera = manner.camera
    if camera is None and source.camera is not None and manner.own_camera:
        camera = io.load_camera(source.camera)
    pixel_size = _pixel_size(manner, field, camera)
    dtype = torch.float64 if manner.double else field.values.dtype
    field = field._replace(values=field.values.to(dtype), mask=_joint_mask(source, field))
    reading = _gradient(source.path, field, manner.convention, camera)
    mask = None if reading.mask.all() else reading.mask
    weight = None if field.weight is None else field.weight.to(dtype)
    told = field.kind, field.packing, reading.convention, reading.notes
    return Map(reading.gradient, mask, weight, pixel_size, camera, *told)


def _pixel_size(manner: Manner, field: Field, camera: Tensor | None) -> tuple[float, float]:
    if manner.pixel_size is None:
        return (1.0, 1.0) if field.pixel_size is None or camera is not None else field.pixel_size
    if camera is not None:
        raise ValueError("--pixel-size: given beside a camera, whose intrinsics already hold the pixel size")
    return manner.pixel_size


def _joint_mask(source: Source, field: Field) -> Tensor | None:
    """The mask of the input and that beside it together."""
    if source.mask is None:
        return field.mask
    mask = io.load_mask(source.mask)
    if mask.shape[-2:] != field.values.shape[-2:]:
        sizes = f"{tuple(mask.shape[-2:])} given beside an input of {tuple(field.values.shape[-2:])}"
        raise ValueError(f"{source.mask}: mask of size {sizes}, the sizes must agree")
    return mask if field.mask is None else mask & field.mask


def _gradient(path: str, field: Field, convention: str | None, camera: Tensor | None) -> Reading:
    """Gradient in the library's convention, and the mask of its valid pixels."""
    if field.kind == "normals":
        return read_normals(path, field, convention, camera)
    convention = convention or next(iter(GRADIENT_CONVENTIONS))
    if convention not in GRADIENT_CONVENTIONS:
        known = ", ".join(GRADIENT_CONVENTIONS)
        raise ValueError(f"--convention: {convention!r} is not for gradient; choose from {known}")
    if camera is not None:
        raise ValueError("--camera: needs a normal map, but the input is a gradient")
    gradient = convert_gradient(field.values, convention)
    finite = gradient.isfinite().all(1, keepdim=True)
    mask = finite if field.mask is None else finite & field.mask
    if not mask.any():
        raise ValueError(f"{path}: no finite slope inside the mask")
    return Reading(gradient, mask, convention, ())


def write_map(path: str | os.PathLike[str], height: Tensor, of: Map, *, overwrite: bool = False, **maps: Any) -> None:
    """The height of a map in the format of the suffix, with more arrays for an NPZ; under a camera the depth."""
    slopes = of.gradient[0]
    if of.camera is None:
        io.save_height(
            path, height, mask=of.mask, pixel_size=of.pixel_size, overwrite=overwrite, gradient=slopes, **maps
        )
        return
    depth = log_depth_to_depth(height)
    points = depth_to_points(depth, of.camera)
    maps |= {LOG_DEPTH_GRADIENT: slopes, "camera": of.camera}
    io.save_height(path, depth, mask=of.mask, points=points, quantity="depth", overwrite=overwrite, **maps)
