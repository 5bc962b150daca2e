"""Files: normal maps, gradients and masks in; heights and meshes out, whole or not at all.

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

import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchdls._files import SIGNATURES, Array, atomic_file, check_output, naming, read_file, require
from torchdls.geometry import height_to_points

_MESHES = (".ply", ".obj", ".stl", ".glb")
OUTPUT_SUFFIXES = (".npz", ".npy", ".tiff", ".tif", ".png", *_MESHES)


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


class HeightMap(NamedTuple):
    """A height (1, 1, H, W), NaN outside the mask; the mask (1, 1, H, W); the pixel size (dx, dy)."""

    height: Tensor
    mask: Tensor
    pixel_size: tuple[float, float]


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
        content = content[_one_of(path, content, ("mask",))]
    if content.ndim == 3 and path.suffix.lower() not in (".npy", ".npz"):
        content = content[..., : 1 if content.shape[-1] < 3 else 3].mean(-1, dtype=np.float64).astype(content.dtype)
    if content.ndim > 2:
        content = content.reshape(content.shape[-2:]) if content.size == np.prod(content.shape[-2:]) else content
    if content.ndim != 2 or not content.size:
        raise ValueError(f"{path}: shape {content.shape} is no mask, (H, W) is needed")
    threshold = np.iinfo(content.dtype).max / 2 if _is_image(path) and content.dtype.kind == "u" else 0
    return torch.from_numpy((content > threshold) & np.isfinite(content))[None, None]


def load_height(path: str | os.PathLike[str]) -> HeightMap:
    """Read back a height that `save_height` wrote as NPZ, NPY, TIFF or PNG.

    Raises: as `load_field`.
    """
    path = Path(path)
    content = read_file(path, (".npz", ".npy", ".tif", ".tiff", ".png"))
    pixel_size = (1.0, 1.0)
    if isinstance(content, dict):
        pixel_size = _pair(path, content.get("pixel_size", pixel_size))
        content = content[_one_of(path, content, ("height", "depth"))]
    elif path.suffix.lower() == ".png":
        notes = _png_notes(path)
        pixel_size = _pair(path, notes["pixel_size"])
        codes = content.reshape(content.shape[:2])
        content = np.where(
            codes == notes["invalid"], np.nan, notes["offset"] + notes["scale"] * codes.astype(np.float64)
        )
    elif path.suffix.lower() != ".npy":
        pixel_size = _pair(path, _tiff_notes(path).get("pixel_size", pixel_size))
    if content.ndim != 2 or content.dtype.kind != "f":
        raise ValueError(f"{path}: {content.dtype} of shape {content.shape} is no height, floats (H, W) are needed")
    height = _tensor(content)[None, None]
    return HeightMap(height, height.isfinite(), pixel_size)


def load_camera(path: str | os.PathLike[str]) -> Tensor:
    """Read intrinsics K (3, 3) in float64 from NPY, NPZ (`camera` or `K`) or a text file of three rows.

    Raises: as `load_field`.
    """
    path = Path(path)
    if path.suffix.lower() in (".npy", ".npz"):
        content = read_file(path, (".npy", ".npz"))
        matrix = content[_one_of(path, content, ("camera", "K"))] if isinstance(content, dict) else content
    else:
        with naming(path, "text"):
            matrix = np.loadtxt(path, ndmin=2)
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
        given = f"shape {matrix.shape} of {matrix.dtype} is no camera"
        raise ValueError(f"{path}: {given}, 3 x 3 finite numbers are needed")
    return torch.from_numpy(matrix.astype(np.float64))


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
        ValueError: the suffix is unknown, a shape is wrong, or no pixel (for a mesh: no triangle) is valid.
        OSError: the directory does not exist, the file exists, or writing fails. ImportError: a library is missing.
    """
    path = check_output(path, overwrite, suffixes=OUTPUT_SUFFIXES)
    values = _single("height", height)
    valid = np.isfinite(values) if mask is None else _single("mask", mask).astype(bool)
    if valid.shape != values.shape:
        raise ValueError(f"mask: shape {tuple(valid.shape)} given beside a height {tuple(values.shape)}")
    valid = valid & np.isfinite(values)
    if not valid.any():
        raise ValueError("mask: no valid pixel to write")
    if path.suffix.lower() in _MESHES:
        vertices = height_to_points(torch.from_numpy(values)[None], pixel_size) if points is None else points
        return save_mesh(path, vertices, torch.from_numpy(valid), overwrite=overwrite)
    values = np.where(valid, values, np.nan).astype(values.dtype)
    notes = {"quantity": quantity, "pixel_size": [float(d) for d in pixel_size]}
    if path.suffix.lower() == ".npz":
        extra = {name: _numpy(value) for name, value in arrays.items()}
        entries = {quantity: values, "mask": valid, "pixel_size": np.asarray(pixel_size, np.float64)} | extra
        write: Callable[[BinaryIO], Any] = lambda file: np.savez_compressed(file, allow_pickle=False, **entries)  # noqa: E731
    elif path.suffix.lower() == ".npy":
        write = lambda file: np.save(file, values)  # noqa: E731
    else:
        write = _png_writer(values, notes) if path.suffix.lower() == ".png" else _tiff_writer(values, notes)
    with atomic_file(path, overwrite) as file:
        write(file)


def save_mesh(
    path: str | os.PathLike[str], points: Tensor, mask: Tensor | None = None, *, overwrite: bool = False
) -> None:
    """Write the triangles between neighbouring valid points (3, H, W) or (1, 3, H, W) as PLY, OBJ, STL or GLB.

    Faces are counter-clockwise seen from the viewer (+z). Points in no triangle are left out.

    Raises: as `save_height`.
    """
    path = check_output(path, overwrite, suffixes=_MESHES)
    trimesh = require("trimesh", "files")
    grid = _numpy(points)
    grid = grid[0] if grid.ndim == 4 and len(grid) == 1 else grid
    if grid.ndim != 3 or len(grid) != 3:
        raise ValueError(f"points: shape {tuple(points.shape)} given, (3, H, W) is needed")
    finite = np.isfinite(grid).all(0)
    valid = finite if mask is None else _single("mask", mask).astype(bool)
    if valid.shape != finite.shape:
        raise ValueError(f"mask: shape {tuple(valid.shape)} given beside points {tuple(grid.shape)}")
    faces = _triangles(np.logical_and(valid, finite))
    if not len(faces):
        raise ValueError("mask: no triangle of valid pixels, so there is no mesh to write")
    used, faces = np.unique(faces, return_inverse=True)
    mesh = trimesh.Trimesh(grid.reshape(3, -1).T[used], faces.reshape(-1, 3), process=False)
    content = mesh.export(file_type=path.suffix.lower()[1:])
    with atomic_file(path, overwrite) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def _triangles(valid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Corners (T, 3) as pixel numbers: two triangles in a cell of four valid pixels a b / c d, one where three are."""
    number = np.arange(valid.size).reshape(valid.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    va, vb, vc, vd = (valid.ravel()[corner] for corner in (a, b, c, d))
    cases = (
        (va & vb & vc, (a, c, b)),
        (vb & vc & vd, (b, c, d)),
        (va & vc & vd & ~vb, (a, c, d)),
        (va & vb & vd & ~vc, (a, d, b)),
    )
    return np.concatenate([np.stack([corner[keep] for corner in corners], 1) for keep, corners in cases])


def _field_of_codes(path: Path, codes: Array) -> Field:
    if codes.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: {codes.dtype} codes given, 8 or 16 bits without sign are needed")
    top = np.iinfo(codes.dtype).max
    n = 2 * codes[..., :3].astype(np.float64) / top - 1
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    n = np.where((length > 0.1) & (length < 1.5), n / np.maximum(length, 0.1), 0).astype(np.float32)
    mask = torch.from_numpy(codes[..., 3] > top / 2)[None, None] if codes.shape[-1] == 4 else None
    return Field("normals", _tensor(np.moveaxis(n, -1, 0))[None], mask)


def _field_of_array(path: Path, array: Array, kind: str | None = None, last: bool = False) -> Field:
    """Normals or gradient from floats, recognised by the number of channels; `last`: look for them last first."""
    channels = {"normals": (3,), "gradient": (2,), None: (2, 3)}[kind]
    axes = [axis for axis in ((-1, -3) if last else (-3, -1)) if array.ndim in (3, 4) and array.shape[axis] in channels]
    if not axes or array.dtype.kind != "f" or not array.size:
        wanted = "floats (3, H, W) of normals or (2, H, W) of a gradient are needed"
        raise ValueError(f"{path}: {kind or 'array'} of {array.dtype} and shape {array.shape}, {wanted}")
    values = _tensor(np.moveaxis(array, axes[0], -3))
    values = values if values.ndim == 4 else values[None]
    if values.shape[1] == 2:
        return Field("gradient", values)
    lengths = [n.norm(dim=1) for n in (values, 2 * values - 1)]
    error = [float((length[length.isfinite() & (length > 0.1)] - 1).abs().nanmean()) for length in lengths]
    encoded = bool((values.nan_to_num() >= 0).all()) and error[1] < min(error[0], 0.1)
    return Field("normals", 2 * values - 1 if encoded else values)


def _field_of_npz(path: Path, content: dict[str, Array]) -> Field:
    kind = _one_of(path, content, ("gradient", "normals"))
    field = _field_of_array(path, content[kind], kind)
    n, _, h, w = field.values.shape
    planes: dict[str, Tensor | None] = {"mask": None, "weight": None}
    for name, most in (("mask", 1), ("weight", 2)):
        if name in content:
            plane = content[name]
            if plane.shape[-2:] != (h, w) or plane.size not in {n * h * w, most * n * h * w}:
                shapes = f"shape {content[name].shape} given beside a {kind} {tuple(field.values.shape)}"
                raise ValueError(f"{path}: {name}: {shapes}, the sizes must agree")
            planes[name] = _tensor(plane.astype(bool if name == "mask" else content[kind].dtype)).reshape(n, -1, h, w)
    size = _pair(path, content["pixel_size"]) if "pixel_size" in content else None
    return field._replace(mask=planes["mask"], weight=planes["weight"], pixel_size=size)


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
        return dict(json.loads(image.info["torchdls"]))


def _tiff_notes(path: Path) -> dict[str, Any]:
    tifffile = require("tifffile", "files")
    with tifffile.TiffFile(path) as file, suppress(ValueError):
        return dict(json.loads(file.pages[0].description))
    return {}


def _one_of(path: Path, content: dict[str, Array], names: Sequence[str]) -> str:
    for name in names:
        if name in content:
            return name
    raise ValueError(f"{path}: holds {', '.join(content) or 'nothing'}, {' or '.join(names)} is needed")


def _pair(path: Path, value: Any) -> tuple[float, float]:
    pair = np.asarray(value, np.float64).ravel()
    if pair.size not in (1, 2) or not (np.isfinite(pair) & (pair > 0)).all():
        raise ValueError(f"{path}: pixel_size {value!r}, one or two positive numbers are needed")
    return float(pair[0]), float(pair[-1])


def _is_image(path: Path) -> bool:
    return path.suffix.lower() not in (".npy", ".npz")


def _tensor(array: Array) -> Tensor:
    """Bool, float32 or float64 in native byte order; half precision is widened."""
    wanted = array.dtype if array.dtype.kind == "b" else np.float64 if array.dtype.itemsize >= 8 else np.float32
    return torch.from_numpy(np.ascontiguousarray(array, dtype=wanted))


def _numpy(value: Tensor | Array | float) -> Array:
    return value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)


def _single(name: str, tensor: Tensor) -> Array:
    array = _numpy(tensor)
    if array.ndim < 2 or array.size != np.prod(array.shape[-2:]) or not array.size:
        raise ValueError(f"{name}: shape {tuple(array.shape)} given, one surface (1, 1, H, W) or (H, W) is needed")
    return array.reshape(array.shape[-2:])
