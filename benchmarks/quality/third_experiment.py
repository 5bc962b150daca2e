"""The paper's third experiment: `python -m benchmarks.quality.third_experiment` (add --smoke for a smoke run).

Ten images with noise of 17 dB, least-squares normals, then every default beside least squares: without weights, with
the confidence of the normals, and with the inverse variances of both components of the slopes; least squares also with
the variances of the true normals, which nobody knows. On real terrain of three times its relief, and two smoother
surfaces. RMSE, mean angular error and 1 - SSIM, means over fresh noise, and in how
many draws each is no worse than least squares without weights: the long waves of the noise scatter much, so that single
draws mislead. Writes JSON and a Markdown table.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from torchdls import (
    DLS,
    SURFACES,
    LeastSquares,
    SlopeDLS,
    gradient_to_normals,
    normals_to_gradient,
    render,
    ring_of_lights,
    slope_noise,
)
from torchdls.metrics import mean_angular_error, rmse, ssim
from torchdls.photometric import woodham
from torchdls.surfaces import terrain

SNR = 17
_TIE = 1e-4  # relative: as good
METHODS = {
    "least squares": LeastSquares(),
    "DLS": DLS(),
    "DLS(select=False)": DLS(select=False),
    "SlopeDLS": SlopeDLS(),
    "SlopeDLS.fast": SlopeDLS.fast(),
}


def rows(name: str, n: int, seeds: range) -> list[dict[str, Any]]:
    """A row for each method, without and with the confidence as a weight."""
    surface, factor = (terrain(n), 3.0) if name == "terrain" else (SURFACES[name](n), 1.0)
    normals = gradient_to_normals(surface.gradient * factor)
    images = render(normals, ring_of_lights(10))
    sigma = images.square().mean().sqrt() * 10 ** (-SNR / 20)
    draws = [sigma * torch.randn(images.shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    found = woodham(images + torch.cat(draws), ring_of_lights(10), shadow=None)
    field = normals_to_gradient(found.normals)
    truth = (surface.height * factor).expand(len(draws), -1, -1, -1)
    noise = slope_noise(found.normals, found.covariance)
    weights = {"none": None, "confidence": found.confidence, "components": noise.weight, "true": true_trust(normals)}
    measured: list[dict[str, Any]] = []
    plain: dict[str, Tensor] = {}
    for label, method in METHODS.items():
        for trust, weight in weights.items():
            if trust == "true" and label != "least squares":
                continue
            with torch.no_grad():
                z = method(field.gradient, None if bool(field.mask.all()) else field.mask, weight)
            values = {
                "rmse": rmse(z, truth),
                "angle": mean_angular_error(z, truth),
                "1-ssim": 1 - ssim(z, truth, surface.data_range * factor),
            }
            plain = plain or values  # least squares without weights comes first
            row = {"surface": name, "method": label, "weight": trust} | {k: float(v.mean()) for k, v in values.items()}
            row |= {f"no worse, {k}": int((v <= plain[k] * (1 + _TIE)).sum()) for k, v in values.items()}
            measured.append(row)
            print(*row.values(), flush=True)
    return measured


def true_trust(normals: Tensor) -> Tensor:
    """Inverse variances of the slopes of unit normals that are known, for equal noise of the images."""
    lights = ring_of_lights(10)
    spread = torch.linalg.inv(lights.mT @ lights)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return slope_noise(normals, spread[None, :, None, None].expand(1, -1, *normals.shape[-2:])).weight


def table(found: list[dict[str, Any]], seeds: range) -> str:
    """The page of results."""
    header = ["surface", "method", "weight", "RMSE", "angle (degrees)", "1 - SSIM", "no worse"]
    rows = [[*list(row.values())[:6], " / ".join(map(str, list(row.values())[6:]))] for row in found]
    text = (
        f"Ten images, {SNR} dB. Means of {len(seeds)} draws; the last column counts the draws in which RMSE, angle and "
        "SSIM are no worse than those of least squares without weights.\n\n"
    )
    return f"# The paper's third experiment\n\n{text}{markdown_table(header, rows)}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small surfaces, one draw: does it run?")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--seeds", type=int, default=8, help="noise draws per row")
    parser.add_argument("--first-seed", type=int, default=8400)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    n, count = (32, 1) if args.smoke else (args.size, args.seeds)
    seeds = range(args.first_seed, args.first_seed + count)
    found = [row for name in ("terrain", "peaks", "gaussians") for row in rows(name, n, seeds)]
    out = args.out or results_folder(args.smoke)
    path = write_json(out / "third_experiment.json", settings={"size": n, "snr": SNR, "seeds": [*seeds]}, rows=found)
    made = made_by("benchmarks.quality.third_experiment")
    (out / "third_experiment.md").write_text(table(found, seeds) + made)
    print(f"written: {path}")


if __name__ == "__main__":
    main()
