r"""Files: normal maps, gradients and masks in; heights and meshes out, whole or not at all.

| read        | content                                                                                         |
|-------------|-------------------------------------------------------------------------------------------------|
| PNG, JPEG, TIFF | normal map, 3 or 4 channels: n = 2c - 1 with c = code/255 or code/65535; alpha is the mask   |
| TIFF of floats  | gradient (2 channels) or normals (3), in [0, 1] if so they are of unit length, else in [-1, 1]   |
| NPY         | normals (3, H, W) or gradient (2, H, W); channels last and a batch in front are understood        |
| NPZ         | `normals` or `gradient` as above; optional `mask` (H, W), `weight` (H, W) or (2, H, W), `pixel_size` |
| mask        | PNG, JPEG, TIFF: white (at least half) is valid; NPY, NPZ (`mask`): nonzero is valid               |

| written     | content                                                                                         |
|-------------|-------------------------------------------------------------------------------------------------|
| NPZ         | `height` (H, W), `mask`, `pixel_size`, and what the caller adds                                   |
| NPY         | height (H, W)                                                                                   |
| TIFF        | height in 32-bit floats; quantity and pixel size as JSON in ImageDescription                    |
| PNG         | 16-bit codes, height = offset + scale * code, code 0 is invalid; JSON in the text chunk `torchdls` |
| PLY, OBJ, STL, GLB | triangles between valid pixels; x right, y up, z to the viewer                           |

Outside the mask files hold NaN. A file is written beside its place and moved there when it is complete; what exists is
replaced only with `overwrite=True`. TIFF and meshes need `pip install 'torchdls[files]'`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdls._files import (
    SIGNATURES,
    Array,
    as_tensor,
    naming,
    one_of,
    pair,
    read_file,
)


class Field(NamedTuple):
    """What an input file holds.

    Attributes:
        kind: "normals" or "gradient".
        values: (N, 3, H, W) or (N, 2, H, W), in the convention of the file. A pixel without a normal is 0.
        mask: (N, 1, H, W) bool, or None.
        weight: (N, 1, H, W) or (N, 2, H, W), or None.
        pixel_size: (dx, dy), or None.
    """

    kind: str
    values: Tensor
    mask: Tensor | None = None
    weight: Tensor | None = None
    pixel_size: tuple[float, float] | None = None


def load_field(path: str | os.PathLike[str]) -> Field:
    """Read a normal map or a gradient; formats in the table at the top of this module.

    Integer codes become float32 and are renormalised. Codes whose vector is shorter than 0.1 or longer than 1.5 are no
    normals but black, gray or white background: they come back as zero vectors, which `normals_to_gradient` reports.

    Raises:
        OSError: the file cannot be opened.
        ValueError: the file is damaged, or does not hold a normal map or a gradient.
        ImportError: the library for this format is not installed.
    """
    path = Path(path)
    content = read_file(path, tuple(SIGNATURES))
    if isinstance(content, dict):
        return _field_of_npz(path, content)
    if path.suffix.lower() == ".npy":
        return _field_of_array(path, content)
    if content.ndim == 3 and content.shape[-1] in (3, 4) and content.dtype.kind != "f":
        return _field_of_codes(path, content)
    if content.ndim == 3 and content.dtype.kind == "f":
        return _field_of_array(path, content, last=True)
    raise ValueError(f"{path}: shape {content.shape} of {content.dtype} is no normal map, three channels are needed")


def load_mask(path: str | os.PathLike[str]) -> Tensor:
    """Read a mask as (1, 1, H, W) bool: white (at least half of the range, mean of the colours) or nonzero is valid.

    Raises: as `load_field`.
    """
    path = Path(path)
    content = read_file(path, tuple(SIGNATURES))
    if isinstance(content, dict):
        content = content[one_of(path, content, ("mask",))]
    if content.ndim == 3 and path.suffix.lower() not in (".npy", ".npz"):
        content = content[..., : 1 if content.shape[-1] < 3 else 3].mean(-1, dtype=np.float64).astype(content.dtype)
    if content.ndim > 2:
        content = content.reshape(content.shape[-2:]) if content.size == np.prod(content.shape[-2:]) else content
    if content.ndim != 2 or not content.size:
        raise ValueError(f"{path}: shape {content.shape} is no mask, (H, W) is needed")
    threshold = np.iinfo(content.dtype).max / 2 if _is_image(path) and content.dtype.kind == "u" else 0
    return torch.from_numpy((content > threshold) & np.isfinite(content))[None, None]


def load_camera(path: str | os.PathLike[str]) -> Tensor:
    """Read intrinsics K (3, 3) in float64 from NPY, NPZ (`camera` or `K`) or a text file of three rows.

    Raises: as `load_field`.
    """
    path = Path(path)
    if path.suffix.lower() in (".npy", ".npz"):
        content = read_file(path, (".npy", ".npz"))
        matrix = content[one_of(path, content, ("camera", "K"))] if isinstance(content, dict) else content
    else:
        with naming(path, "text"):
            matrix = np.loadtxt(path, ndmin=2)
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
        given = f"shape {matrix.shape} of {matrix.dtype} is no camera"
        raise ValueError(f"{path}: {given}, 3 x 3 finite numbers are needed")
    return torch.from_numpy(matrix.astype(np.float64))


def _field_of_codes(path: Path, codes: Array) -> Field:
    if codes.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: {codes.dtype} codes given, 8 or 16 bits without sign are needed")
    top = np.iinfo(codes.dtype).max
    n = 2 * codes[..., :3].astype(np.float64) / top - 1
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    n = np.where((length > 0.1) & (length < 1.5), n / np.maximum(length, 0.1), 0).astype(np.float32)
    mask = torch.from_numpy(codes[..., 3] > top / 2)[None, None] if codes.shape[-1] == 4 else None
    return Field("normals", as_tensor(np.moveaxis(n, -1, 0))[None], mask)


def _field_of_array(path: Path, array: Array, kind: str | None = None, last: bool = False) -> Field:
    """Normals or gradient from floats, recognised by the number of channels; `last`: look for them last first."""
    channels = {"normals": (3,), "gradient": (2,), None: (2, 3)}[kind]
    axes = [axis for axis in ((-1, -3) if last else (-3, -1)) if array.ndim in (3, 4) and array.shape[axis] in channels]
    if not axes or array.dtype.kind != "f" or not array.size:
        wanted = "floats (3, H, W) of normals or (2, H, W) of a gradient are needed"
        raise ValueError(f"{path}: {kind or 'array'} of {array.dtype} and shape {array.shape}, {wanted}")
    values = as_tensor(np.moveaxis(array, axes[0], -3))
    values = values if values.ndim == 4 else values[None]
    if values.shape[1] == 2:
        return Field("gradient", values)
    lengths = [n.norm(dim=1) for n in (values, 2 * values - 1)]
    error = [float((length[length.isfinite() & (length > 0.1)] - 1).abs().nanmean()) for length in lengths]
    encoded = bool((values.nan_to_num() >= 0).all()) and error[1] < min(error[0], 0.1)
    return Field("normals", 2 * values - 1 if encoded else values)


def _field_of_npz(path: Path, content: dict[str, Array]) -> Field:
    kind = one_of(path, content, ("gradient", "normals"))
    field = _field_of_array(path, content[kind], kind)
    n, _, h, w = field.values.shape
    planes: dict[str, Tensor | None] = {"mask": None, "weight": None}
    for name, most in (("mask", 1), ("weight", 2)):
        if name in content:
            plane = content[name]
            if plane.shape[-2:] != (h, w) or plane.size not in {n * h * w, most * n * h * w}:
                shapes = f"shape {content[name].shape} given beside a {kind} {tuple(field.values.shape)}"
                raise ValueError(f"{path}: {name}: {shapes}, the sizes must agree")
            planes[name] = as_tensor(plane.astype(bool if name == "mask" else content[kind].dtype)).reshape(n, -1, h, w)
    size = pair(path, content["pixel_size"]) if "pixel_size" in content else None
    return field._replace(mask=planes["mask"], weight=planes["weight"], pixel_size=size)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() not in (".npy", ".npz")
