"""Folders of maps: `python -m benchmarks.speed.batch` (some minutes; --smoke, or --only NAME).

Measures, on whatever else the machine does, in turns:

- ranks: maps of six sizes by `torchdls batch`, one process against two, seconds from the first map to the last.
- batched: 64 x 64 maps by least squares, from the tensor and from the file, against one call for each in one process.
- waiting: two processes of two threads, with threads that wait asleep (OMP_WAIT_POLICY=PASSIVE) and as they come.
- bookkeeping: what finding a map, its claim and its line in the report cost.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.common.report import results_folder, write_json
from torchdls import LeastSquares, gradient_to_normals, integrate_many
from torchdls.batch import Claims, Report, find_maps, plan
from torchdls.cli import main as torchdls
from torchdls.surfaces import SURFACES

ROOT = Path(__file__).resolve().parents[2]
SIX = [(24, 24), (32, 32), (40, 30), (48, 48), (56, 40), (64, 64)]


def write_maps(folder: Path, count: int, sizes: list[tuple[int, int]]) -> list[torch.Tensor]:
    """Noisy normal maps as pictures, and their slopes."""
    folder.mkdir(parents=True)
    found = []
    for k in range(count):
        h, w = sizes[k % len(sizes)]
        g = SURFACES["peaks"](max(h, w), dtype=torch.float32).gradient[..., :h, :w] * (0.4 + 0.1 * (k % 5))
        g = g + 0.05 * torch.randn(g.shape, generator=torch.Generator().manual_seed(k))
        normals = gradient_to_normals(g)[0].permute(1, 2, 0).numpy()
        Image.fromarray(np.rint((normals + 1) / 2 * 255).astype(np.uint8)).save(folder / f"{k:05d}.png")
        found.append(g)
    return found


def run_ranks(source: Path, out: Path, world: int, options: list[str]) -> float:
    """Seconds from the first result to the last: the start of Python and PyTorch, some seconds, is left out."""
    command = [sys.executable, "-m", "torchdls", "batch", str(source), "--out", str(out), "--quiet", *options]
    ranks = [
        subprocess.Popen(command, cwd=ROOT, env=os.environ | {"RANK": str(k), "WORLD_SIZE": str(world)})
        for k in range(world)
    ]
    assert [rank.wait() for rank in ranks] == [0] * world
    times = sorted(path.stat().st_mtime for path in out.glob("*.npz"))
    return times[-1] - times[0]


def ranks(smoke: bool, scratch: Path) -> dict[str, Any]:
    count, repeats = (12, 1) if smoke else (2000, 1)
    write_maps(scratch / "six", count, SIX)
    rows: dict[str, Any] = {"maps": count}
    methods = {"least_squares": ["--method", "least_squares"], "slope_dls": ["--set", "recipe=quick"]}
    for method, options in methods.items():
        seconds: dict[int, list[float]] = {1: [], 2: []}
        for repeat in range(repeats):
            for world in seconds:
                out = scratch / f"{method}-{repeat}-{world}"
                seconds[world].append(run_ranks(scratch / "six", out, world, options))
                print(f"{method}: {world} ranks {seconds[world][-1]:.1f} s", flush=True)
        rows[method] = {"seconds": seconds, "gain": median(seconds[1]) / max(median(seconds[2]), 1e-9)}
    return rows


def per_map(run: Callable[[], Any], count: int, repeats: int) -> float:
    """Milliseconds for each map, the least of some runs: the neighbours on the machine only add to it."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times) / count


def batched(smoke: bool, scratch: Path) -> dict[str, Any]:
    torch.set_num_threads(1)
    count, repeats = (4, 1) if smoke else (320, 5)
    slopes = write_maps(scratch / "small", count, [(64, 64)])
    files = [str(path) for path in sorted((scratch / "small").iterdir())]
    integrator, out = LeastSquares(), str(scratch / "small-out")
    (scratch / "single").mkdir()
    quiet = ["--quiet", "--force", "--method", "least_squares"]

    def one_by_one() -> None:
        with torch.no_grad():
            for g in slopes:
                integrator(g)

    def command() -> None:
        for path in files:
            torchdls(["integrate", path, "-o", str(scratch / "single" / f"{Path(path).stem}.npy"), *quiet])

    loops = {
        "solver, one by one": one_by_one,
        "solver, integrate_many": lambda: list(integrate_many(slopes, integrator)),
        "files, integrate": command,
        "files, batch": lambda: torchdls(["batch", *files, "--out", out, "--format", "npy", "--workers", "0", *quiet]),
    }
    found = {name: per_map(run, count, repeats) for name, run in loops.items()}
    return {
        "ms": found,
        "gain of the solver": found["solver, one by one"] / found["solver, integrate_many"],
        "gain of files": found["files, integrate"] / found["files, batch"],
    }


_THREADS = """
import time, torch, torchdls
torch.set_num_threads(2)
g = torch.randn(1, 2, 512, 512)
run = torchdls.LeastSquares()
run(g)
start = time.perf_counter()
for _ in range({n}):
    run(g)
print((time.perf_counter() - start) / {n})
"""


def waiting(smoke: bool, scratch: Path) -> dict[str, Any]:
    n, repeats = (1, 1) if smoke else (30, 3)
    times: dict[str, list[float]] = {}
    for _ in range(repeats):
        for processes in (1, 2):
            for policy in ("PASSIVE", ""):
                clean = {k: v for k, v in os.environ.items() if not k.startswith("OMP")}
                environment = clean | ({"OMP_WAIT_POLICY": policy} if policy else {})
                command = [sys.executable, "-c", _THREADS.format(n=n)]
                started = [
                    subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT)
                    for _ in range(processes)
                ]
                found = [float(process.communicate()[0]) for process in started]
                times.setdefault(f"{processes} of 2 threads, {policy or 'as it comes'}", []).append(max(found))
    return {name: 1e3 * median(found) for name, found in times.items()}


def bookkeeping(smoke: bool, scratch: Path) -> dict[str, Any]:
    count = 20 if smoke else 5000
    folder = scratch / "many"
    folder.mkdir()
    for k in range(count):
        (folder / f"{k:06d}.png").touch()
    start = time.perf_counter()
    jobs = plan(find_maps([str(folder)]), "out", [".npz"])
    planned = time.perf_counter()
    with Claims(scratch / "state") as claims, Report(scratch / "report.jsonl") as report:
        for job in jobs:
            claims.take(job.name, lambda: False)
            claims.succeed(job.name)
        claimed = time.perf_counter()
        for job in jobs:
            report.line(status="done", input=job.source.path, output=list(job.outputs))
        told = time.perf_counter()
    spans = {"plan": planned - start, "claim": claimed - planned, "report": told - claimed}
    return {name: 1e6 * span / count for name, span in spans.items()}


PARTS = {"batched": batched, "ranks": ranks, "waiting": waiting, "bookkeeping": bookkeeping}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few maps, to see that it runs")
    parser.add_argument("--only", choices=PARTS, action="append", help="one part; may be repeated")
    args = parser.parse_args()
    folder = results_folder(args.smoke)
    stored = folder / "batch.json"
    found = json.loads(stored.read_text())["parts"] if stored.exists() and not args.smoke else {}
    for name in args.only or PARTS:
        with tempfile.TemporaryDirectory() as scratch:
            found[name] = PARTS[name](args.smoke, Path(scratch))
        print(name, json.dumps(found[name], indent=2), flush=True)
    write_json(stored, parts=found)


if __name__ == "__main__":
    main()
