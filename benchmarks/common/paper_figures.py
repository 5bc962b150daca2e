"""The figures of paper.py."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from torch import Tensor

import torchdls
from torchdls import INTEGRATORS, SURFACES, add_noise
from torchdls.io.formats import read_file
from torchdls.plot import hillshade


def new_figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def default_heights(gradient: Tensor, columns: Mapping[str, str], mask: Tensor | None = None) -> dict[str, Tensor]:
    """The methods of the paper with their default parameters; full rectangles for those that take no mask."""
    heights = {}
    for name, label in columns.items():
        if name in INTEGRATORS:
            method = INTEGRATORS[name]()
            with torch.no_grad():
                heights[label] = method(gradient, mask if "mask" in method.accepts else None)
    return heights


def comparison(path: Path, name: str, snr: int, n: int, row: dict[str, Any], columns: Mapping[str, str]) -> None:
    """The surface and its reconstructions from one noise draw, in perspective and as hillshades."""
    surface = SURFACES[name](n)
    noisy = add_noise(surface.gradient, snr, torch.Generator().manual_seed(snr))
    panels = {"ground truth": surface.height} | default_heights(noisy, columns)
    figure = new_figure(3 * len(panels), 5.4)
    figure.suptitle(f"{name.capitalize()}, {snr} dB, default parameters; in brackets the SSIM at the best of the sweep")
    best = {columns[k]: e["best"]["ssim"]["mean"] for k, e in row["methods"].items()}
    every = max(1, n // 100)
    y, x = np.mgrid[0:n:every, 0:n:every]
    for i, (label, z) in enumerate(panels.items()):
        title = label
        if label in best:
            title += f"  {float(torchdls.ssim(z, surface.height, surface.data_range)):.3f} ({best[label]:.3f})"
        relief = figure.add_subplot(2, len(panels), i + 1, projection="3d")
        relief.plot_surface(
            x, -y, z[0, 0, ::every, ::every].numpy(),
            color="1.0", lightsource=LightSource(200, 40), rcount=100, ccount=100, linewidth=0, antialiased=False,
        )  # fmt: skip
        relief.set_title(title, fontsize=10)
        relief.set_axis_off()
        shade = figure.add_subplot(2, len(panels), len(panels) + i + 1)
        shade.imshow(hillshade(z)[0, 0].numpy(), cmap="gray", vmin=0, vmax=1)
        shade.axis("off")
    figure.savefig(path, dpi=90)


def read_images(folder: Path) -> tuple[Tensor, Tensor, Tensor | None]:
    """Images (1, K, H, W), lights (K, 3), mask or None of a folder as `paper.py --help` describes it."""
    lights = torch.from_numpy(np.loadtxt(folder / "lights.txt", ndmin=2)).float()
    kinds = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in kinds and f.stem != "mask")
    if len(files) != len(lights):
        raise ValueError(f"{folder}: {len(files)} images, but {len(lights)} lines in lights.txt")
    images = [np.asarray(read_file(f, kinds), dtype=np.float32) for f in files]  # 16 bits stay 16 bits
    grey = torch.from_numpy(np.stack([i[..., :3].mean(-1) if i.ndim == 3 else i for i in images]))
    file = folder / "mask.png"
    mask = torchdls.load_mask(file) if file.exists() else None
    return (grey / grey.max())[None], lights, mask


def photometric_figure(path: Path, folder: Path | None, n: int, columns: Mapping[str, str]) -> dict[str, Any]:
    """Figure 3: noise of 17 dB on the images, least-squares normals, each reconstruction and a zoom into it."""
    generator = torch.Generator().manual_seed(0)
    truth: Tensor | None = None
    if folder is None:
        surface = torchdls.terrain(n)
        truth, mask, source = surface.height, None, "terrain"
        slopes = surface.gradient * 3  # the relief of a statue rather than of a landscape
        truth, lights = truth * 3, torchdls.ring_of_lights(10)
        images = torchdls.render(torchdls.gradient_to_normals(slopes), lights)
    else:
        images, lights, mask = read_images(folder)
        source = folder.name
    sigma = images.square().mean().sqrt() * 10 ** (-17 / 20)
    images = images + sigma * torch.randn(images.shape, generator=generator)
    found = torchdls.woodham(images, lights, mask=mask, shadow=None)
    field = torchdls.normals_to_gradient(found.normals)
    mask = field.mask if mask is not None else None
    heights = default_heights(field.gradient, columns, mask)
    if mask is not None:
        heights = {label: torch.where(mask, z, torch.nan) for label, z in heights.items()}
    panels = {"one of the images": images[:, :1]} | ({} if truth is None else {"ground truth": truth}) | heights
    h, w = images.shape[-2:]
    zoom = (slice(h * 3 // 8, h * 5 // 8), slice(w * 3 // 8, w * 5 // 8))
    figure = new_figure(2.6 * len(panels), 5.4)
    figure.suptitle(f"{source}: {len(lights)} images at 17 dB, least-squares normals, default parameters; below: zoom")
    measures: dict[str, Any] = {"source": source}
    for i, (label, z) in enumerate(panels.items()):
        picture = (z if i == 0 else hillshade(z))[0, 0]
        title = label
        if truth is not None and label in heights:
            angle = float(torchdls.mean_angular_error(z, truth))
            measures[label] = {"rmse": float(torchdls.rmse(z, truth)), "angle": angle}
            title += f"  {angle:.1f}°"
        for row, part in enumerate((picture, picture[zoom])):
            axis = figure.add_subplot(2, len(panels), row * len(panels) + i + 1)
            axis.imshow(part.numpy(), cmap="gray", vmin=0, vmax=1)
            axis.set_title("" if row else title, fontsize=10)
            axis.axis("off")
    figure.savefig(path, dpi=90)
    return measures


def sweep_plot(path: Path, curves: Mapping[str, Mapping[str, Any]]) -> None:
    """Gain over least squares against each parameter of DLS, a curve per noise level."""
    figure = new_figure(3.2 * len(curves), 3)
    axes = figure.subplots(1, len(curves), sharey=True)
    for axis, (label, curve) in zip(axes, curves.items(), strict=True):
        for name, gains in curve.items():
            if name != "values":
                axis.plot(curve["values"], gains, marker=".", label=name)
        axis.set_xlabel(label)
        axis.set_xscale("log" if label in ("lam", "iterations") else "linear")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("(1 - SSIM) of DCTLS / of DLS")
    axes[0].legend()
    figure.savefig(path, dpi=90)
