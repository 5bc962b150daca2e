"""`torchdls demo`: noisy slopes to surfaces, with pictures."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdls.cli.methods import build_method, run_method

if TYPE_CHECKING:
    from torch import Tensor


def add_demo(commands: Any) -> None:
    """Add the command `demo`."""
    command = commands.add_parser(
        "demo",
        help="noisy slopes of the paper's Tent and of real terrain, by least squares, DLS and SlopeDLS",
        description="Integrate the noisy slopes of the paper's Tent (1 dB) and of real terrain (0 dB) by least "
        "squares, DLS and SlopeDLS; print a table, and write pictures, 3-D pages, meshes and arrays.",
    )
    command.add_argument("--out", default="demo", metavar="DIR", help="folder for the results (default: demo)")
    command.add_argument("--size", type=int, metavar="N", help="side of the surfaces in pixels (default: 200 and 320)")
    command.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    command.add_argument("--quiet", action="store_true", help="no progress bar")
    command.set_defaults(run=_demo)


def _demo(arguments: argparse.Namespace) -> None:
    from torchdls._files import require

    for library, extra in (("matplotlib", "plots"), ("plotly", "plots"), ("trimesh", "files")):
        require(library, extra)  # before the work
    from torchdls.surfaces import SURFACES, terrain

    size = () if arguments.size is None else (arguments.size,)
    surfaces = ("Tent", SURFACES["tent"](*size), 1.0), ("Terrain", terrain(*size, smoothing=2.0), 0.0)
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{'surface':<10}{'SNR':>5}  {'method':<14}{'RMSE':>9}{'SSIM':>8}{'angle':>9}{'seconds':>9}")
    for name, surface, snr in surfaces:
        _demo_surface(arguments, folder, name, surface, snr)
    print("RMSE in pixels, without the constant; angle: mean between the normals and the true ones.")
    print(f"Pictures, 3-D pages, meshes and arrays are in {folder}/")


def _demo_surface(arguments: argparse.Namespace, folder: Path, name: str, surface: Any, snr: float) -> None:
    import torch

    from torchdls import io
    from torchdls.metrics import describe
    from torchdls.noise import add_noise

    noisy = add_noise(surface.gradient, snr, torch.Generator().manual_seed(arguments.seed))
    heights, notes = {}, {}
    for label, method in (("Least squares", "least_squares"), ("DLS", "dls"), ("SlopeDLS", "slope_dls")):
        integrator = build_method(method, (1.0, 1.0))
        start = time.perf_counter()
        with torch.no_grad():
            height = run_method(f"{name}, {label}", integrator, arguments.quiet, noisy).height
        seconds = time.perf_counter() - start
        m = describe(height, surface.height, data_range=surface.data_range, gradient=surface.gradient)
        row = (
            f"{name:<10}{snr:>3.0f}dB  {label:<14}{m['rmse']:>9.4f}{m['ssim']:>8.4f}{m['angle']:>8.2f}°{seconds:>9.2f}"
        )
        print(row, flush=True)
        heights[label] = height
        notes[label] = f"RMSE {m['rmse']:.3f} px, SSIM {m['ssim']:.3f}, angle {m['angle']:.2f}°"
        stem = folder / f"{name.lower()}_{method}"
        extra = {"gradient": noisy[0], "truth": surface.height[0, 0], "snr_db": snr}
        io.save_height(stem.with_suffix(".npz"), height, overwrite=True, **extra)
        io.save_height(stem.with_suffix(".ply"), height, overwrite=True)
    _demo_pictures(folder, name, surface, snr, noisy, heights, notes)


def _demo_pictures(
    folder: Path,
    name: str,
    surface: Any,
    snr: float,
    noisy: Tensor,
    heights: dict[str, Tensor],
    notes: dict[str, str],
) -> None:
    from torchdls._files import atomic_file
    from torchdls.plot import compare_heights, page_html, surface_page

    title = f"{name} from slopes with as much noise as signal" if snr == 0 else f"{name} from slopes at {snr:.0f} dB"
    figure = compare_heights(
        surface.height,
        heights,
        title=title,
        data_range=surface.data_range,
        gradient=surface.gradient,
        measured=noisy,
    )
    with atomic_file(folder / f"{name.lower()}.png", overwrite=True) as file:
        figure.savefig(file, format="png", dpi=110)
    page = surface_page({"Ground truth": surface.height, **heights}, title=title, notes=notes)
    with atomic_file(folder / f"{name.lower()}.html", overwrite=True) as file:
        file.write(page_html(page).encode())
