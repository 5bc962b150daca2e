"""Times of the direct integrators beside a SciPy cosine-transform solve of the same field, taken in turns.

    python -m benchmarks.speed.compare_classic            # 256^2 and 512^2, float64 and float32, one thread
    python -m benchmarks.speed.compare_classic --smoke    # does it run?

Writes compare_classic.json and compare_classic.md. The methods take turns, A B C A B C .., and the median of each is
kept, so that a busy machine slows all of them alike. What a method keeps per size (eigenvectors, eigenvalues) is built
before the clock starts, for SciPy too; the first call is timed on its own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import scipy.fft
import torch

from benchmarks.common.report import markdown_table, results_folder, write_json
from benchmarks.common.timing import interleaved
from torchdls import (
    FrankotChellappa,
    HarkerOLeary,
    LeastSquares,
    LineIntegral,
    SpectralRegularization,
    TikhonovRegularization,
)

METHODS: dict[str, torch.nn.Module] = {
    "LeastSquares": LeastSquares(),
    'LeastSquares("dirichlet")': LeastSquares(boundary="dirichlet"),
    "FrankotChellappa": FrankotChellappa(),
    "LineIntegral": LineIntegral(),
    "HarkerOLeary": HarkerOLeary(),
    "SpectralRegularization": SpectralRegularization(),
    "TikhonovRegularization": TikhonovRegularization(),
}


def scipy_poisson(gradient: np.ndarray) -> Callable[[], np.ndarray]:
    """Simchony's least squares by SciPy: the divergence of the averaged slopes, two cosine transforms, one division."""
    p, q = gradient
    h, w = p.shape
    rows, columns = (4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2 for n in (h, w))
    eigenvalues = np.add.outer(rows, columns).astype(p.dtype)
    eigenvalues[0, 0] = np.inf

    def run() -> np.ndarray:
        x, y = (p[:, :-1] + p[:, 1:]) / 2, (q[:-1] + q[1:]) / 2
        b = np.zeros_like(p)
        b[:, :-1] -= x
        b[:, 1:] += x
        b[:-1] -= y
        b[1:] += y
        return scipy.fft.idctn(scipy.fft.dctn(b, norm="ortho") / eigenvalues, norm="ortho")

    return run


def measure(n: int, dtype: torch.dtype, duration: float) -> list[dict[str, Any]]:
    g = torch.randn(1, 2, n, n, generator=torch.Generator().manual_seed(0), dtype=dtype)
    poisson = scipy_poisson(g[0].numpy())
    difference = float((METHODS["LeastSquares"](g)[0, 0] - torch.from_numpy(poisson())).abs().max())
    first = {}
    for name, method in METHODS.items():
        began = time.perf_counter()
        method(g)
        first[name] = time.perf_counter() - began
    runs: dict[str, Callable[[], Any]] = {"SciPy": poisson}
    runs |= {name: (lambda m=method: m(g)) for name, method in METHODS.items()}
    seconds = {name: median(times) for name, times in interleaved(runs, duration).items()}
    print(f"{n} x {n}, {dtype}: LeastSquares and SciPy differ by {difference:.1e}", flush=True)
    return [
        {
            "size": n,
            "dtype": str(dtype).removeprefix("torch."),
            "method": name,
            "ms": 1e3 * seconds[name],
            "ratio": seconds[name] / seconds["SciPy"],
            "first_ms": 1e3 * first[name] if name in first else None,
        }
        for name in runs
    ]


def table(rows: list[dict[str, Any]]) -> str:
    header = ["size", "dtype", "method", "ms", "times SciPy", "first call, ms"]
    cells = [
        [r["size"], r["dtype"], r["method"], f"{r['ms']:.2f}", f"{r['ratio']:.2f}", f"{r['first_ms'] or 0:.0f}"]
        for r in rows
    ]
    return markdown_table(header, cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one small size, a short time: does it run?")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512])
    parser.add_argument("--seconds", type=float, default=6.0, help="time for each size and type")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder for the results")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    sizes, duration = ([48], 0.1) if args.smoke else (args.sizes, args.seconds)
    with torch.no_grad():
        rows = [row for n in sizes for dtype in (torch.float64, torch.float32) for row in measure(n, dtype, duration)]
    out = args.out or results_folder(args.smoke)
    path = write_json(out / "compare_classic.json", rows=rows)
    (out / "compare_classic.md").write_text(table(rows))
    print(table(rows))
    print(f"written: {path}")


if __name__ == "__main__":
    main()
