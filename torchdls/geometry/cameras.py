"""Depths and heights as points, through perspective cameras or from square to it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdls._checks import check_field, check_real
from torchdls._precision import full_precision
from torchdls.geometry.conventions import NORMAL_CONVENTIONS, permute
from torchdls.operators import as_pixel_size


@full_precision
def log_depth_to_depth(log_depth: Tensor, scale: float | Tensor = 1.0) -> Tensor:
    """Depth Z = scale * exp(u) from the integrated log depth u.

    An integrator returns u with zero mean, so `scale` is the geometric mean of the depth (of each component of the
    mask), in the unit wanted; a tensor must broadcast against (N, 1, H, W).

    TypeError for a log depth or a scale that is not float32 or float64.

    Example:
        >>> torchdls.log_depth_to_depth(torch.zeros(1, 1, 2, 2), scale=3.0)
        tensor([[[[3., 3.],
                  [3., 3.]]]])
    """
    check_real("log_depth_to_depth", "log_depth", log_depth)
    if isinstance(scale, Tensor):
        check_real("log_depth_to_depth", "scale", scale)
    return scale * log_depth.exp()


@full_precision
def depth_to_points(depth: Tensor, camera: Tensor) -> Tensor:
    """Points X = Z K^-1 (column, row, 1) of a depth (N, 1, H, W): (N, 3, H, W), x right, y up, z to the viewer.

    TypeError or ValueError for a depth or camera that is not usable, as in `normals_to_gradient`.

    Example:
        >>> camera = torch.tensor([[8.0, 0, 2], [0, 8, 2], [0, 0, 1]])
        >>> torchdls.depth_to_points(torch.ones(1, 1, 5, 5), camera)[0, :, 3, 4]
        tensor([ 0.2500, -0.1250, -1.0000])
    """
    check_field("depth_to_points", "depth", depth, 1)
    points = depth * apply_matrix(inverse_camera(camera, depth), pixel_grid(depth))
    return permute(points, NORMAL_CONVENTIONS["opencv"])


@full_precision
def height_to_points(height: Tensor, pixel_size: float | Sequence[float] = 1.0) -> Tensor:
    """Points (column dx, -row dy, z) of a height (N, 1, H, W): (N, 3, H, W), x right, y up, z to the viewer.

    TypeError or ValueError for a height or `pixel_size` that is not usable.

    Example:
        >>> torchdls.height_to_points(torch.zeros(1, 1, 4, 5), pixel_size=0.5)[0, :, 3, 4]
        tensor([ 2.0000, -1.5000,  0.0000])
    """
    check_field("height_to_points", "height", height, 1)
    dx, dy = as_pixel_size(pixel_size)
    columns, rows, _ = pixel_grid(height).split(1, -3)
    return torch.cat([(columns * dx).expand_as(height), (rows * -dy).expand_as(height), height], -3)


def apply_matrix(matrix: Tensor, field: Tensor) -> Tensor:
    """One 3x3 matrix per surface, or one for all, on the channels of (..., 3, H, W)."""
    return torch.einsum("...ij,...jhw->...ihw", matrix, field)


def pixel_grid(like: Tensor) -> Tensor:
    """Homogeneous pixels (column, row, 1), (3, H, W)."""
    h, w = like.shape[-2:]
    columns = torch.arange(w, dtype=like.dtype, device=like.device).expand(h, w)
    rows = torch.arange(h, dtype=like.dtype, device=like.device)[:, None].expand(h, w)
    return torch.stack([columns, rows, torch.ones_like(columns)])


def check_camera(camera: Tensor, field: Tensor) -> Tensor:
    """The camera (N, 3, 3) in the dtype of the field, once it is found to fit."""
    check_real("camera", "K", camera)
    allowed = [(3, 3)] if field.ndim == 3 else [(3, 3), (1, 3, 3), (field.shape[0], 3, 3)]
    if camera.shape not in allowed:
        shapes = f"{tuple(camera.shape)} given beside {tuple(field.shape)}"
        raise ValueError(f"camera: shape {shapes}, (3, 3) or (N, 3, 3) is needed")
    return camera.to(field)


def inverse_camera(camera: Tensor, field: Tensor) -> Tensor:
    """K^-1 (N, 3, 3); ValueError for a camera that has none."""
    k = check_camera(camera, field)
    inverse, info = torch.linalg.inv_ex(k)
    if info.any() or not inverse.isfinite().all():
        raise ValueError("camera: K is singular or not finite, focal lengths that are not 0 are needed")
    return inverse
