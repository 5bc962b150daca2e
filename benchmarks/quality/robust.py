"""Robust integrators: how many iterations they need, what they cost, and how they stand outliers and jumps.

Each is run to `--reference` iterations; the table tells after how many its objective stays within 1 % of the lowest
value of that run, and what its default settings reach.

    python -m benchmarks.quality.robust [--smoke] [--size 96] [--reference 2000] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchdls
from benchmarks.common.report import markdown_table, results_folder, write_json

SETTLE = ("total_variation", "l1", "huber")
METHODS = ("least_squares", "weighted_least_squares", *SETTLE, "m_estimator", "anisotropic_diffusion", "mumford_shah")


def cases(size: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Slopes and heights: noise alone, noise and outliers, noise and a wall of wrong slopes."""
    tent, vase = (torchdls.SURFACES[s](size, dtype=torch.float64) for s in ("tent", "vase"))
    noisy = torchdls.add_noise(tent.gradient, snr_db=5, generator=torch.Generator().manual_seed(0))
    calm = torchdls.add_noise(vase.gradient, snr_db=25, generator=torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    bad = torch.rand(calm.shape, generator=generator) < 0.05
    outliers = torch.where(bad, calm + 20 * torch.randn(calm.shape, generator=generator, dtype=calm.dtype), calm)
    wall = calm.clone()
    wall[:, 0, size // 6 : -size // 6, size // 2] += 20
    return {
        "noise (Tent, 5 dB)": (noisy, tent.height),
        "outliers (Vase, 5 %)": (outliers, vase.height),
        "wall (Vase)": (wall, vase.height),
    }


def settling(g: Tensor, name: str, reference: int) -> dict[str, float]:
    """Iterations until the objective stays within 1 % of the best of a long run, and the excess of the defaults."""
    method: Any = torchdls.INTEGRATORS[name]
    long = method(n_iter=reference, tol=0).solve(g).objective[0]
    excess = long / long.min() - 1
    late = (excess > 0.01).nonzero()
    default = method().solve(g)
    return {
        "iterations_to_1_percent": int(late.max()) + 1 if len(late) else 0,
        "default_iterations": int(default.iterations[0]),
        "default_excess_percent": 100 * float(default.objective[0, -1] / long.min() - 1),
    }


def measure(g: Tensor, height: Tensor, name: str) -> dict[str, float]:
    start = time.perf_counter()
    found = torchdls.INTEGRATORS[name]()(g)
    return {"seconds": time.perf_counter() - start, "rmse": float(torchdls.rmse(found, height))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="seconds instead of minutes")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--reference", type=int, default=2000)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    size, reference = (16, 50) if arguments.smoke else (arguments.size, arguments.reference)
    out = results_folder(arguments.smoke) if arguments.out is None else arguments.out
    fields = cases(size)
    quality: dict[str, Any] = {
        name: {case: measure(g, height, name) for case, (g, height) in fields.items()} for name in METHODS
    }
    settle: dict[str, Any] = {
        name: {case: settling(g, name, reference) for case, (g, _) in fields.items()} for name in SETTLE
    }
    header = ["", *(f"{case}: RMSE" for case in fields), "seconds"]
    rows = [
        [name, *(row[case]["rmse"] for case in fields), max(r["seconds"] for r in row.values())]
        for name, row in quality.items()
    ]
    text = f"Vase and Tent, {size} x {size}, float64, default settings.\n\n" + markdown_table(header, rows)
    header = ["", "case", f"iterations to 1 % of {reference}", "default iterations", "default: % above"]
    rows = [[name, case, *cell.values()] for name, row in settle.items() for case, cell in row.items()]
    text += "\n" + markdown_table(header, rows)
    write_json(out / "robust.json", size=size, reference=reference, quality=quality, settling=settle)
    (out / "robust.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
