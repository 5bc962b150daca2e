"""All maps of one surface on a sheet."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchdls._checks import check_real
from torchdls._files import require
from torchdls.operators import GradientOperator, edge_ends, edge_slopes
from torchdls.plot.relief import (
    FAINT,
    INK,
    Plane,
    bare,
    draw_normals,
    draw_relief,
    lift_of,
    planes_of,
    span_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def surface_preview(
    height: Tensor,
    *,
    gradient: Tensor | None = None,
    truth: Tensor | None = None,
    mask: Tensor | None = None,
    trust: Tensor | None = None,
    jump: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    quantity: str = "height",
    title: str = "",
    unit: str = "px",
) -> Figure:
    r"""One surface on a sheet: relief and height, and below them whatever else is known of it, with units and bars.

    - Relief under a lamp from the upper left, raised so that its root mean square slope is 1/2.
    - Height with contour lines; with `quantity="depth"`, depth.
    - With `gradient`: the measured normals, with a hemisphere in the same colours, and the residual at each pixel,
      the root mean square of (A z - v)_e over its edges: noise should be left in it, and no drawing of the surface.
    - With `trust`: where the method was told, or found, to distrust the slopes.
    - With `jump`: the probability that the surface jumps at the pixel, the larger of its two edges'.
    - With `truth`: the error, without the constant.

    Args:
        height: (1, 1, H, W).
        gradient: (1, 2, H, W) what was integrated; of log depth, beside a depth.
        truth: (1, 1, H, W).
        mask: (1, 1, H, W) bool; pixels outside are left blank.
        trust: (1, 1 or 2, H, W), at least 0, such as weights or `SlopeDLSResult.confidence`.
        jump: (1, 2, H, W) as `PiecewiseResult.jump`.
        pixel_size: (dx, dy); of no effect on a depth.
        quantity: "height", or "depth", positive and away from the viewer, whose relief is that of -log depth.
        title: a line above everything.
        unit: of the heights, for the labels.

    Raises:
        TypeError: a field is not float32 or float64, or the mask is not bool.
        ValueError: the shapes differ, no pixel is valid, or `quantity` is another word.
        ImportError: matplotlib is missing.

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> figure = torchdls.surface_preview(surface.height, gradient=surface.gradient, title="Tent", unit="mm")
        >>> [axis.get_title(loc="left") for axis in figure.axes][:4]
        ['Relief', 'Height', 'Measured normals', 'Residual']
    """
    require("matplotlib", "plots")
    if quantity not in ("height", "depth"):
        raise ValueError(f'quantity: {quantity!r} given, "height" or "depth" is needed')
    check_real("surface_preview", "height", height)
    shown = {quantity: height} if truth is None else {quantity: height, "truth": truth}
    planes = planes_of(None, shown, mask)
    plane = planes[quantity]
    _check_fields(plane, gradient, trust, jump)
    deep = quantity == "depth"
    relief = -np.log(plane) if deep else plane
    steps = (1.0, 1.0) if deep else pixel_size
    lift = lift_of(relief, steps)
    panels: list[Any] = [
        lambda axis: draw_relief(axis, relief, (steps[0] / lift, steps[1] / lift), span_of(relief), "Relief", ""),
        lambda axis: _draw_height(axis, plane, quantity, unit),
    ]
    if gradient is not None:
        slopes = -gradient if deep else gradient
        residual = _residual(relief, slopes, steps)
        panels.append(lambda axis: _draw_measured(axis, slopes, plane, lift if deep else 1.0))
        panels.append(lambda axis: _draw_map(axis, residual, "Residual", "slope" if not deep else "log depth per px"))
    if trust is not None:
        panels.append(lambda axis: _draw_trust(axis, trust, plane))
    if jump is not None:
        panels.append(lambda axis: _draw_jump(axis, jump, plane))
    if truth is not None:
        panels.append(lambda axis: _draw_error(axis, plane - planes["truth"], unit))
    return _sheet(panels, plane.shape[0] * pixel_size[1] / (plane.shape[1] * pixel_size[0]), title)


def png_bytes(figure: Figure) -> bytes:
    """The figure as a PNG, the same bytes for the same figure."""
    figure.savefig(buffer := io.BytesIO(), format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _sheet(panels: list[Any], ratio: float, title: str) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = len(panels) if len(panels) <= 3 else math.ceil(len(panels) / 2)
    rows = math.ceil(len(panels) / columns)
    side = min(3.4, 3.4 / ratio)
    size = columns * (side + 0.7), rows * (side * ratio + 0.4) + (0.4 if title else 0)
    figure = Figure(figsize=size, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=14, color=INK, fontweight="bold")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, draw in zip(axes, panels, strict=False):
        draw(axis)
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    return figure


def _check_fields(plane: Plane, gradient: Tensor | None, trust: Tensor | None, jump: Tensor | None) -> None:
    h, w = plane.shape
    for label, field, channels in (("gradient", gradient, (2,)), ("trust", trust, (1, 2)), ("jump", jump, (2,))):
        if field is not None:
            check_real("surface_preview", label, field)
            if tuple(field.shape) not in {(1, c, h, w) for c in channels}:
                needed = " or ".join(f"(1, {c}, {h}, {w})" for c in channels)
                raise ValueError(f"{label}: shape {tuple(field.shape)} given, {needed} is needed")


def _residual(plane: Plane, gradient: Tensor, pixel_size: tuple[float, float]) -> Plane:
    """Root mean square of (A z - v)_e over the edges of each pixel, (H, W); NaN where it has none."""
    inside = torch.from_numpy(np.isfinite(plane))[None, None]
    z = torch.from_numpy(np.nan_to_num(plane))[None, None]
    v, there = edge_slopes(gradient.detach().cpu().double(), inside)
    assert there is not None
    misfit = there * (GradientOperator("forward", pixel_size)(z) - v).square()
    mean = edge_ends(misfit) / edge_ends(there)
    return mean.sqrt()[0, 0].numpy()


def _draw_height(axis: Axes, plane: Plane, quantity: str, unit: str) -> None:
    colors = "viridis" if quantity == "height" else "viridis_r"  # what is near is bright
    _draw_map(axis, plane, quantity.capitalize(), unit, cmap=colors, span=span_of(plane))
    low, high = span_of(plane)
    levels = np.linspace(low, high, 10)[1:-1]
    axis.contour(np.ma.masked_invalid(plane), levels=levels, colors="white", linewidths=0.5, alpha=0.6)


def _draw_map(
    axis: Axes, plane: Plane, name: str, unit: str, *, cmap: str = "magma", span: tuple[float, float] | None = None
) -> None:
    """A map with its colour bar; by default from 0 to what all but one of 200 pixels stay below."""
    values = plane[np.isfinite(plane)]
    span = span or (0.0, float(np.percentile(values, 99.5)) if values.any() else 1.0)
    image = axis.imshow(plane, cmap=cmap, vmin=span[0], vmax=span[1], interpolation="antialiased")
    axis.set_title(name, fontsize=11, color=INK, loc="left")
    bare(axis)
    bar = axis.figure.colorbar(image, ax=axis, shrink=0.85, aspect=22, pad=0.02)
    bar.set_label(unit, color=INK, fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=FAINT, labelsize=8)


def _draw_measured(axis: Axes, slopes: Tensor, plane: Plane, lift: float) -> None:
    draw_normals(axis, slopes, plane, lift, "Measured normals" + (f", slopes x {lift:.3g}" if lift != 1 else ""))
    y, x = np.mgrid[1:-1:64j, -1:1:64j]
    inside = x**2 + y**2 < 1
    ball = np.dstack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))])
    key = axis.inset_axes((1.03, 0.74, 0.24, 0.24))
    key.imshow(np.dstack([(ball + 1) / 2, inside]))
    key.set_title("on a ball", fontsize=8, color=FAINT, pad=2)
    bare(key)


def _draw_trust(axis: Axes, trust: Tensor, plane: Plane) -> None:
    values = trust.detach().cpu().double()[0].mean(0).numpy()
    values = np.where(np.isfinite(plane), values, np.nan)
    _draw_map(axis, values / (np.nanmax(values) or 1.0), "Trust in the slopes", "of the largest", span=(0, 1))


def _draw_jump(axis: Axes, jump: Tensor, plane: Plane) -> None:
    values = np.where(np.isfinite(plane), jump.detach().cpu().double()[0].amax(0).numpy(), np.nan)
    _draw_map(axis, values, "Jumps", "probability", span=(0, 1))


def _draw_error(axis: Axes, error: Plane, unit: str) -> None:
    error = error - np.nanmean(error)
    limit = float(np.nanpercentile(np.abs(error), 99)) or 1.0
    name = f"Error, RMSE {math.sqrt(np.nanmean(error**2)):.3g} {unit}"
    _draw_map(axis, error, name, unit, cmap="RdBu_r", span=(-limit, limit))
