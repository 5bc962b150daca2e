"""What derivatives cost: `python -m benchmarks.speed.gradients` (about three minutes; --smoke for a short run).

Time of the backward pass, or of both passes, over that of a plain forward pass that records nothing, interleaved; and
peak memory over that of the plain forward, each in a process of its own. Writes gradients.json and gradients.md.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.common.report import markdown_table, results_folder, write_json
from benchmarks.common.timing import fresh_process, interleaved, peak_megabytes
from torchdls import DLS, SURFACES, LeastSquares, SoupDIL, Unroll, add_noise

# glibc keeps freed blocks below a moving threshold; a low one makes the resident size follow what is in use.
MALLOC = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}


def field(size: int) -> torch.Tensor:
    surface = SURFACES["peaks"](size)
    return add_noise(surface.gradient, 10, generator=torch.Generator().manual_seed(0))


def disk(size: int) -> torch.Tensor:
    x = torch.linspace(-1, 1, size)
    return (x.square()[:, None] + x.square() < 0.9)[None, None]


def cases(size: int) -> dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], str, float, int]]:
    """Integrator, what is compared with its plain forward, the target, and the side of the field."""
    mask, least_squares = disk(2 * size), LeastSquares()
    fixed = DLS(n_iter=20, tol=0.0, learn="fixed")
    saving = DLS(n_iter=10, tol=0.0, derivative=Unroll(checkpoint=True))
    atom, block = (DLS(n_iter=10, tol=0.0, learner=SoupDIL(order)) for order in ("atom", "block"))
    return {
        "least squares": (least_squares, "backward", 1.2, 4 * size),
        "least squares, mask": (lambda g: least_squares(g, mask), "backward", 1.2, 2 * size),
        "DLS implicit, 20 iterations": (fixed, "backward", 1.0, size),
        "DLS unrolled, paper's order": (atom, "both", 8.0, size),
        "DLS unrolled, block order": (block, "both", 8.0, size),
        "DLS unrolled, checkpoint": (
            saving,
            "both",
            float("nan"),
            size,
        ),
    }


def time_case(run: Callable[[torch.Tensor], torch.Tensor], what: str, g: torch.Tensor, seconds: float) -> float:
    """Median time of `what` over that of the plain forward, in turns."""
    spent: list[float] = []

    def plain() -> None:
        with torch.no_grad():
            run(g)

    def recorded() -> None:
        point, seed = g.clone().requires_grad_(), 1 + 0.1 * g[:, :1]
        start = time.perf_counter()
        height = run(point)
        start = time.perf_counter() if what == "backward" else start
        height.backward(seed)
        spent.append(time.perf_counter() - start)

    times = interleaved({"plain": plain, "recorded": recorded}, seconds)
    return median(spent) / median(times["plain"])


MODES: dict[str, dict[str, Any]] = {
    "plain": {"learner": SoupDIL("block")},
    "unroll": {"learner": SoupDIL("block")},
    "checkpoint": {"learner": SoupDIL("block"), "derivative": Unroll(checkpoint=True)},
    "fixed plain": {"learn": "fixed"},
    "implicit": {"learn": "fixed"},
}


def peak(mode: str, size: int, iterations: int) -> float:
    """Megabytes that one run adds to this process at its peak."""
    torch.set_num_threads(1)
    g = field(size)
    part = g[..., :32, :32].clone().requires_grad_()
    z = DLS(n_iter=2)(part)
    torch.autograd.grad(z, part, torch.ones_like(z))  # the first call of it imports SymPy, 33 MB
    before = peak_megabytes()
    model = DLS(n_iter=iterations, tol=0.0, **MODES[mode])
    if "plain" in mode:
        with torch.no_grad():
            model(g)
    else:
        model(g.requires_grad_()).square().sum().backward()
    return peak_megabytes() - before


def memory(size: int, iterations: int) -> dict[str, float]:
    os.environ.update(MALLOC)
    return {
        mode: float(fresh_process("benchmarks.speed.gradients", "--peak", mode, str(size), str(iterations)).split()[-1])
        for mode in MODES
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--peak", nargs=3)
    options = parser.parse_args()
    if options.peak:
        mode, size, iterations = options.peak
        print(peak(mode, int(size), int(iterations)))
        return
    torch.set_num_threads(1)
    size, seconds, iterations = (32, 0.1, 3) if options.smoke else (128, 8.0, 50)
    rows = []
    used = memory(2 * size, iterations)  # first: a process begins with the peak of the one that starts it
    for name, mode, base, target in (
        ("DLS implicit", "implicit", "fixed plain", 1.5),
        ("DLS unrolled, checkpoint", "checkpoint", "plain", 2.0),
        ("DLS unrolled", "unroll", "plain", float("nan")),
    ):
        what = f"memory / forward, {iterations} iterations"
        rows.append([name, f"{2 * size} x {2 * size}", what, used[mode] / max(used[base], 0.1), target])
        print(*rows[-1], flush=True)
    for name, (run, what, target, side) in cases(size).items():
        ratio = time_case(run, what, field(side), seconds)
        rows.append([name, f"{side} x {side}", f"{what} / forward", ratio, target])
        print(*rows[-1], flush=True)
    folder = options.out or results_folder(options.smoke)
    write_json(folder / "gradients.json", rows=rows, megabytes=used)
    table = markdown_table(["", "size", "measured", "ratio", "target"], rows).replace("nan", "")
    (folder / "gradients.md").write_text(table)


if __name__ == "__main__":
    main()
