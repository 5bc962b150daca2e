"""A page to turn surfaces around in 3-D."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchdls._files import require
from torchdls.plot.relief import EARTH, INK, planes_of, span_of

if TYPE_CHECKING:
    import plotly.graph_objects as go


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
        heights: name -> (1, 1, H, W), or points (1, 3, H, W) as `depth_to_points` gives, whose third is the height.
        mask: (1, 1, H, W) bool; pixels outside are left out.
        pixel_size: (dx, dy); of no effect on points.
        title: a line above everything.
        notes: name -> a line about this surface.
        unit: of the heights, for the labels.
        max_side: most samples along a side.

    Raises:
        TypeError: a height is not float32 or float64, or the mask is not bool.
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
    places = {name: field for name, field in heights.items() if _is_points(field)}
    planes = planes_of(None, {n: f[..., 2:, :, :] if n in places else f for n, f in heights.items()}, mask)
    h, w = next(iter(planes.values())).shape
    step = math.ceil(max(h, w) / max_side)
    regular = np.arange(w) * pixel_size[0], -np.arange(h) * pixel_size[1]
    x_y = {n: places[n].detach().cpu().reshape(3, h, w)[:2].numpy() if n in places else regular for n in planes}
    low_high = span_of(next(iter(planes.values())))
    figure = go.Figure()
    for i, (name, plane) in enumerate(planes.items()):
        z = plane[::step, ::step].astype(np.float32)
        x, y = (_every(axis, step) for axis in x_y[name])
        figure.add_trace(_plotly_surface(go, x, y, z, low_high, visible=i == 0, unit=unit))
    told = notes or {}
    lines = [f"<b>{name}</b>   {told.get(name, '')}".rstrip() for name in planes]
    if len(lines) == 1 and title and not told:
        lines = [""]  # the title says it all
    buttons = [
        {
            "label": name,
            "method": "update",
            "args": [{"visible": [k == i for k in range(len(planes))]}, {"annotations[0].text": lines[i]}],
        }
        for i, name in enumerate(planes)
    ]
    spans = [span_of(plane) for plane in planes.values()]
    z_range = min(low for low, _ in spans), max(high for _, high in spans)
    sides = [max(_extent(x_y[n][k], planes[n]) for n in planes) for k in (0, 1)]
    _lay_out(figure, title, lines[0], buttons, (sides[0], sides[1]), z_range, unit)
    return figure


def _is_points(field: Tensor) -> bool:
    return isinstance(field, Tensor) and field.ndim > 2 and field.shape[-3] == 3


def _every(axis: Any, step: int) -> Any:
    return axis[(slice(None, None, step),) * axis.ndim].astype(np.float32)


def _extent(axis: Any, plane: Any) -> float:
    """Of a regular axis, its pixels and so the width of the image; of points, that of the finite ones."""
    if axis.ndim == 1:
        return float(abs(axis[1] - axis[0]) * len(axis))
    inside = axis[np.isfinite(plane) & np.isfinite(axis)]
    return float(inside.max() - inside.min()) or 1.0


def page_html(page: go.Figure) -> str:
    """The page as one HTML document that fills the window and works offline; the same text for the same figure.

    The title, the buttons and the line about the surface stand above it as text that breaks into lines, so that a
    narrow window shows all of them, and the surface in what is left.

    Example:
        >>> page = torchdls.surface_page({"tent": torchdls.SURFACES["tent"](16).height})
        >>> torchdls.page_html(page)[:15]
        '<!doctype html>'
    """
    from plotly.graph_objects import Figure

    layout = page.layout
    title = layout.title.text or ""
    buttons = [button for menu in layout.updatemenus for button in menu.buttons]
    line = layout.annotations[0].text if layout.annotations else ""
    bare = Figure(page)
    bare.layout.title, bare.layout.updatemenus, bare.layout.annotations = None, (), ()
    bare.update_layout(margin={"l": 0, "r": 0, "t": 0, "b": 0})
    surface = bare.to_html(div_id="surface", default_height="100%", full_html=False, config=_CONFIG)
    lines = [button.args[1]["annotations[0].text"] for button in buttons]
    row = "".join(f"<button>{escape(button.label)}</button>" for button in buttons) if len(buttons) > 1 else ""
    said = "".join(f"<p{' hidden' if i else ''}>{text}</p>" for i, text in enumerate(lines or [line]))
    return _PAGE.format(title=escape(title or "Surfaces"), heading=escape(title), row=row, said=said, surface=surface)


_CONFIG = {"displaylogo": False, "responsive": True}
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ margin: 0; height: 100vh; display: flex; flex-direction: column }}
body {{ font: 15px system-ui, sans-serif; color: #222 }}
header {{ padding: .6em 1em 0; text-align: center }}
h1 {{ margin: 0 0 .3em; font-size: 1.25em; font-weight: 600; overflow-wrap: anywhere }}
h1:empty {{ display: none }}
p {{ margin: .4em 0 0 }}
button {{ margin: .15em; padding: .3em .7em; font: inherit }}
button {{ background: #fff; border: 1px solid #bbb; border-radius: 4px }}
button.shown {{ background: #e8eef2; border-color: #557 }}
main {{ flex: 1; min-height: 0 }}
main > div {{ height: 100% }}
</style></head>
<body><header><h1>{heading}</h1><nav>{row}</nav>{said}</header>
<main>{surface}</main>
<script>
const buttons = [...document.querySelectorAll("nav button")], lines = document.querySelectorAll("header p");
function show(i) {{
  Plotly.restyle("surface", {{ visible: buttons.map((_, k) => k === i) }});
  buttons.forEach((button, k) => button.classList.toggle("shown", k === i));
  lines.forEach((line, k) => line.hidden = k !== i);
}}
buttons.forEach((button, i) => button.onclick = () => show(i));
if (buttons.length) buttons[0].classList.add("shown");
const box = document.querySelector("main").getBoundingClientRect(), away = Math.max(1, 1.15 * box.height / box.width);
const eye = document.getElementById("surface").layout.scene.camera.eye; // further off where the window is narrow
const moved = {{ x: eye.x * away, y: eye.y * away, z: eye.z * away }};
if (away > 1) Plotly.relayout("surface", {{ "scene.camera.eye": moved }});
</script></body></html>
"""


def _plotly_surface(go: Any, x: Any, y: Any, z: Any, span: tuple[float, float], *, visible: bool, unit: str) -> Any:
    lighting = {"ambient": 0.35, "diffuse": 0.85, "specular": 0.05, "roughness": 0.9, "fresnel": 0.02}
    bar = {"orientation": "h", "x": 0.5, "y": 0.0, "yanchor": "bottom", "thickness": 10, "len": 0.5}
    return go.Surface(
        x=x,
        y=y,
        z=z,
        cmin=span[0],
        cmax=span[1],
        colorscale=EARTH,
        visible=visible,
        lighting=lighting,
        lightposition={
            "x": -1e5,
            "y": 1e5,
            "z": 0,
        },  # seen from the camera; with a z, heights far from 0 lie in the dark
        colorbar={"title": {"text": f"height ({unit})", "side": "top"}, "outlinewidth": 0, "nticks": 5, **bar},
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
    several = len(buttons) > 1
    menus = [{"type": "buttons", "direction": "right", "buttons": buttons, "x": 0.5, "y": 1.0, **menu}]
    figure.update_layout(
        template="plotly_white",
        title={"text": title, "x": 0.5, "y": 0.975, "yanchor": "top"},
        scene=scene,
        margin={"l": 0, "r": 0, "t": 130 if several else 80, "b": 0},
        font={"family": "system-ui, sans-serif", "color": INK},
        annotations=[{**above, "text": line, "yshift": 12, "font": {"size": 15}}],
        updatemenus=menus if several else [],
    )
