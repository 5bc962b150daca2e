"""Several surfaces side by side under one light, with the maps of their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchdls._files import require
from torchdls.metrics import describe
from torchdls.plot.relief import (
    FAINT,
    INK,
    Plane,
    bare,
    check_slopes,
    draw_normals,
    draw_relief,
    lift_of,
    planes_of,
    span_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLORS = ("#d1495b", "#00798c", "#edae49", "#66507a", "#3d7a3d")


def compare_heights(
    truth: Tensor | None,
    heights: Mapping[str, Tensor],
    *,
    mask: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    title: str = "",
    data_range: float | None = None,
    gradient: Tensor | None = None,
    measured: Tensor | None = None,
    unit: str = "px",
) -> Figure:
    """Hillshades side by side under the same light; below them the measured slopes and the maps of the error.

    All hillshades share their light, their colours of height and a vertical factor that brings the root mean square
    slope of the first to 1/2; all error maps share their scale (the 99th percentile of the largest). The measured
    slopes are shown as a normal map; without them there is a cross-section. Without a truth there are no errors.

    Args:
        truth: (1, 1, H, W), or None.
        heights: name -> (1, 1, H, W).
        mask: (1, 1, H, W) bool; pixels outside are left blank.
        pixel_size: (dx, dy).
        title: a line above everything.
        data_range: for the SSIM; without it the SSIM is left out.
        gradient: true slopes (1, 2, H, W) for the angular error; default: those of `truth`.
        measured: the slopes (1, 2, H, W) that were integrated.
        unit: of the heights, for the labels.

    Raises:
        TypeError: a field is not float32 or float64, or the mask is not bool.
        ValueError: there is no height, or the shapes differ.
        ImportError: matplotlib is missing.

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> heights = {"least squares": torchdls.LeastSquares()(surface.gradient)}
        >>> figure = torchdls.compare_heights(surface.height, heights, measured=surface.gradient)
        >>> type(figure).__name__
        'Figure'
    """
    require("matplotlib", "plots")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    planes = planes_of(truth, heights, mask)
    columns, (h, w) = len(planes), next(iter(planes.values())).shape
    for label, slopes in (("gradient", gradient), ("measured", measured)):
        if slopes is not None:
            check_slopes(label, slopes, (h, w))
    ratio = h * pixel_size[1] / (w * pixel_size[0])
    side = min(3.6, 3.6 / ratio)
    figure = Figure(figsize=(columns * side + 0.9, side * ratio * 1.9 + 1.5), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    engine: Any = figure.get_layout_engine()
    engine.set(w_pad=0.06, h_pad=0.06, wspace=0.02, hspace=0.02)
    axes = figure.subplots(2, columns, squeeze=False, height_ratios=[1, 0.9])
    if title:
        figure.suptitle(title, fontsize=15, color=INK, fontweight="bold")
    options: Any = {"data_range": data_range, "gradient": gradient, "mask": mask, "pixel_size": pixel_size}
    span, lift = span_of(next(iter(planes.values()))), lift_of(next(iter(planes.values())), pixel_size)
    for axis, (name, plane) in zip(axes[0], planes.items(), strict=True):
        note = ""
        if truth is not None and name in heights:
            note = _caption(describe(heights[name], truth, **options), unit)
        draw_relief(axis, plane, (pixel_size[0] / lift, pixel_size[1] / lift), span, name, note)
    if measured is None:
        _draw_section(axes[1, 0], planes, pixel_size, unit)
    else:
        first = next(iter(planes.values()))
        draw_normals(axes[1, 0], measured, first, lift, "The measured slopes, as normals")
    if truth is None:
        for axis in axes[1, 1:]:
            axis.set_visible(False)
    else:
        _draw_errors(figure, list(axes[1, 1:]), planes, unit)
    return figure


def _caption(measures: Mapping[str, float], unit: str) -> str:
    parts = [f"RMSE {measures['rmse']:#.3g} {unit}"]
    if "ssim" in measures:
        parts.append(f"SSIM {measures['ssim']:.3f}")
    return "   ".join([*parts, f"angle {measures['angle']:.1f}°"])


def _draw_section(axis: Axes, planes: Mapping[str, Plane], pixel_size: tuple[float, float], unit: str) -> None:
    first = next(iter(planes.values()))
    row = int(np.isfinite(first).sum(1).argmax()) if np.isnan(first).any() else first.shape[0] // 2
    x = np.arange(first.shape[1]) * pixel_size[0]
    colors = iter(_COLORS * len(planes))
    for name, plane in planes.items():
        truth = name == "Ground truth"
        color = INK if truth else next(colors)
        axis.plot(x, plane[row], label=name, color=color, lw=1.1 if truth else 1.6, zorder=3 if truth else 2)
    axis.set_title(f"Section along row {row}", fontsize=11, color=INK, loc="left")
    axis.set_xlabel(f"x ({unit})", color=INK)
    axis.set_ylabel(f"height ({unit})", color=INK)
    axis.margins(x=0)
    axis.legend(fontsize=8, frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(colors=FAINT, labelsize=8)


def _draw_errors(figure: Figure, axes: Sequence[Axes], planes: Mapping[str, Plane], unit: str) -> None:
    truth = planes["Ground truth"]
    errors = {name: plane - truth for name, plane in planes.items() if name != "Ground truth"}
    limit = max(float(np.nanpercentile(np.abs(error), 99)) for error in errors.values()) or 1.0
    for axis, (name, error) in zip(axes, errors.items(), strict=True):
        image = axis.imshow(error, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="antialiased")
        axis.set_title(f"Error of {name}", fontsize=11, color=INK, loc="left")
        bare(axis)
    bar = figure.colorbar(image, ax=axes, location="right", shrink=0.9, aspect=25, pad=0.01)
    bar.set_label(f"height error ({unit})", color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=FAINT, labelsize=8)
