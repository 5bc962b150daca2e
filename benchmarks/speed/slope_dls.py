"""What SlopeDLS takes beside DLS: `python -m benchmarks.speed.slope_dls` (some minutes; add --smoke).

One thread, processor time, candidates in turns in one process, the least of all turns. A point of memory is a process
of its own. Writes JSON and Markdown.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from benchmarks.common.timing import fresh_process, peak_megabytes
from benchmarks.speed.compare import noisy
from torchdls import DLS, LeastSquares, SlopeDLS, _compiled

SHARE = 0.13  # of the image: the disk of the mask


def disk(size: int) -> Tensor:
    """(1, 1, size, size) bool, off the middle."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    return ((x - 0.3).square() + (y + 0.2).square() < SHARE * 4 / math.pi)[None, None]


def least(candidates: dict[str, Callable[[], Any]], turns: int) -> dict[str, float]:
    """Seconds of the processor."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(turns):
        for name, run in candidates.items():
            start = time.process_time()
            run()
            times[name].append(time.process_time() - start)
    return {name: min(seconds) for name, seconds in times.items()}


def _alone(run: Callable[[], Any]) -> None:
    with patch.object(_compiled, "installed", lambda: False):
        run()


def forward(size: int, turns: int) -> dict[str, Any]:
    g, mask, dls = noisy(size, torch.float32), disk(size), DLS(n_iter=15, tol=0.0)
    candidates: dict[str, Callable[[], Any]] = {
        "DLS(15)": lambda: dls(g),
        "DLS(15), PyTorch alone": lambda: _alone(lambda: dls(g)),
        "SlopeDLS": lambda: SlopeDLS()(g),
        "SlopeDLS, PyTorch alone": lambda: _alone(lambda: SlopeDLS()(g)),
        "fast": lambda: SlopeDLS.fast()(g),
        "disk": lambda: SlopeDLS()(g, mask),
        "disk, LeastSquares": lambda: LeastSquares()(g, mask),
    }
    with torch.no_grad():
        return {"size": size, **least(candidates, turns)}


def training(size: int, turns: int) -> dict[str, Any]:
    g = noisy(size, torch.float32).requires_grad_()

    def through(method: Any) -> Callable[[], Any]:
        return lambda: torch.autograd.grad(method(g).square().sum(), g)

    return {"size": size, **least({"SlopeDLS": through(SlopeDLS()), "fast": through(SlopeDLS.fast())}, turns)}


def memory(size: int) -> float:
    """Megabytes beyond what a small call takes, in this process."""
    with torch.no_grad():
        SlopeDLS()(noisy(64, torch.float32))  # loads the compiled loops
        g, start = noisy(size, torch.float32), peak_megabytes()
        SlopeDLS()(g)
    return peak_megabytes() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.memory:
        print(memory(args.memory))
        return
    rows = [forward(n, 2) for n in ((32,) if args.smoke else (96, 256, 512))]
    trained = [training(n, 2) for n in ((24,) if args.smoke else (64,))]
    held = {n: float(fresh_process("benchmarks.speed.slope_dls", "--memory", str(n)).split()[-1])
            for n in ((32, 48) if args.smoke else (512, 1024))}  # fmt: skip
    small, large = held
    further = (held[large] - held[small]) * 1024 / (large**2 - small**2)
    folder = results_folder(args.smoke)
    write_json(folder / "slope_dls_speed.json", forward=rows, training=trained, megabytes=held)
    header = ("size", "DLS(15), s", "PyTorch alone", "SlopeDLS", "PyTorch alone", "fast", "disk", "SlopeDLS / DLS",
              "PyTorch alone", "disk / whole")  # fmt: skip
    lines = []
    for r in rows:
        (dls, alone), (slope, by_pytorch) = ((r[n], r[f"{n}, PyTorch alone"]) for n in ("DLS(15)", "SlopeDLS"))
        ratios = slope / dls, by_pytorch / alone, r["disk"] / slope
        times = dls, alone, slope, by_pytorch, r["fast"], r["disk"]
        lines.append((f"{r['size']}^2", *(f"{x:.2f}" for x in (*times, *ratios))))
    text = (
        f"Seconds of one core; the disk is {SHARE:.0%} of the image:\n\n{markdown_table(header, lines)}\n"
        f"{made_by('benchmarks.speed.slope_dls')}\n"
        + "".join(
            f"Forward and backward at {t['size']}^2 take {t['SlopeDLS']:.2f} s, {t['SlopeDLS'] / t['fast']:.0f} times "
            f"those of `fast`. "
            for t in trained
        )
        + "Memory: "
        + ", ".join(f"{mb:.0f} MB at {n}^2" for n, mb in held.items())
        + f", tables of the noise included: {further:.2f} KB for each further pixel.\n"
    )
    (folder / "slope_dls_speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
