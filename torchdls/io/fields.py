r"""Files: normal maps, gradients and masks in; heights and meshes out, whole or not at all.

| read        | content                                                                                         |
|-------------|-------------------------------------------------------------------------------------------------|
| PNG, JPEG, TIFF, BMP, TGA, WebP | normal map of 8 or 16 bits, packed in one of the ways of `torchdls.io.packing` |
| TIFF or EXR of floats | gradient (2 channels) or normals (3 or 4, packed in any of those ways)                  |
| NPY         | normals (3 or 4, H, W) or gradient (2, H, W); channels last and a batch in front are understood   |
| NPZ, MAT    | `normals` or `gradient` as above; optional `mask` (H, W), `weight` (H, W) or (2, H, W), `pixel_size`; of a MAT file without them its only array (H, W, 3) or (H, W, 2) |
| mask        | pictures: white (at least half) is valid; NPY, NPZ, MAT (`mask`): nonzero is valid               |

| written     | content                                                                                         |
|-------------|-------------------------------------------------------------------------------------------------|
| NPZ         | `height` (H, W), `mask`, `pixel_size`, and what the caller adds                                   |
| NPY         | height (H, W)                                                                                   |
| TIFF        | height in 32-bit floats; quantity and pixel size as JSON in ImageDescription                    |
| PNG         | 16-bit codes, height = offset + scale * code, code 0 is invalid; JSON in the text chunk `torchdls` |
| PLY, OBJ, STL, GLB | triangles between valid pixels; x right, y up, z to the viewer                           |

Outside the mask files hold NaN. A file is written beside its place and moved there when it is complete; what exists is
replaced only with `overwrite=True`. Of an NPZ or a MAT file only the arrays that are needed are unpacked, and no header
is believed that declares more than the file can hold. TIFF, EXR and meshes need `pip install 'torchdls[files]'`.
"""  # noqa: E501 (a row of a table is one line)

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor, naming, one_of, pair
from torchdls.io.formats import ARRAYS, SIGNATURES, read_file
from torchdls.io.packing import unpack


class Field(NamedTuple):
    """What an input file holds.

    Attributes:
        kind: "normals" or "gradient".
        values: (N, 3, H, W) or (N, 2, H, W), in the convention of the file. A pixel without a normal is 0.
        mask: (N, 1, H, W) bool, or None.
        weight: (N, 1, H, W) or (N, 2, H, W), or None.
        pixel_size: (dx, dy), or None.
        packing: how the normals were packed, one of `torchdls.io.packing.CHANNELS`; "" for a gradient.
    """

    kind: str
    values: Tensor
    mask: Tensor | None = None
    weight: Tensor | None = None
    pixel_size: tuple[float, float] | None = None
    packing: str = ""


def load_field(path: str | os.PathLike[str], packing: str | None = None) -> Field:
    """Read a normal map or a gradient; formats in the table at the top of this module.

    How the components are packed is found from the lengths of the vectors, by the rule of `torchdls.io.packing`, and
    said in `Field.packing`. Codes become float32 and are renormalised; those that are no normals but black, gray or
    white background come back as zero vectors, which `normals_to_gradient` reports. Floats with signs stay as they are.

    Args:
        path: the file.
        packing: one of `torchdls.io.packing.CHANNELS`, to say it; also makes normals of two channels of floats.

    Raises:
        OSError: the file cannot be opened.
        ValueError: the file is damaged, does not hold a normal map or a gradient, or the lengths of its vectors fit no
            packing.
        ImportError: the library for this format is not installed.

    Example:
        >>> import tempfile
        >>> import numpy
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     numpy.save(f"{folder}/slopes.npy", numpy.ones((2, 4, 5), dtype="float32"))
        ...     field = torchdls.load_field(f"{folder}/slopes.npy")
        >>> field.kind, field.values.shape
        ('gradient', torch.Size([1, 2, 4, 5]))
    """
    path = Path(path)
    content = read_file(path, tuple(SIGNATURES))
    if isinstance(content, Mapping):
        return _field_of_archive(path, content, packing)
    return _field_of_array(path, content, packing, last=path.suffix.lower() not in ARRAYS)


def load_mask(path: str | os.PathLike[str]) -> Tensor:
    """Read a mask as (1, 1, H, W) bool: white (at least half of the range, mean of the colours) or nonzero is valid.

    Raises: as `load_field`.

    Example:
        >>> import tempfile
        >>> import numpy
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     numpy.save(f"{folder}/mask.npy", numpy.eye(2))
        ...     torchdls.load_mask(f"{folder}/mask.npy")
        tensor([[[[ True, False],
                  [False,  True]]]])
    """
    path = Path(path)
    content = read_file(path, tuple(SIGNATURES))
    if isinstance(content, Mapping):
        content = content[one_of(path, content, ("mask",))]
    if content.ndim == 3 and _is_picture(path):
        content = content[..., : 1 if content.shape[-1] < 3 else 3].mean(-1, dtype=np.float64).astype(content.dtype)
    if content.ndim > 2:
        content = content.reshape(content.shape[-2:]) if content.size == np.prod(content.shape[-2:]) else content
    if content.ndim != 2 or not content.size:
        raise ValueError(f"{path}: shape {content.shape} is no mask, (H, W) is needed")
    threshold = np.iinfo(content.dtype).max / 2 if _is_picture(path) and content.dtype.kind == "u" else 0
    return torch.from_numpy((content > threshold) & np.isfinite(content))[None, None]


def load_camera(path: str | os.PathLike[str]) -> Tensor:
    """Read intrinsics K (3, 3) in float64 from NPY, NPZ or MAT (`camera` or `K`) or a text file of three rows.

    Raises: as `load_field`.

    Example:
        >>> import tempfile
        >>> import numpy
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     numpy.save(f"{folder}/camera.npy", numpy.diag([800.0, 800.0, 1.0]))
        ...     torchdls.load_camera(f"{folder}/camera.npy")
        tensor([[800.,   0.,   0.],
                [  0., 800.,   0.],
                [  0.,   0.,   1.]], dtype=torch.float64)
    """
    path = Path(path)
    if path.suffix.lower() in ARRAYS:
        content = read_file(path, ARRAYS)
        matrix = content[one_of(path, content, ("camera", "K"))] if isinstance(content, Mapping) else content
    else:
        if path.is_file() and path.stat().st_size > 100_000:
            raise ValueError(f"{path}: too long for a text of three rows")
        with naming(path, "text"), open(path, encoding="utf-8") as file:
            rows = [line.partition("#")[0].split() for line in file]
            try:
                matrix = np.array([[float(word) for word in row] for row in rows if row])
            except ValueError:
                raise ValueError("three rows of three numbers are needed") from None
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
        given = f"shape {matrix.shape} of {matrix.dtype} is no camera"
        raise ValueError(f"{path}: {given}, 3 x 3 finite numbers are needed")
    return torch.from_numpy(matrix.astype(np.float64))


def _field_of_array(
    path: Path, array: Array, packing: str | None, last: bool = False, kind: str | None = None
) -> Field:
    """Normals or gradient, recognised by the number of channels; `last`: look for them last first."""
    codes = array.dtype in (np.uint8, np.uint16)
    normals = kind == "normals" or codes or packing is not None
    numbers = {"gradient": [2], "normals": [2, 3, 4] if codes or packing else [3, 4]}.get(kind or "", [2, 3, 4])
    groups = [{2, 3} & set(numbers), {4} & set(numbers)] if array.ndim in (3, 4) else []
    axes = [axis for group in groups for axis in ((-1, -3) if last else (-3, -1)) if array.shape[axis] in group]
    if not axes or not (codes or array.dtype.kind == "f") or not array.size or (codes and kind == "gradient"):
        form = "8 or 16 bits without sign, or floats, with 3 channels for normals or 2 for a gradient are needed"
        raise ValueError(f"{path}: {kind or 'array'} of {array.dtype} and shape {array.shape}; {form}")
    if array.shape[axes[0]] == 2 and not normals:
        values = as_tensor(np.moveaxis(array, axes[0], -3))
        return Field("gradient", values if values.ndim == 4 else values[None])
    channels = np.moveaxis(array, axes[0], -1)
    if not codes:
        channels = channels.astype(np.float64 if array.dtype.itemsize >= 8 else np.float32)
    try:
        with np.errstate(all="ignore"):  # numbers near the end of their range are no lengths of 1
            found = unpack(channels, packing)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    n = found.normals.astype(np.float32) if codes else found.normals
    values = as_tensor(np.moveaxis(n, -1, -3))
    mask = None if found.mask is None else torch.from_numpy(np.ascontiguousarray(found.mask))[..., None, :, :]
    if values.ndim == 3:
        values, mask = values[None], None if mask is None else mask[None]
    return Field("normals", values, mask, packing=found.packing)


def _field_of_archive(path: Path, content: Mapping[str, Array], packing: str | None) -> Field:
    matlab = path.suffix.lower() == ".mat"
    kind: str | None = next((name for name in ("gradient", "normals") if name in content), None)
    if kind is None and matlab:
        array = _only_field(path, content)
    else:
        kind = one_of(path, content, ("gradient", "normals"))
        array = content[kind]
    field = _field_of_array(path, array, packing, last=matlab, kind=kind)
    n, _, h, w = field.values.shape
    planes: dict[str, Tensor | None] = {"mask": field.mask, "weight": None}
    for name, most in (("mask", 1), ("weight", 2)):
        if name in content:
            plane = content[name]
            if plane.ndim < 2 or plane.shape[-2:] != (h, w) or plane.size not in {n * h * w, most * n * h * w}:
                shapes = f"shape {plane.shape} given beside a {field.kind} {tuple(field.values.shape)}"
                raise ValueError(f"{path}: {name}: {shapes}, the sizes must agree")
            dtype = np.bool_ if name == "mask" else np.float64 if field.values.dtype == torch.float64 else np.float32
            planes[name] = torch.from_numpy(np.ascontiguousarray(plane, dtype=dtype)).reshape(n, -1, h, w)
    size = pair(path, content["pixel_size"]) if "pixel_size" in content else None
    return field._replace(mask=planes["mask"], weight=planes["weight"], pixel_size=size)


def _only_field(path: Path, content: Mapping[str, Array]) -> Array:
    """The only array (H, W, 3) or (H, W, 2) of a MAT file, whatever its name."""
    fields = [array for array in content.values() if array.ndim == 3 and array.shape[-1] in (2, 3)]
    if len(fields) != 1:
        have = ", ".join(content) or "nothing"
        raise ValueError(f"{path}: holds {have}; gradient, normals, or one array (H, W, 3) alone is needed")
    return fields[0]


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() not in ARRAYS
