"""What weights are worth: `python -m benchmarks.quality.weights` (add --smoke for a smoke run).

Least squares with the true inverse variances of its noise against least squares without, on every surface under noise
that differs from pixel to pixel in seven ways; then with the confidence of photometric stereo (ten images). A row is a
surface, a pattern and a noise level: the mean RMSE without weights over that with them. Writes JSON with every row and
a Markdown table of geometric means and worst rows.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.report import markdown_table, results_folder, write_json
from torchdls import SURFACES, LeastSquares, Surface, gradient_to_normals, normals_to_gradient, render, ring_of_lights
from torchdls.metrics import mean_angular_error, rmse
from torchdls.noise import noise_sigma
from torchdls.photometric import woodham
from torchdls.surfaces import terrain


def patterns(surface: Surface, generator: torch.Generator) -> dict[str, Tensor]:
    """Standard deviations (1, 1 or 2, H, W) of the noise, up to a factor."""
    h, w = surface.height.shape[-2:]
    across = (torch.arange(w, dtype=torch.float64) / w).expand(1, 1, h, w)

    def waves(channels: int) -> Tensor:
        coarse = torch.randn(1, channels, 4, 4, generator=generator, dtype=torch.float64)
        field: Tensor = torch.nn.functional.interpolate(coarse, (h, w), mode="bicubic")
        return (math.log(5) * field / field.abs().amax((-2, -1), keepdim=True)).exp()

    uniform = torch.rand(2, 1, 1, h, w, generator=generator, dtype=torch.float64)
    steepness = surface.gradient.double().square().sum(1, keepdim=True)
    return {
        "waves of 1:25": waves(1),
        "waves, each component": waves(2),
        "left half 1, right half 8": torch.where(across < 0.5, 1.0, 8.0).double(),
        "1 to 10 across": 1 + 9 * across,
        "each pixel 1:25": (math.log(5) * (2 * uniform[0] - 1)).exp(),
        "a tenth of the pixels 30": torch.where(uniform[1] < 0.1, 30.0, 1.0).double(),
        "1 + 2 slope^2": 1 + 2 * steepness / steepness.mean(),
    }


def gains(surface: Surface, sd: Tensor, snrs: Sequence[int], seeds: Sequence[int]) -> list[float]:
    """RMSE without weights over RMSE with the true ones, per noise level."""
    sd = sd / sd.square().mean().sqrt()
    draws = [
        noise_sigma(surface.gradient, snr)
        * sd
        * torch.randn(surface.gradient.shape, generator=torch.Generator().manual_seed(1009 * seed + snr)).double()
        for snr in snrs
        for seed in seeds
    ]
    gradient = (surface.gradient + torch.cat(draws)).to(surface.height)
    errors = []
    for weight in (None, (1 / sd.square()).to(gradient)):
        height = LeastSquares()(gradient, weight=weight)
        errors.append(rmse(height, surface.height.expand_as(height)).view(len(snrs), -1).mean(1))
    return (errors[0] / errors[1]).tolist()


def photometric(surface: Surface, factor: float, snr: int, seeds: Sequence[int]) -> dict[str, float]:
    """The same with the confidence of normals from ten noisy images; surfaces that face away are left out."""
    lights, truth = ring_of_lights(10), surface.height * factor
    images = render(gradient_to_normals(surface.gradient * factor), lights)
    sigma = images.square().mean().sqrt() * 10 ** (-snr / 20)
    draws = [sigma * torch.randn(images.shape, generator=torch.Generator().manual_seed(1013 * s + snr)) for s in seeds]
    found = woodham(images + torch.cat(draws), lights, shadow=None)
    field = normals_to_gradient(found.normals)
    keep = field.mask.flatten(1).all(1)
    gradient, confidence = field.gradient[keep], found.confidence[keep]
    heights = [LeastSquares()(gradient, weight=w) for w in (None, confidence)]
    measured = [
        torch.stack([m(z, truth.expand_as(z)).mean() for m in (rmse, mean_angular_error)]) for z in heights if len(z)
    ]
    return dict(zip(("rmse", "angle"), (measured[0] / measured[1]).tolist(), strict=True)) if measured else {}


def summary(rows: Sequence[dict[str, Any]], column: str, snrs: Sequence[int]) -> str:
    """Geometric mean and, in brackets, the worst surface of every pattern and level."""
    lines = []
    for pattern in dict.fromkeys(r["pattern"] for r in rows):
        cells = []
        for snr in snrs:
            found = {r["surface"]: r[column] for r in rows if r["pattern"] == pattern and r["snr"] == snr}
            worst = min(found, key=lambda name: found[name])
            mean = math.exp(sum(map(math.log, found.values())) / len(found))
            cells.append(f"{mean:.3f} ({found[worst]:.3f} {worst})")
        lines.append([pattern, *cells])
    return markdown_table([f"gain, {column}", *(f"{s} dB" for s in snrs)], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small surfaces, one draw: does it run?")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--seeds", type=int, default=3, help="noise draws per row")
    parser.add_argument("--first-seed", type=int, default=2600)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    n, names = (24, ["tent", "peaks"]) if args.smoke else (args.size, [*SURFACES, "terrain"])
    snrs, levels = ([10], [17]) if args.smoke else ([1, 5, 10, 20, 30, 40], [17, 25])
    seeds = range(args.first_seed, args.first_seed + (1 if args.smoke else args.seeds))
    rows: list[dict[str, Any]] = []
    stereo: list[dict[str, Any]] = []
    for name in names:
        surface = terrain(n) if name == "terrain" else SURFACES[name](n)
        for pattern, sd in patterns(surface, torch.Generator().manual_seed(args.first_seed)).items():
            found = gains(surface, sd, snrs, seeds)
            rows += [
                {"surface": name, "pattern": pattern, "snr": s, "rmse": g} for s, g in zip(snrs, found, strict=True)
            ]
        for snr in levels:
            measured = photometric(surface, 3.0 if name == "terrain" else 1.0, snr, seeds)
            if measured:
                stereo.append({"surface": name, "pattern": "ten images", "snr": snr, **measured})
        print(name, flush=True)
    out = args.out or results_folder(args.smoke)
    path = write_json(out / "weights.json", settings={"size": n, "seeds": [*seeds]}, rows=rows, photometric=stereo)
    tables = [summary(rows, "rmse", snrs), *(summary(stereo, m, levels) for m in ("rmse", "angle") if stereo)]
    (out / "weights.md").write_text("\n".join(tables))
    print(*tables, f"written: {path}", sep="\n")


if __name__ == "__main__":
    main()
