"""The pictures of the guide: `make pictures` draws them into docs/pictures and says in the pages which commit did."""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

import torchdls
from tests.helpers.examples import write_normal_map, write_photographs
from torchdls._conventions import NORMAL_CONVENTIONS
from torchdls.cli.main import main as torchdls_command
from torchdls.plot.relief import INK, bare, draw_relief, lift_of, planes_of, span_of

DOCS = Path(__file__).resolve().parent
Panels = Mapping[str, tuple[Tensor, str]]  # name -> height (1, 1, H, W), a note below


def seeded(seed: int = 0) -> torch.Generator:
    """Noise that is the same each time."""
    return torch.Generator().manual_seed(seed)


# --- how pictures are drawn ------------------------------------------------------------------------------------------


def figure_of(columns: int, height: float = 3.3) -> tuple[Figure, Any]:
    """A figure of one row."""
    figure = Figure(figsize=(2.7 * columns, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def reliefs(panels: Panels, like: int = -1, mask: Tensor | None = None) -> Figure:
    """Hillshades side by side under one light; light and colours are made for the panel `like`."""
    figure, axes = figure_of(len(panels))
    planes = planes_of(None, {name: height for name, (height, _) in panels.items()}, mask)
    model = [*planes.values()][like]
    lift, span = lift_of(model, (1.0, 1.0)), span_of(model)
    for axis, (name, plane) in zip(axes, planes.items(), strict=True):
        draw_relief(axis, plane, (1 / lift, 1 / lift), span, name, panels[name][1])
        axis.title.set_fontsize(10)
    return figure


def error(height: Tensor, truth: Tensor, mask: Tensor | None = None) -> str:
    """The error as a note."""
    return f"RMSE {float(torchdls.rmse(height, truth, mask)):.3g} px"


def write(path: Path, picture: Figure | Image.Image, width: int = 900) -> None:
    """As a small WebP, at most `width` pixels wide."""
    if isinstance(picture, Figure):
        picture.savefig(buffer := BytesIO(), dpi=100)
        picture = Image.open(buffer)
    picture = picture.convert("RGB")
    if picture.width > width:
        picture = picture.resize((width, picture.height * width // picture.width), Image.Resampling.LANCZOS)
    picture.save(path, "WEBP", quality=82, method=6)


# --- options ---------------------------------------------------------------------------------------------------------


def swept(surface: Any, snr: float, methods: Mapping[str, Any]) -> Figure:
    """The true surface, and what each method makes of noisy slopes."""
    noisy = torchdls.add_noise(surface.gradient, snr, generator=seeded())
    heights = {name: method(noisy) for name, method in methods.items()}
    panels = {name: (z, error(z, surface.height)) for name, z in heights.items()}
    return reliefs(panels | {"true surface": (surface.height, "")})


def dls_figure(values: Mapping[str, dict[str, Any]], n: int) -> Figure:
    """DLS on a pyramid at 5 dB, with the threshold given, so that nothing guards it."""
    surface = torchdls.SURFACES["pyramid"](n)
    sigma = float(torchdls.noise_level(torchdls.add_noise(surface.gradient, 5, generator=seeded())))
    methods = {name: torchdls.DLS(**{"mu": sigma} | told) for name, told in values.items()}
    for name, method in methods.items():
        if "mu" in values[name]:
            method.mu = values[name]["mu"] * sigma
    return swept(surface, 5, methods)


def option_mu(n: int) -> Figure:
    """DLS: the threshold."""
    return dls_figure({"mu = sigma / 4": {"mu": 0.25}, "mu = sigma": {"mu": 1.0}, "mu = 8 sigma": {"mu": 8.0}}, n)


def option_lam(n: int) -> Figure:
    """DLS: the weight of the patches."""
    return dls_figure({f"lam = {lam}": {"lam": lam} for lam in (0.005, 0.5, 50.0)}, n)


def option_stride(n: int) -> Figure:
    """DLS: the step between patches."""
    return dls_figure({f"stride = {stride}": {"stride": stride} for stride in (1, 2, 8)}, n)


def option_n_iter(n: int) -> Figure:
    """DLS: the iterations."""
    return dls_figure({f"n_iter = {count}": {"n_iter": count} for count in (1, 5, 50)}, n)


def option_tau(n: int) -> Figure:
    """SlopeDLS: the threshold, without the guard that gives back what was wrongly taken."""
    method = lambda tau: torchdls.SlopeDLS(recipe="quick", guard=None, tau=tau)  # noqa: E731
    methods = {"tau = 0.2": method(0.2), "tau as it comes": torchdls.SlopeDLS.fast(), "tau = 4": method(4.0)}
    return swept(torchdls.terrain(n, smoothing=2.0), 5, methods)


# --- symptoms --------------------------------------------------------------------------------------------------------


def inside_out(n: int) -> Figure:
    """A DirectX map read as OpenGL, and one whose x and y are both turned."""
    surface = torchdls.SURFACES["peaks"](n)
    normals = torchdls.gradient_to_normals(surface.gradient, "directx")
    read = lambda convention: torchdls.LeastSquares()(torchdls.normals_to_gradient(normals, convention).gradient)  # noqa: E731
    return reliefs({
        "DirectX read as OpenGL": (read("opengl"), "hills along x, pits along y"),
        "both axes turned": (-surface.height, "every hill is a pit"),
        "read as DirectX": (read("directx"), ""),
    })  # fmt: skip


def bowl(n: int) -> Figure:
    """A coin under lamps that stand near, taken for distant ones; and less the slopes of a flat sheet under them."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n),) * 2, indexing="ij")
    edge = torch.sigmoid((0.7 - (x.square() + y.square()).sqrt()) * 25) * 2
    surface = (edge + 0.8 * torch.sin(9 * x) * torch.sin(9 * y) * (edge > 1.9))[None, None]
    slopes = torch.stack(torch.gradient(surface[0, 0], dim=(1, 0)))[None]
    lamps = 3 * torchdls.ring_of_lights(8, 40)  # places, in half widths of the picture
    towards = lamps[:, :, None, None] - torch.stack([x, -y, torch.zeros_like(x)])
    strength = towards / towards.norm(dim=1, keepdim=True) ** 3 * 9

    def seen(gradient: Tensor) -> Tensor:
        images = (strength * torchdls.gradient_to_normals(gradient)).sum(1).clamp(min=0)[None]
        found = torchdls.woodham(images, lamps / 3)
        return torchdls.normals_to_gradient(found.normals).gradient

    coin, sheet = seen(slopes), seen(torch.zeros_like(slopes))
    heights = torchdls.LeastSquares()(coin), torchdls.LeastSquares()(coin - sheet)
    names = "near lamps", "less a flat sheet's slopes", "true surface"
    notes = error(heights[0], surface), error(heights[1], surface), ""
    return reliefs({a: (b, c) for a, b, c in zip(names, (*heights, surface), notes, strict=True)})


def striped(n: int) -> Figure:
    """Line integrals carry the noise of each row along it."""
    surface = torchdls.terrain(n, smoothing=2.0)
    methods = {"line_integral": torchdls.LineIntegral(), "least_squares": torchdls.LeastSquares()}
    return swept(surface, 5, methods)


def occluded(n: int) -> Figure:
    """A ball that touches a sloping wall at its left: to the right its contour stands ever further before the wall."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64),) * 2, indexing="ij")
    inside = x.square() + y.square() < 0.6**2
    ball = (0.6**2 - x.square() - y.square()).clamp(min=1e-3).sqrt()
    slopes = torch.where(inside, torch.stack([-x, -y]) / ball, torch.tensor([-0.6, 0.0]).double()[:, None, None])
    truth = (n - 1) / 2 * torch.where(inside, ball, -0.6 * (x + 0.6))[None, None]
    methods = {"least_squares": torchdls.LeastSquares(), "piecewise": torchdls.Piecewise()}
    heights = {name: method(slopes[None]) for name, method in methods.items()}
    panels = {name: (z, error(z, truth)) for name, z in heights.items()}
    return reliefs(panels | {"true surface": (truth, "")})


def tilted(n: int) -> Figure:
    """A bias of the slopes, and what is left when their mean is taken away."""
    surface = torchdls.terrain(n, smoothing=2.0)
    level = surface.gradient - surface.gradient.mean((2, 3), keepdim=True)
    biased = level + torch.tensor([0.12, -0.06])[:, None, None]
    heights = {"as measured": biased, "less the mean slope": level}
    return reliefs({name: (torchdls.LeastSquares()(g), "") for name, g in heights.items()})


def noisy(n: int) -> Figure:
    """Slopes that were scaled up look cleaner than they are; given the noise of the samples they come out clean."""
    surface = torchdls.terrain(n, smoothing=3.0)
    coarse = torchdls.add_noise(surface.gradient[..., ::2, ::2], 0, generator=seeded())
    up = torch.nn.functional.interpolate(coarse, size=(n, n), mode="bilinear", align_corners=True)
    sigma = float(torchdls.noise_level(coarse))
    methods = {"slopes scaled up twofold": torchdls.SlopeDLS(), "SlopeDLS(sigma=...)": torchdls.SlopeDLS(sigma=sigma)}
    heights = {name: method(up) for name, method in methods.items()}
    panels = {name: (z, error(z, surface.height)) for name, z in heights.items()}
    return reliefs(panels | {"true surface": (surface.height, "")})


# --- conventions -----------------------------------------------------------------------------------------------------


def axes_of_conventions(n: int) -> Figure:
    """A ball as each convention stores its normals, with the axes drawn at its middle."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, 2 * n),) * 2, indexing="ij")
    inside = x.square() + y.square() < 0.98
    gradient = (torch.stack([-x, -y]) / (1 - x.square() - y.square()).clamp(min=0.02).sqrt())[None]
    figure, axes = figure_of(len(NORMAL_CONVENTIONS), 3.0)
    for axis, (name, signs) in zip(axes, NORMAL_CONVENTIONS.items(), strict=True):
        normals = torchdls.gradient_to_normals(gradient, name)[0]
        axis.imshow(np.dstack([((normals + 1) / 2).permute(1, 2, 0).numpy(), inside.numpy()]), extent=(-1, 1, -1, 1))
        draw_axes(axis, signs)
        axis.set_title(name, fontsize=11, color=INK, loc="left", fontweight="bold")
        bare(axis)
    return figure


def draw_axes(axis: Any, signs: Any) -> None:
    """Arrows of x and y of a convention, and whether its z points out of the picture (a dot) or into it (a cross)."""
    places = [(0.62, 0.0), (0.0, 0.62)]  # canonical x and y, on the page
    for canonical, (index, sign) in enumerate(signs[:2]):
        dx, dy = (sign * part for part in places[canonical])
        axis.annotate("", (dx, dy), (0, 0), arrowprops={"arrowstyle": "-|>", "lw": 2, "color": "white"})
        axis.text(1.3 * dx, 1.3 * dy, "xyz"[index], color="white", ha="center", va="center", fontsize=13, weight="bold")
    out = signs[2][1] > 0
    axis.plot(0, 0, "o", ms=13, mfc="none", mec="white", mew=2)
    axis.plot(0, 0, "o" if out else "x", ms=4 if out else 9, color="white", mew=2)
    axis.text(-0.12, -0.14, "z", color="white", ha="right", va="top", fontsize=13, weight="bold")


def gradient_channels(n: int) -> Figure:
    """A hill, its normals, and the two channels of its gradient."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, 2 * n),) * 2, indexing="ij")
    height = 0.5 * n * torch.exp(-(x.square() + y.square()) / 0.2)[None, None]
    dx, dy = torch.gradient(height[0, 0], dim=(1, 0))
    figure, axes = figure_of(4, 2.9)
    hill = height[0, 0].double().numpy()
    draw_relief(axes[0], hill, (1.0, 1.0), span_of(hill), "a hill, z to you", "")
    normals = torchdls.gradient_to_normals(torch.stack([dx, dy])[None])[0]
    axes[1].imshow(((normals + 1) / 2).permute(1, 2, 0).numpy())
    axes[1].set_title("its normals (opengl)", fontsize=10, loc="left", fontweight="bold")
    for axis, slope, name in ((axes[2], dx, "gradient[:, 0] = dz/dx"), (axes[3], dy, "gradient[:, 1] = dz/dy")):
        limit = float(dx.abs().max())
        image = axis.imshow(slope.numpy(), cmap="RdBu_r", vmin=-limit, vmax=limit)
        axis.set_title(name, fontsize=10, loc="left", fontweight="bold")
    figure.colorbar(image, ax=list(axes[2:]), shrink=0.8, label="slope")
    for axis in axes:
        axis.title.set_fontsize(10)
        bare(axis)
    start, end = 0.16 * n, 1.24 * n
    for axis, place, label in ((axes[2], (end, start), "x, columns"), (axes[3], (start, end), "y, rows")):
        axis.annotate("", place, (start, start), arrowprops={"arrowstyle": "-|>", "lw": 1.6, "color": INK})
        axis.text(0.24 * n, 0.4 * n, label, color=INK, fontsize=9)
    return figure


# --- what the tutorial's commands leave ------------------------------------------------------------------------------


def tutorial_map(n: int) -> Image.Image:
    """The preview of the first path."""
    return by_command(lambda folder: write_normal_map(folder, n, noise=0.02), "integrate", "relief")


def tutorial_photographs(n: int) -> Image.Image:
    """The preview of the second path."""
    return by_command(lambda folder: write_photographs(folder, n), "photometric", "photographs")


def by_command(make: Callable[[Path], Any], command: str, name: str) -> Image.Image:
    """A preview that the command line writes of a folder of that name."""
    with tempfile.TemporaryDirectory() as place:
        folder, out = Path(place) / name, Path(place) / "made_preview.png"
        make(folder)
        if torchdls_command([command, str(folder), "-o", str(out), "--quiet"]):
            raise SystemExit(f"torchdls {command} failed")
        with Image.open(out) as picture:
            return picture.copy()


PICTURES: dict[str, tuple[Callable[[int], Figure | Image.Image], int]] = {
    "tutorial_map": (tutorial_map, 192),
    "tutorial_photographs": (tutorial_photographs, 192),
    "option_mu": (option_mu, 96),
    "option_lam": (option_lam, 96),
    "option_stride": (option_stride, 96),
    "option_n_iter": (option_n_iter, 96),
    "option_tau": (option_tau, 128),
    "inside_out": (inside_out, 128),
    "bowl": (bowl, 128),
    "striped": (striped, 128),
    "occluded": (occluded, 97),
    "tilted": (tilted, 128),
    "noisy": (noisy, 128),
    "axes_of_conventions": (axes_of_conventions, 64),
    "gradient_channels": (gradient_channels, 64),
}


def commit() -> str:
    """Where the run starts from."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=DOCS, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def main(arguments: list[str] | None = None) -> None:
    """Draw them all, or those that are named, and bring the lines in the pages up to date."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}")
    parser.add_argument("--out", type=Path, default=DOCS / "pictures", help="folder for the pictures")
    parser.add_argument("--smoke", action="store_true", help="of a quarter of the size, and no line in the pages")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names or PICTURES:
        draw, n = PICTURES[name]
        write(given.out / f"{name}.webp", draw(n // 4 if given.smoke else n))
        print(given.out / f"{name}.webp", flush=True)
        if not given.smoke:
            told(name)


def told(name: str) -> None:
    """Say in every page that shows the picture what made it."""
    for page in DOCS.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        line = re.compile(rf"(!\[[^\]]*\]\(pictures/{name}\.webp\)\n\nMade by `make pictures` at )[0-9a-f]+")
        page.write_text(line.sub(rf"\g<1>{commit()}", text), encoding="utf-8")


if __name__ == "__main__":
    main()
