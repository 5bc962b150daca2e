"""From a normal map to a surface in one call."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls._registry import INTEGRATORS
from torchdls.geometry import (
    depth_to_points,
    height_to_points,
    log_depth_to_depth,
    normals_to_gradient,
)
from torchdls.integrators import Integrator


class Reconstruction(NamedTuple):
    """What `reconstruct` returns: always batched, NaN outside the mask.

    Attributes:
        height: (N, 1, H, W), without a camera; zero mean over each connected part. None under a camera.
        depth: (N, 1, H, W), under a camera, with geometric mean 1 over each connected part. None without one.
        points: (N, 3, H, W), x right, y up, z to the viewer.
        mask: (N, 1, H, W) bool, the pixels that hold a surface.
        gradient: (N, 2, H, W) what was integrated: slopes, or those of the log depth under a camera.
        noise: (N,) the standard deviation of one slope that the method found, or None.
        assumed: what was taken for granted or left out, a line each.

    Example:
        >>> torchdls.reconstruct(torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1).expand(1, 3, 8, 8)).points.shape
        torch.Size([1, 3, 8, 8])
    """

    height: Tensor | None
    depth: Tensor | None
    points: Tensor
    mask: Tensor
    gradient: Tensor
    noise: Tensor | None
    assumed: tuple[str, ...]


@full_precision
def reconstruct(
    normals: Tensor,
    mask: Tensor | None = None,
    camera: Tensor | None = None,
    convention: str = "opengl",
    method: str | Integrator = "slope_dls",
) -> Reconstruction:
    r"""The surface whose normals are given: `normals_to_gradient`, an integrator, and points.

        without a camera   grad z = (-n1/n3, n2/n3),   z = method(grad z),   X = (column, -row, z)
        with a camera      grad u = -(l1, l2)/(l.m),   u = method(grad u),   Z = exp u,   X = Z K^-1 m

    in the canonical frame, with m = (column, row, 1) and l = K^-T n. What is not the surface (outside the mask, no
    normal, turned away) is NaN in the result and does not touch the rest. Differentiable as the method is.

    Args:
        normals: (N, 3, H, W) or (3, H, W), of any length; without unit where no camera tells the size of a pixel.
        mask: (N, 1, H, W) or (1, H, W) bool; default: all pixels.
        camera: intrinsics K, (3, 3) or (N, 3, 3), in pixels.
        convention: of the normals, a key of `NORMAL_CONVENTIONS`.
        method: the name of an integrator, or one that is made; its `pixel_size` is that of the points.

    Returns:
        `Reconstruction`.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape, the convention, the camera or the method is not usable, or a surface has no valid pixel.

    Source: Durou, Courteille (2007) for the camera.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> found = torchdls.reconstruct(torchdls.gradient_to_normals(surface.gradient), method="least_squares")
        >>> bool(torchdls.rmse(found.height, surface.height) < 0.05)
        True
        >>> found.assumed[0]
        'convention opengl: x right, y up, z to the viewer'
    """
    integrator = _integrator(method)
    if camera is not None and integrator.pixel_size != (1.0, 1.0):
        raise ValueError(
            f"reconstruct: pixel_size {integrator.pixel_size} given beside a camera, which already holds it"
        )
    field = normals_to_gradient(normals, convention, mask=mask, camera=camera)
    gradient, inside = (t if normals.ndim == 4 else t[None] for t in (field.gradient, field.mask))
    if not bool(inside.flatten(1).any(1).all()):
        raise ValueError(f"reconstruct: no valid normal on a surface of {tuple(normals.shape)} under {convention!r}")
    found = integrator.solve(gradient, None if bool(inside.all()) else inside)
    z = torch.where(inside, found.height, torch.nan)
    depth = None if camera is None else log_depth_to_depth(z)
    points = height_to_points(z, integrator.pixel_size) if camera is None else depth_to_points(_given(depth), camera)
    return Reconstruction(
        z if camera is None else None,
        depth,
        torch.where(inside, points, torch.nan),
        inside,
        gradient,
        found._asdict().get("noise"),
        _assumed(convention, camera, integrator, int(field.invalid.sum())),
    )


def _integrator(method: str | Integrator) -> Integrator:
    if isinstance(method, Integrator):
        return method
    if not isinstance(method, str):
        raise TypeError(f"reconstruct: method is a {type(method).__name__}, a name or an Integrator is needed")
    if method not in INTEGRATORS:
        raise ValueError(f"reconstruct: method {method!r} is unknown; choose from {', '.join(INTEGRATORS)}")
    return INTEGRATORS[method]()


def _given(depth: Tensor | None) -> Tensor:
    assert depth is not None
    return depth


_FRAMES = {
    "opengl": "x right, y up, z to the viewer",
    "directx": "x right, y down, z to the viewer",
    "opencv": "x right, y down, z forward, towards the camera",
    "kornia": "x right, y down, z forward, away from the camera",
    "matlab": "x down the rows, y along the columns, z to the viewer",
}


def _assumed(convention: str, camera: Tensor | None, integrator: Integrator, invalid: int) -> tuple[str, ...]:
    said = [f"convention {convention}: {_FRAMES[convention]}", f"method {integrator!r}"]
    if camera is None:
        dx, dy = integrator.pixel_size
        said += [f"no perspective, pixels of {dx:g} x {dy:g}", "the height of each connected part has mean 0"]
    else:
        said += ["a perspective camera", "the depth of each connected part has geometric mean 1"]
    if invalid:
        said.append(f"{invalid} normals inside the mask that are none, turned away or grazing are left out")
    return tuple(said)
