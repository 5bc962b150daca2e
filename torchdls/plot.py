"""Pictures: hillshades of several surfaces under one light, and a page to turn them around in 3-D.

Both return figure objects, made without pyplot, so nothing global changes and no display is needed:
`compare_heights(...).savefig("surfaces.png")`, `Path("surfaces.html").write_text(page_html(surface_page(...)))`.
Needs `pip install 'torchdls[plots]'`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchdls._checks import check_real
from torchdls._files import require
from torchdls.geometry import gradient_to_normals
from torchdls.metrics import describe

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Plane = NDArray[np.float64]
_INK, _FAINT = "#222222", "#8a8a8a"
_EARTH = ["#6f9a9c", "#93b48a", "#cfcb97", "#e2cfae", "#f0e4dc"]  # muted: the light tells the relief
_COLORS = ("#d1495b", "#00798c", "#edae49", "#66507a", "#3d7a3d")


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

    planes = _planes(truth, heights, mask)
    columns, (h, w) = len(planes), next(iter(planes.values())).shape
    ratio = h * pixel_size[1] / (w * pixel_size[0])
    side = min(3.6, 3.6 / ratio)
    figure = Figure(figsize=(columns * side + 0.9, side * ratio * 1.9 + 1.5), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    engine: Any = figure.get_layout_engine()
    engine.set(w_pad=0.06, h_pad=0.06, wspace=0.02, hspace=0.02)
    axes = figure.subplots(2, columns, squeeze=False, height_ratios=[1, 0.9])
    if title:
        figure.suptitle(title, fontsize=15, color=_INK, fontweight="bold")
    options: Any = {"data_range": data_range, "gradient": gradient, "mask": mask, "pixel_size": pixel_size}
    span, lift = _span(next(iter(planes.values()))), _lift(next(iter(planes.values())), pixel_size)
    for axis, (name, plane) in zip(axes[0], planes.items(), strict=True):
        note = ""
        if truth is not None and name in heights:
            note = _caption(describe(heights[name], truth, **options), unit)
        _draw_relief(axis, plane, (pixel_size[0] / lift, pixel_size[1] / lift), span, name, note)
    if measured is None:
        _draw_section(axes[1, 0], planes, pixel_size, unit)
    else:
        _draw_slopes(axes[1, 0], measured, next(iter(planes.values())), lift)
    if truth is None:
        for axis in axes[1, 1:]:
            axis.set_visible(False)
    else:
        _draw_errors(figure, list(axes[1, 1:]), planes, unit)
    return figure


def surface_page(
    heights: Mapping[str, Tensor],
    *,
    mask: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    title: str = "",
    notes: Mapping[str, str] | None = None,
    unit: str = "px",
    max_side: int = 220,
) -> go.Figure:
    """One surface at a time in 3-D, to turn and zoom, with a button for each; the view stays when the surface changes.

    `page_html` makes it a page of about 5 MB that works offline. Every k-th pixel is shown, with k such that no
    side has more than `max_side`: means over blocks would hide the noise. Proportions are true, except that surfaces
    flatter than an eighth of their width are raised to that; the label of the axis says by how much.

    Args:
        heights: name -> (1, 1, H, W).
        mask: (1, 1, H, W) bool; pixels outside are left out.
        pixel_size: (dx, dy).
        title: a line above everything.
        notes: name -> a line about this surface.
        unit: of the heights, for the labels.
        max_side: most samples along a side.

    Raises:
        ValueError: there is no height, the shapes differ, or `max_side` is below 2.
        ImportError: plotly is missing.

    Example:
        >>> page = torchdls.surface_page({"tent": torchdls.SURFACES["tent"](16).height}, title="Tent")
        >>> page.data[0].type
        'surface'
    """
    require("plotly", "plots")
    import plotly.graph_objects as go

    if max_side < 2:
        raise ValueError(f"max_side: {max_side} given, at least 2 is needed")
    planes = _planes(None, heights, mask)
    h, w = next(iter(planes.values())).shape
    step = math.ceil(max(h, w) / max_side)
    x = (np.arange(0, w, step) * pixel_size[0]).astype(np.float32)
    y = (-np.arange(0, h, step) * pixel_size[1]).astype(np.float32)
    first = next(iter(planes.values()))
    low, high = _span(first)
    figure = go.Figure()
    for i, plane in enumerate(planes.values()):
        z = plane[::step, ::step].astype(np.float32)
        figure.add_trace(_plotly_surface(go, x, y, z, (low, high), visible=i == 0, unit=unit))
    names = list(planes)
    lines = [f"<b>{name}</b>   {(notes or {}).get(name, '')}" for name in names]
    buttons = [
        {
            "label": name,
            "method": "update",
            "args": [{"visible": [k == i for k in range(len(names))]}, {"annotations[0].text": lines[i]}],
        }
        for i, name in enumerate(names)
    ]
    spans = [_span(plane) for plane in planes.values()]
    sides = w * pixel_size[0], h * pixel_size[1]
    z_range = min(low for low, _ in spans), max(high for _, high in spans)
    _lay_out(figure, title, lines[0], buttons, sides, z_range, unit)
    return figure


def page_html(page: go.Figure) -> str:
    """The page as one HTML document that fills the window and works offline; the same text for the same figure.

    Example:
        >>> page = torchdls.surface_page({"tent": torchdls.SURFACES["tent"](16).height})
        >>> torchdls.page_html(page)[:15]
        '<!doctype html>'
    """
    html: str = page.to_html(div_id="surface", default_height="100vh", config={"displaylogo": False})
    title = escape(page.layout.title.text or "Surfaces")
    return html.replace("<head>", f"<head><title>{title}</title><style>body {{ margin: 0 }}</style>", 1)


def _plotly_surface(go: Any, x: Any, y: Any, z: Any, span: tuple[float, float], *, visible: bool, unit: str) -> Any:
    lighting = {"ambient": 0.35, "diffuse": 0.85, "specular": 0.05, "roughness": 0.9, "fresnel": 0.02}
    return go.Surface(
        x=x,
        y=y,
        z=z,
        cmin=span[0],
        cmax=span[1],
        colorscale=_EARTH,
        visible=visible,
        lighting=lighting,
        lightposition={"x": -1e5, "y": 1e5, "z": 1e5},
        colorbar={"title": {"text": f"height ({unit})"}, "thickness": 12, "len": 0.5, "outlinewidth": 0},
        hovertemplate="x %{x:.4g}<br>y %{y:.4g}<br>height %{z:.4g}<extra></extra>",
    )


def _lay_out(
    figure: Any,
    title: str,
    line: str,
    buttons: list[dict[str, Any]],
    sides: tuple[float, float],
    z_range: tuple[float, float],
    unit: str,
) -> None:
    width, depth = max(sides), z_range[1] - z_range[0]
    raised = max(1.0, 0.125 * width / depth)
    label = f"height ({unit})" + (f", raised {raised:.3g}x" if raised > 1 else "")
    aspect = {"x": sides[0] / width, "y": sides[1] / width, "z": raised * depth / width}
    scene = {
        "aspectmode": "manual",
        "aspectratio": aspect,
        "xaxis": {"title": {"text": f"x ({unit})"}},
        "yaxis": {"title": {"text": f"y, up ({unit})"}},
        "zaxis": {"title": {"text": label}, "range": list(z_range), "nticks": 4},
        "camera": {"eye": {"x": -0.6, "y": -1.15, "z": 0.85}, "center": {"x": 0, "y": 0, "z": -0.12}},
        "uirevision": "the view stays",
    }
    above = {"showarrow": False, "x": 0.5, "y": 1.0, "xref": "paper", "yref": "paper", "yanchor": "bottom"}
    menu = {"xanchor": "center", "yanchor": "bottom", "pad": {"b": 44}}
    figure.update_layout(
        template="plotly_white",
        title={"text": title, "x": 0.5, "y": 0.975, "yanchor": "top"},
        scene=scene,
        margin={"l": 0, "r": 0, "t": 130, "b": 0},
        font={"family": "system-ui, sans-serif", "color": _INK},
        annotations=[{**above, "text": line, "yshift": 12, "font": {"size": 15}}],
        updatemenus=[{"type": "buttons", "direction": "right", "buttons": buttons, "x": 0.5, "y": 1.0, **menu}],
    )


def _planes(truth: Tensor | None, heights: Mapping[str, Tensor], mask: Tensor | None) -> dict[str, _Plane]:
    """Name -> (H, W) in float64, NaN outside the mask, all moved to the mean level of the first."""
    fields = ({} if truth is None else {"Ground truth": truth}) | dict(heights)
    if not heights:
        raise ValueError("heights: none given, at least one is needed")
    planes: dict[str, _Plane] = {}
    shape = tuple(next(iter(fields.values())).shape[-2:])
    for name, field in fields.items():
        if tuple(field.shape[-2:]) != shape or field.numel() != math.prod(shape) or min(shape) < 2:
            raise ValueError(f"{name}: shape {tuple(field.shape)} given, (1, 1, {shape[0]}, {shape[1]}) is needed")
        planes[name] = field.detach().cpu().double().reshape(shape).numpy().copy()
        if mask is not None:
            planes[name][~mask.cpu().reshape(shape).numpy()] = np.nan
    if not all(np.isfinite(plane).any() for plane in planes.values()):
        raise ValueError("heights: no valid pixel to show")
    level = np.nanmean(next(iter(planes.values())))
    return {name: plane - np.nanmean(plane) + level for name, plane in planes.items()}


def _span(plane: _Plane) -> tuple[float, float]:
    low, high = float(np.nanmin(plane)), float(np.nanmax(plane))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _lift(plane: _Plane, pixel_size: tuple[float, float]) -> float:
    """The factor on heights that brings the root mean square slope to 1/2; 1 for a horizontal plane."""
    zy, zx = np.gradient(plane, pixel_size[1], pixel_size[0])
    slope = float(np.sqrt(np.nanmean(zx**2 + zy**2))) if np.isfinite(zx + zy).any() else 0.0
    return 0.5 / slope if slope > 1e-9 else 1.0


def _caption(measures: Mapping[str, float], unit: str) -> str:
    parts = [f"RMSE {measures['rmse']:#.3g} {unit}"]
    if "ssim" in measures:
        parts.append(f"SSIM {measures['ssim']:.3f}")
    return "   ".join([*parts, f"angle {measures['angle']:.1f}°"])


def _draw_relief(
    axis: Axes, plane: _Plane, pixel_size: tuple[float, float], span: tuple[float, float], name: str, note: str
) -> None:
    import matplotlib as mpl

    shade = hillshade(torch.from_numpy(plane), pixel_size).numpy()
    color = mpl.colormaps["gist_earth"](0.25 + 0.6 * np.clip((plane - span[0]) / (span[1] - span[0]), 0, 1))[..., :3]
    pastel = 0.55 + 0.45 * color  # the relief is told by light; colour only hints at height
    image = np.dstack([pastel * np.clip(0.22 + shade, 0, 1)[..., None], np.isfinite(shade)])
    axis.imshow(np.nan_to_num(image), interpolation="antialiased", aspect=pixel_size[1] / pixel_size[0])
    axis.set_title(name, fontsize=12, color=_INK, loc="left", fontweight="bold")
    if note:
        axis.set_xlabel(note, fontsize=10, color=_INK, loc="left")
    _bare(axis)


def _draw_slopes(axis: Axes, measured: Tensor, first: _Plane, lift: float) -> None:
    slopes = measured.detach().cpu().double().reshape(2, *first.shape) * lift
    normals = gradient_to_normals(slopes).permute(1, 2, 0).numpy()
    axis.imshow(np.nan_to_num(np.dstack([(normals + 1) / 2, np.isfinite(first)])), interpolation="antialiased")
    axis.set_title("The measured slopes, as normals", fontsize=11, color=_INK, loc="left")
    _bare(axis)


def _draw_section(axis: Axes, planes: Mapping[str, _Plane], pixel_size: tuple[float, float], unit: str) -> None:
    first = next(iter(planes.values()))
    row = int(np.isfinite(first).sum(1).argmax()) if np.isnan(first).any() else first.shape[0] // 2
    x = np.arange(first.shape[1]) * pixel_size[0]
    colors = iter(_COLORS * len(planes))
    for name, plane in planes.items():
        truth = name == "Ground truth"
        color = _INK if truth else next(colors)
        axis.plot(x, plane[row], label=name, color=color, lw=1.1 if truth else 1.6, zorder=3 if truth else 2)
    axis.set_title(f"Section along row {row}", fontsize=11, color=_INK, loc="left")
    axis.set_xlabel(f"x ({unit})", color=_INK)
    axis.set_ylabel(f"height ({unit})", color=_INK)
    axis.margins(x=0)
    axis.legend(fontsize=8, frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(colors=_FAINT, labelsize=8)


def _draw_errors(figure: Figure, axes: Sequence[Axes], planes: Mapping[str, _Plane], unit: str) -> None:
    truth = planes["Ground truth"]
    errors = {name: plane - truth for name, plane in planes.items() if name != "Ground truth"}
    limit = max(float(np.nanpercentile(np.abs(error), 99)) for error in errors.values()) or 1.0
    for axis, (name, error) in zip(axes, errors.items(), strict=True):
        image = axis.imshow(error, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="antialiased")
        axis.set_title(f"Error of {name}", fontsize=11, color=_INK, loc="left")
        _bare(axis)
    bar = figure.colorbar(image, ax=axes, location="right", shrink=0.9, aspect=25, pad=0.01)
    bar.set_label(f"height error ({unit})", color=_INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=_FAINT, labelsize=8)


def _bare(axis: Axes) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
