"""Folders of maps: `python -m benchmarks.speed.batch` (some minutes; --smoke, or --only NAME).

Measures, in turns, and says how much else the machine does:

- ranks: 2,000 maps of six sizes by `torchdls batch`, one process against two: seconds from the first result to the
  last, and seconds of the cores without the start. To be judged where nothing else runs: `--only ranks`.
- batched: 64 x 64 maps from file to file, `torchdls batch` in one process against `torchdls integrate` called for each
  in one process (by `torchdls.cli.main`, and by the functions behind it), and against reading and writing alone; then
  the solver alone, from the tensor. Time of the core; files in memory where there is such a folder.
- waiting: two processes of two threads, with threads that wait asleep (OMP_WAIT_POLICY=PASSIVE) and as they come.
- bookkeeping: what finding a map, its claim and its line in the report cost.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
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

from benchmarks.common.report import AT_START, results_folder, write_json
from torchdls import LeastSquares, gradient_to_normals, integrate_many
from torchdls.batch import Claims, Manner, Report, Source, find_maps, plan, read_map, write_map
from torchdls.cli import main as torchdls
from torchdls.cli.main import _parser as torchdls_parser
from torchdls.cli.methods import build_method
from torchdls.io.formats import read_file
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


def run_ranks(source: Path, out: Path, world: int, options: list[str]) -> dict[str, float]:
    """Seconds from the first result to the last (the start of Python and PyTorch is left out), and of the cores."""
    command = [sys.executable, "-m", "torchdls", "batch", str(source), "--out", str(out), "--quiet", *options]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ranks = [
        subprocess.Popen(command, cwd=ROOT, env=os.environ | {"RANK": str(k), "WORLD_SIZE": str(world)})
        for k in range(world)
    ]
    assert [rank.wait() for rank in ranks] == [0] * world
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cores = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    times = sorted(path.stat().st_mtime for path in out.glob("*.npz"))
    return {"wall": times[-1] - times[0], "cores": cores}


def ranks(smoke: bool, scratch: Path) -> dict[str, Any]:
    count, repeats = (12, 1) if smoke else (2000, 2)
    write_maps(scratch / "six", count, SIX)
    write_maps(scratch / "two", 2, SIX)
    rows: dict[str, Any] = {"maps": count, "load_before": os.getloadavg()}
    methods = {"slope_dls": ["--set", "recipe=quick"], "least_squares": ["--method", "least_squares"]}
    for method, options in methods.items():
        start = run_ranks(scratch / "two", scratch / f"{method}-start", 1, options)["cores"]
        found: dict[int, list[dict[str, float]]] = {1: [], 2: []}
        for repeat in range(repeats):
            for world, seconds in found.items():
                took = run_ranks(scratch / "six", scratch / f"{method}-{repeat}-{world}", world, options)
                seconds.append(took | {"cores": took["cores"] - world * start})
                print(f"{method}: {world} ranks", seconds[-1], flush=True)
        least = {world: {k: min(s[k] for s in seconds) for k in ("wall", "cores")} for world, seconds in found.items()}
        rows[method] = {"start": start, "seconds": found, "gain": least[1]["wall"] / max(least[2]["wall"], 1e-9)}
        rows[method]["gain of two cores, by their time"] = 2 * least[1]["cores"] / max(least[2]["cores"], 1e-9)
    return rows


def per_map(runs: dict[str, Callable[[], Any]], count: int, repeats: int) -> dict[str, float]:
    """Milliseconds of the core for each map, the least of some rounds in turns: the neighbours only add to it."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.process_time()
            run()
            times[name].append(time.process_time() - start)
    return {name: 1e3 * min(found) / count for name, found in times.items()}


def from_file_to_file(folder: Path, files: list[str], options: list[str], suffix: str) -> dict[str, Callable[[], Any]]:
    """The ways to do all files, each anew every time."""
    out, quiet = folder / "single", ["--quiet", "--force", *options]
    out.mkdir(exist_ok=True)
    arguments = torchdls_parser().parse_args(["integrate", files[0], "-o", "x", *options])
    manner = Manner()

    def command() -> None:
        for path in files:
            torchdls(["integrate", path, "-o", str(out / f"{Path(path).stem}.{suffix}"), *quiet])

    def functions() -> None:
        integrator = build_method(arguments.method, (1.0, 1.0), arguments.set)
        with torch.no_grad():
            for path in files:
                found = read_map(Source(path), manner)
                height = integrator(found.gradient, found.mask, found.weight)
                write_map(out / f"{Path(path).stem}.{suffix}", height, found, overwrite=True)

    def files_alone() -> None:
        for path in files:
            read_file(Path(path), (".png",))
            write_map(out / f"{Path(path).stem}.{suffix}", height, found, overwrite=True)

    def batch() -> None:
        torchdls(["batch", *files, "--out", str(folder / suffix), "--format", suffix, "--workers", "0", *quiet])

    found = read_map(Source(files[0]), manner)
    height = LeastSquares()(found.gradient)
    return {"integrate": command, "its functions": functions, "batch": batch, "reading and writing alone": files_alone}


def batched(smoke: bool, scratch: Path) -> dict[str, Any]:
    torch.set_num_threads(1)
    count, repeats = (4, 1) if smoke else (320, 5)
    slopes = write_maps(scratch / "small", count, [(64, 64)])
    files = [str(path) for path in sorted((scratch / "small").iterdir())]
    integrator = LeastSquares()

    def one_by_one() -> None:
        with torch.no_grad():
            for g in slopes:
                integrator(g)

    found: dict[str, Any] = {}
    solver = {"one by one": one_by_one, "integrate_many": lambda: list(integrate_many(slopes, integrator))}
    found["least_squares, solver"] = per_map(solver, count, repeats)
    few = 2 if smoke else 16
    for name, options, suffix, most in (
        ("least_squares, NPY", ["--method", "least_squares"], "npy", count),
        ("least_squares, NPZ", ["--method", "least_squares"], "npz", count),
        ("slope_dls, recipe=quick, NPZ", ["--set", "recipe=quick"], "npz", few),
        ("slope_dls, NPZ", [], "npz", few // 2),
    ):
        (scratch / name).mkdir()
        runs = from_file_to_file(scratch / name, files[:most], options, suffix)
        found[name] = per_map(runs, most, repeats if most == count else 1)
        print(name, found[name], flush=True)
    for times in found.values():
        ways = [times[way] for way in ("integrate", "its functions", "one by one") if way in times]
        times["gain"] = [way / times.get("batch", times.get("integrate_many", way)) for way in ways]
    return found


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
        with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as scratch:
            found[name] = PARTS[name](args.smoke, Path(scratch)) | {"commit": AT_START["commit"]}
        print(name, json.dumps(found[name], indent=2), flush=True)
    write_json(stored, parts=found)


if __name__ == "__main__":
    main()
