"""Heights as triangle meshes."""

from __future__ import annotations

import os

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchdls._checks import check_alike, check_real
from torchdls._files import (
    as_array,
    atomic_file,
    check_output,
    require,
    single_map,
)

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".glb")


def save_mesh(
    path: str | os.PathLike[str], points: Tensor, mask: Tensor | None = None, *, overwrite: bool = False
) -> None:
    """Write the triangles between neighbouring valid points (3, H, W) or (1, 3, H, W) as PLY, OBJ, STL or GLB.

    Faces are counter-clockwise seen from the viewer (+z). Points in no triangle are left out.

    Raises: as `save_height`.

    Example:
        >>> import pathlib, tempfile
        >>> points = torchdls.height_to_points(torch.zeros(1, 1, 3, 3))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torchdls.save_mesh(f"{folder}/mesh.stl", points)
        ...     pathlib.Path(folder, "mesh.stl").stat().st_size  # eight triangles of 50 bytes, and a header of 84
        484
    """
    path = check_output(path, overwrite, suffixes=MESH_SUFFIXES)
    trimesh = require("trimesh", "files")
    check_real("save_mesh", "points", points)
    if mask is not None:
        check_alike("save_mesh", "mask", mask, torch.bool)
    grid = as_array(points)
    grid = grid[0] if grid.ndim == 4 and len(grid) == 1 else grid
    if grid.ndim != 3 or len(grid) != 3:
        raise ValueError(f"points: shape {tuple(points.shape)} given, (3, H, W) is needed")
    finite = np.isfinite(grid).all(0)
    valid = finite if mask is None else single_map("mask", mask).astype(bool)
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
