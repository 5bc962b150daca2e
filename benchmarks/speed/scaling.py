"""How time and memory grow: `python -m benchmarks.speed.scaling` (some minutes; add --smoke, or --largest 1024).

Each point is a process of its own, so that its peak memory is its own. Prints the fitted exponent of time in pixels
(from 128^2 to 2048^2), draws docs/scaling.png and says so in docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.common.report import made_by, replace_section, results_folder, write_json
from benchmarks.common.timing import fresh_process, peak_megabytes
from torchdls import DLS, add_noise
from torchdls.surfaces import SURFACES


def point(size: int, n: int, iterations: int, threads: int) -> dict[str, Any]:
    """Seconds of an iteration of DLS (median, after the first), and the peak memory of the process beyond its start."""
    torch.set_num_threads(threads)
    surface = SURFACES["tent"](size, dtype=torch.float32)
    noisy = surface.gradient.expand(n, -1, -1, -1)
    g = add_noise(noisy, 10, generator=torch.Generator().manual_seed(0))
    start, ticks = peak_megabytes(), [time.perf_counter()]
    with torch.no_grad():
        DLS(n_iter=iterations, tol=0.0).solve(g, callback=lambda *_: ticks.append(time.perf_counter()))
    steps = [b - a for a, b in pairwise(ticks[1:])]
    codes = 64 * n * math.ceil((size - 8) / 2 + 1) ** 2 * 4 / 2**20
    return {
        "size": size,
        "n": n,
        "iterations": iterations,
        "threads": threads,
        "seconds": median(steps),
        "total": ticks[-1] - ticks[0],
        "megabytes": peak_megabytes() - start,
        "codes_megabytes": codes,
    }


def measured(size: int, n: int = 1, iterations: int = 5, threads: int = 2) -> dict[str, Any]:
    text = fresh_process("benchmarks.speed.scaling", "--point", *map(str, (size, n, iterations, threads)))
    result = json.loads(text.splitlines()[-1])
    print(", ".join(f"{k} {v:.4g}" for k, v in result.items()), flush=True)
    return result


def exponent(points: list[dict[str, Any]], least: int = 128, most: int = 2048) -> float:
    """Least-squares slope of log time over log pixels, from `least` to `most` pixels a side."""
    points = [p for p in points if least <= p["size"] <= most]
    x = torch.tensor([2 * math.log(p["size"]) for p in points], dtype=torch.float64)
    y = torch.tensor([math.log(p["seconds"]) for p in points], dtype=torch.float64)
    return float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())


def draw(curves: dict[str, list[dict[str, Any]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.2), layout="constrained")
    time_axis, memory_axis, batch_axis, total_axis = figure.subplots(1, 4)
    for name in ("pixels, 1 thread", "pixels, 2 threads"):
        pixels = [p["size"] ** 2 for p in curves[name]]
        time_axis.loglog(pixels, [p["seconds"] for p in curves[name]], "o-", label=name.split(", ")[1])
    points = curves["pixels, 2 threads"]
    memory_axis.loglog([p["size"] ** 2 for p in points], [p["megabytes"] for p in points], "o-", label="all")
    memory_axis.loglog([p["size"] ** 2 for p in points], [p["codes_megabytes"] for p in points], "--", label="codes")
    batch = curves["batch of 64 x 64"]
    batch_axis.loglog([p["n"] for p in batch], [1e3 * p["seconds"] / p["n"] for p in batch], "o-")
    total = curves["iterations at 256 x 256"]
    total_axis.plot([p["iterations"] for p in total], [p["total"] for p in total], "o-")
    for axis, x, y in (
        (time_axis, "pixels", "s per iteration"),
        (memory_axis, "pixels", "peak MB"),
        (batch_axis, "surfaces of 64 x 64", "ms per iteration and surface"),
        (total_axis, "iterations at 256 x 256", "s"),
    ):
        axis.set_xlabel(x)
        axis.set_ylabel(y)
        axis.grid(alpha=0.3)
    time_axis.legend()
    memory_axis.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--largest", type=int, default=4096, help="side of the largest surface")
    parser.add_argument("--point", nargs=4, type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.point:
        print(json.dumps(point(*args.point)))
        return
    sizes = [32, 48] if args.smoke else [s for s in (64, 128, 256, 512, 1024, 2048, 4096) if s <= args.largest]
    many = 1 if args.smoke else 2
    curves = {
        "pixels, 1 thread": [measured(s, iterations=3 if s > 1024 else 5, threads=1) for s in sizes],
        "pixels, 2 threads": [measured(s, iterations=3 if s > 1024 else 5, threads=many) for s in sizes],
        "batch of 64 x 64": [measured(64, n=n, threads=many) for n in ((1,) if args.smoke else (1, 4, 16, 64))],
        "iterations at 256 x 256": [
            measured(sizes[-1] if args.smoke else 256, iterations=k, threads=many)
            for k in ((3,) if args.smoke else (3, 10, 30))
        ],
    }
    slopes = {name: exponent(curves[name], 32 if args.smoke else 128) for name in list(curves)[:2]}
    for name, slope in slopes.items():
        print(f"{name}: time grows as pixels^{slope:.2f}")
    folder = results_folder(args.smoke)
    write_json(folder / "scaling.json", exponents=slopes, curves=curves)
    root = Path(__file__).resolve().parents[2]
    draw(curves, folder / "scaling.png" if args.smoke else root / "docs" / "scaling.png")
    if not args.smoke:
        replace_section(root / "docs" / "results.md", "scaling", summary(curves["pixels, 2 threads"], slopes))


def summary(points: list[dict[str, Any]], slopes: dict[str, float]) -> str:
    """What docs/results.md says of it."""
    largest = points[-1]
    share = largest["megabytes"] / largest["codes_megabytes"]
    growth = " and ".join(f"pixels^{slope:.2f} ({name.split(', ')[1]})" for name, slope in slopes.items())
    return (
        f"![Time and memory of DLS](docs/scaling.png)\n\n{made_by('benchmarks.speed.scaling')}\n"
        f"An iteration takes time in proportion to {growth}. At "
        f"{largest['size']} x {largest['size']} it takes {largest['seconds']:.1f} s, and the whole run "
        f"{largest['megabytes'] / 1024:.1f} GB: {share:.1f} times the codes."
    )


if __name__ == "__main__":
    main()
