"""What all pictures share: heights as planes, relief under a lamp, colours."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchdls._checks import check_alike, check_field, check_real
from torchdls.geometry import gradient_to_normals

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Plane = NDArray[np.float64]
INK, FAINT = "#222222", "#8a8a8a"
EARTH = ["#6f9a9c", "#93b48a", "#cfcb97", "#e2cfae", "#f0e4dc"]  # muted: the light tells the relief


def hillshade(
    height: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0), azimuth: float = 315.0, altitude: float = 45.0
) -> Tensor:
    r"""Brightness of a matte surface under a distant lamp, max(0, n . s), from 0 to 1.

    s = (sin a cos e, cos a cos e, sin e) for azimuth a and altitude e, x right and y up; slopes by central differences.

    Args:
        height: (..., H, W), both sides at least 2; NaN outside the surface stays NaN.
        pixel_size: (dx, dy), in the unit of the height.
        azimuth: degrees clockwise from the top of the image; 315 is the upper left.
        altitude: degrees above the image plane.

    Raises:
        TypeError: the height is not float32 or float64.
        ValueError: its shape is wrong.

    Example:
        >>> shade = torchdls.hillshade(torch.zeros(4, 5), altitude=30)  # flat: the sine of the altitude everywhere
        >>> shade.shape, round(float(shade[0, 0]), 2)
        (torch.Size([4, 5]), 0.5)
    """
    check_real("hillshade", "height", height)
    if height.ndim < 2 or min(height.shape[-2:]) < 2:
        raise ValueError(f"height: shape {tuple(height.shape)} given, (..., H, W) of at least 2 x 2 pixels is needed")
    down, right = torch.gradient(height, dim=(-2, -1))
    zx, zy = right / pixel_size[0], down / pixel_size[1]
    a, e = math.radians(azimuth), math.radians(altitude)
    light = -zx * math.sin(a) * math.cos(e) + zy * math.cos(a) * math.cos(e) + math.sin(e)
    return (light / (1 + zx.square() + zy.square()).sqrt()).clamp(min=0)


def planes_of(truth: Tensor | None, heights: Mapping[str, Tensor], mask: Tensor | None) -> dict[str, Plane]:
    """Name -> (H, W) in float64, NaN outside the mask, all moved to the mean level of the first."""
    fields = ({} if truth is None else {"Ground truth": truth}) | dict(heights)
    if not heights:
        raise ValueError("heights: none given, at least one is needed")
    for name, field in fields.items():
        check_real("heights", name, field)
    planes: dict[str, Plane] = {}
    shape = tuple(next(iter(fields.values())).shape[-2:])
    if mask is not None:
        check_alike("heights", "mask", mask, torch.bool)
        check_shape("mask", mask, shape)
    for name, field in fields.items():
        check_shape(name, field, shape)
        planes[name] = field.detach().cpu().double().reshape(shape).numpy().copy()
        if mask is not None:
            planes[name][~mask.cpu().reshape(shape).numpy()] = np.nan
    if not all(np.isfinite(plane).any() for plane in planes.values()):
        raise ValueError("heights: no valid pixel to show")
    level = np.nanmean(next(iter(planes.values())))
    return {name: plane - np.nanmean(plane) + level for name, plane in planes.items()}


def check_shape(label: str, field: Tensor, shape: tuple[int, ...]) -> None:
    """One surface of the shape that the first one has, of at least 2 x 2 pixels."""
    h, w = shape if len(shape) == 2 and min(shape) > 1 else ("H", "W")
    if tuple(field.shape) not in ((h, w), (1, h, w), (1, 1, h, w)):
        raise ValueError(f"{label}: shape {tuple(field.shape)} given, (1, 1, {h}, {w}) is needed")


def check_slopes(label: str, slopes: Tensor, shape: tuple[int, int]) -> None:
    """Slopes (1, 2, H, W) of the shape that the heights have."""
    check_field("compare_heights", label, slopes, 2)
    if tuple(slopes.shape[-2:]) != shape or slopes.shape[:-3].numel() != 1:
        raise ValueError(f"{label}: shape {tuple(slopes.shape)} given, (1, 2, {shape[0]}, {shape[1]}) is needed")


def span_of(plane: Plane) -> tuple[float, float]:
    """The least and the largest value, 1 apart where they are the same."""
    low, high = float(np.nanmin(plane)), float(np.nanmax(plane))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def lift_of(plane: Plane, pixel_size: tuple[float, float]) -> float:
    """The factor on heights that brings the root mean square slope to 1/2; 1 for a horizontal plane."""
    zy, zx = np.gradient(plane, pixel_size[1], pixel_size[0])
    slope = float(np.sqrt(np.nanmean(zx**2 + zy**2))) if np.isfinite(zx + zy).any() else 0.0
    return 0.5 / slope if slope > 1e-9 else 1.0


def draw_relief(
    axis: Axes, plane: Plane, pixel_size: tuple[float, float], span: tuple[float, float], name: str, note: str
) -> None:
    """A hillshade in the colours of height, with its name above and a note below."""
    import matplotlib as mpl

    shade = hillshade(torch.from_numpy(plane), pixel_size).numpy()
    color = mpl.colormaps["gist_earth"](0.25 + 0.6 * np.clip((plane - span[0]) / (span[1] - span[0]), 0, 1))[..., :3]
    pastel = 0.55 + 0.45 * color  # the relief is told by light; colour only hints at height
    image = np.dstack([pastel * np.clip(0.22 + shade, 0, 1)[..., None], np.isfinite(shade)])
    axis.imshow(np.nan_to_num(image), interpolation="antialiased", aspect=pixel_size[1] / pixel_size[0])
    axis.set_title(name, fontsize=12, color=INK, loc="left", fontweight="bold")
    if note:
        axis.set_xlabel(note, fontsize=10, color=INK, loc="left")
    bare(axis)


def draw_normals(axis: Axes, slopes: Tensor, first: Plane, lift: float, title: str) -> None:
    """Slopes (1, 2, H, W), raised by a factor, as a normal map, where the plane is finite."""
    raised = slopes.detach().cpu().double().reshape(2, *first.shape) * lift
    normals = gradient_to_normals(raised).permute(1, 2, 0).numpy()
    axis.imshow(np.nan_to_num(np.dstack([(normals + 1) / 2, np.isfinite(first)])), interpolation="antialiased")
    axis.set_title(title, fontsize=11, color=INK, loc="left")
    bare(axis)


def bare(axis: Axes) -> None:
    """No ticks and no frame."""
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
