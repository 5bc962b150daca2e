"""From a normal map to a surface in one call."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_fit
from torchdls._precision import full_precision
from torchdls._registry import INTEGRATORS, camera_options
from torchdls.anchors import fit_coarse
from torchdls.geometry import (
    depth_to_points,
    height_to_points,
    log_depth_to_depth,
    normals_to_gradient,
)
from torchdls.integrators import Integrator

_COARSE = 1e-5  # weight of a coarse depth: below what ties a surface, above what a cut leaves


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
    *,
    known: Tensor | float | None = None,
    coarse: Tensor | None = None,
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
        method: the name of an integrator, or one that is made; its `pixel_size` is that of the points. What is made by
            name learns the focal length of the camera, if it asks for one (`Piecewise`, `Bilateral`).
        known: (N, 1, H, W) heights, or depths under a camera, in their true unit, not finite where unknown: one point
            is enough for a depth in that unit, one on each piece places all. Or a number: the median of each surface.
        coarse: (N, 1, H, W) heights or depths of any scale and offset, not finite where unknown, such as a network
            guesses from one picture or the model of a body has. Both are fitted (`fit_coarse`); then the surface is
            integrated once more with them as anchors of weight 1e-5, which place pieces that nothing else holds.

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
    integrator = _integrator(method, camera)
    if camera is not None and integrator.pixel_size != (1.0, 1.0):
        raise ValueError(
            f"reconstruct: pixel_size {integrator.pixel_size} given beside a camera, which already holds it"
        )
    field = normals_to_gradient(normals, convention, mask=mask, camera=camera)
    gradient, inside = (t if normals.ndim == 4 else t[None] for t in (field.gradient, field.mask))
    if not bool(inside.flatten(1).any(1).all()):
        raise ValueError(f"reconstruct: no valid normal on a surface of {tuple(normals.shape)} under {convention!r}")
    fields = gradient, None if bool(inside.all()) else inside
    found = solve_with(integrator, *fields, known=known, coarse=coarse, log_depth=camera is not None)
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
        _assumed(convention, camera, integrator, int(field.invalid.sum()), known is not None, coarse is not None),
    )


def _integrator(method: str | Integrator, camera: Tensor | None) -> Integrator:
    if isinstance(method, Integrator):
        if camera is not None and getattr(method, "focal_length", 1) is None:
            raise ValueError(f"reconstruct: {method!r} given beside a camera, whose focal_length it needs")
        return method
    if not isinstance(method, str):
        raise TypeError(f"reconstruct: method is a {type(method).__name__}, a name or an Integrator is needed")
    if method not in INTEGRATORS:
        raise ValueError(f"reconstruct: method {method!r} is unknown; choose from {', '.join(INTEGRATORS)}")
    return INTEGRATORS[method](**camera_options(method, camera))


def solve_with(
    integrator: Integrator,
    gradient: Tensor,
    mask: Tensor | None = None,
    weight: Tensor | None = None,
    *,
    known: Tensor | float | None = None,
    coarse: Tensor | None = None,
    log_depth: bool = False,
) -> Any:
    """What `integrator.solve` returns on (N, C, H, W), with heights or depths that are known, or coarsely known."""
    inside = torch.ones_like(gradient[:, :1], dtype=torch.bool) if mask is None else mask
    anchor = pull = torch.zeros_like(gradient[:, :1])
    if isinstance(known, Tensor):
        check_fit("reconstruct", "known", known, gradient, "gradient", channels=(1,))
        given = inside & known.isfinite()
        if log_depth and not bool((known[given.expand_as(known)] > 0).all()):
            raise ValueError(f"reconstruct: known {tuple(known.shape)} holds depths that are not positive")
        anchor = torch.where(given, known, 1)
        anchor, pull = anchor.log() if log_depth else anchor, given.to(gradient)
    held = (anchor, pull) if bool((pull > 0).any()) else (None, None)
    found = integrator.solve(gradient, mask, weight, *held)
    if coarse is not None:
        check_fit("reconstruct", "coarse", coarse, gradient, "gradient", channels=(1,))
        pieces = found._asdict().get("pieces")
        fit = fit_coarse(found.height.detach(), coarse, inside, pieces, log_depth=log_depth)
        anchor = torch.where(pull > 0, anchor, fit.anchor)
        pull = torch.where(fit.known & (pull == 0), _COARSE, pull)
        found = integrator.solve(gradient, mask, weight, anchor, pull)
    if isinstance(known, Tensor) or known is None:
        return found
    z = torch.where(inside, found.height, torch.nan).flatten(1).nanmedian(1).values[:, None, None, None]
    middle = torch.where(inside, torch.as_tensor(known).log() if log_depth else known, 0)
    return found._replace(height=found.height + torch.where(inside, middle - z, 0))


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


def _assumed(
    convention: str, camera: Tensor | None, integrator: Integrator, invalid: int, known: bool, coarse: bool
) -> tuple[str, ...]:
    said = [f"convention {convention}: {_FRAMES[convention]}", f"method {integrator!r}"]
    if camera is None:
        dx, dy = integrator.pixel_size
        said += [f"no perspective, pixels of {dx:g} x {dy:g}", "the height of each connected part has mean 0"]
    else:
        said += ["a perspective camera", "the depth of each connected part has geometric mean 1"]
    if known or coarse:
        said[-1] = "the scale and offset of the coarse depth are fitted" if coarse else "heights are as known"
    if invalid:
        said.append(f"{invalid} normals inside the mask that are none, turned away or grazing are left out")
    return tuple(said)
