"""What each photometric method is worth: `python -m benchmarks.quality.photometric` (add --smoke for a smoke run).

Mean angular error of the normals in degrees, on rendered Gaussians and Peaks under two rings of lights, every method by
its defaults: matte surfaces as they are, with cast shadows, with narrow and broad highlights, rough ones (the cosine
to the power of .7), and matte ones with noise of 17 dB, under all lights and under ten. Then what becomes of the
heights under that noise: least squares and SlopeDLS on the normals, and `refine`. Writes JSON and tables.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from torchdls import (
    PHOTOMETRIC,
    SURFACES,
    LeastSquares,
    SlopeDLS,
    cast_shadows,
    gradient_to_normals,
    mean_angular_error,
    normals_to_gradient,
    refine,
    render,
    ring_of_lights,
    rmse,
)
from torchdls.surfaces import Surface

SNR = 17
TEN = ring_of_lights(10)


def scenes(surface: Surface, lights: Tensor, seed: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Kind -> images and lights."""
    n, noise = gradient_to_normals(surface.gradient), torch.Generator().manual_seed(seed)
    return {
        "matte": (render(n, lights), lights),
        "shadows": (render(n, lights, shadow=cast_shadows(surface.height, lights)), lights),
        "narrow highlights": (render(n, lights, highlight=0.5, shininess=60), lights),
        "broad highlights": (render(n, lights, highlight=0.5, shininess=10), lights),
        "rough": (render(n, lights) ** 0.7, lights),
        "noise": (render(n, lights, snr_db=SNR, generator=noise), lights),
        "noise, 10 lights": (render(n, TEN, snr_db=SNR, generator=noise), TEN),
    }


def degrees(found: Tensor, truth: Tensor) -> float:
    """Mean angle between normals."""
    cross, dot = torch.linalg.cross(found, truth, dim=1).norm(dim=1), (found * truth).sum(1)
    return float(torch.rad2deg(torch.atan2(cross, dot)).mean())


def normals(size: int, lights: Tensor, names: list[str]) -> list[list[Any]]:
    """A row for each method: its mean error over the surfaces, scene by scene, and seconds for a stack of images."""
    surfaces = [SURFACES[name](size) for name in names]
    made = [scenes(surface, lights, 9300 + i) for i, surface in enumerate(surfaces)]
    rows: list[list[Any]] = []
    for name in PHOTOMETRIC:
        errors, start = [], time.process_time()
        for kind in made[0]:
            found = [PHOTOMETRIC.find(name)(*scene[kind]).normals for scene in made]
            truth = [gradient_to_normals(s.gradient) for s in surfaces]
            errors.append(sum(map(degrees, found, truth)) / len(found))
        rows.append([name, *errors, (time.process_time() - start) / (len(made) * len(made[0]))])
        print(*rows[-1], flush=True)
    return rows


def heights(size: int, names: list[str]) -> list[list[Any]]:
    """RMSE and angle of heights from ten noisy images, and of `refine` from each."""
    rows: list[list[Any]] = []
    for method in ("woodham", "dlpi", "dlnv"):
        for integrator in (LeastSquares(), SlopeDLS()):
            found: list[tuple[float, float]] = []
            polished: list[tuple[float, float]] = []
            for i, name in enumerate(names):
                surface = SURFACES[name](size)
                images, _ = scenes(surface, TEN, 9300 + i)["noise, 10 lights"]
                slopes = normals_to_gradient(PHOTOMETRIC.find(method)(images, TEN).normals)
                plain = integrator(slopes.gradient)
                for z, into in ((plain, found), (refine(plain, images, TEN).height, polished)):
                    into.append((float(rmse(z, surface.height)), float(mean_angular_error(z, surface.height))))
            means = [sum(x[k] for x in some) / len(some) for some in (found, polished) for k in (0, 1)]
            rows.append([f"{method}, {type(integrator).__name__}", *means])
            print(*rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one small surface, few lights: does it run?")
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    size, count, names = (16, 6, ["peaks"]) if args.smoke else (args.size, 30, ["gaussians", "peaks"])
    lights = torch.cat([ring_of_lights(count, tilt) for tilt in (25.0, 50.0)])
    with torch.no_grad():
        first, second = normals(size, lights, names), heights(size, names)
    out, by = args.out or results_folder(args.smoke), made_by("benchmarks.quality.photometric")
    header = ["method", *scenes(SURFACES["peaks"](4), lights, 0), "seconds each"]
    settings = {"size": size, "lights": len(lights), "snr": SNR, "surfaces": names}
    write_json(out / "photometric.json", settings=settings, header=header, normals=first, heights=second)
    angles = f"Mean angular error of the normals in degrees, {size} x {size}, {len(lights)} lights."
    then = f"Heights from ten images, {SNR} dB: RMSE in pixels and mean angular error in degrees; then `refine`."
    columns = ["normals, surface", "RMSE", "angle", "RMSE, refined", "angle, refined"]
    tables = [markdown_table(c, rows) for c, rows in ((header, first), (columns, second))]
    text = f"# What each photometric method is worth\n\n{angles}\n\n{tables[0]}\n{by}\n{then}\n\n{tables[1]}\n{by}"
    (out / "photometric.md").write_text(text)


if __name__ == "__main__":
    main()
