"""Quality of DLS on the surfaces of the paper: `python -m benchmarks.quality.dls` (add --smoke for a smoke run).

Tent and Vase at 200 x 200 under white noise, several draws each: least squares, DLS with its default parameters, and
DLS with the best fixed threshold of a sweep, beside the columns of the paper. `--quick` leaves the sweep out and adds
DLS with its slow waves shrunk and SlopeDLS, up to 20 dB (slow_waves.md). `--trials` measures single changes to the
algorithm. All noise draws of a surface run as one batch. Writes JSON and a Markdown table; docs/results.md quotes the
table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from torchdls import DLS, SURFACES, LeastSquares, Proximal, SlopeDLS, SoupDIL, add_noise, noise_level, shrink_slow_waves
from torchdls.metrics import mean_angular_error, rmse, ssim
from torchdls.noise import noise_sigma

SNRS = (1, 5, 10, 20, 30, 40, 50, 60)
# SSIM as printed in tables 1 and 2 of the paper (Wagenmaker, Moore, Nadakuditi 2017), for SNRS.
PAPER = {
    "tent": {
        "dls": (0.969, 0.971, 0.976, 0.988, 0.995, 0.997, 0.998, 0.999),
        "dctls": (0.924, 0.944, 0.962, 0.983, 0.992, 0.996, 0.998, 0.998),
    },
    "vase": {
        "dls": (0.958, 0.966, 0.971, 0.977, 0.982, 0.990, 0.993, 0.995),
        "dctls": (0.894, 0.915, 0.936, 0.966, 0.981, 0.989, 0.992, 0.993),
    },
}
SWEEP = (1.0, 1.25, 1.5, 2.0, 2.5, 3.5, 5.0)  # thresholds mu, in units of the noise of one gradient sample
TRIALS: dict[str, dict[str, Any]] = {
    "paper's set-up (reference)": {},
    "block order": {"learner": SoupDIL("block")},
    "2 sweeps per iteration": {"learner": SoupDIL(n_sweeps=2)},
    "4 sweeps per iteration": {"learner": SoupDIL(n_sweeps=4)},
    "proximal z-step, 1 step": {"height_step": Proximal()},
    "proximal z-step, 3 steps": {"height_step": Proximal(3)},
    "proximal z-step, 10 steps": {"height_step": Proximal(10)},
    "unused atoms kept": {"learner": SoupDIL(unused="keep")},
    "stride 1": {"stride": 1},
    "stride 4": {"stride": 4},
    "lam = 0.1": {"lam": 0.1},
    "lam = 2": {"lam": 2.0},
    "30 iterations": {"n_iter": 30},
    "300 iterations": {"n_iter": 300},
    "144 atoms": {"n_atoms": 144},
    "12 x 12 patches, 144 atoms": {"patch_size": 12, "n_atoms": 144},
    "fixed DCT dictionary": {"learn": "fixed"},
}


class Case:
    """A surface under several noise levels and draws, as one batch (levels times draws, level by level)."""

    def __init__(self, name: str, snrs: Sequence[int], seeds: Sequence[int], n: int) -> None:
        self.surface = SURFACES[name](n)
        self.name, self.snrs, self.seeds = name, tuple(snrs), tuple(seeds)
        clean = self.surface.gradient
        draws = [add_noise(clean, s, torch.Generator().manual_seed(1000 * k + s)) for s in snrs for k in seeds]
        self.gradient = torch.cat(draws)
        self.sigma = torch.cat([noise_sigma(clean, s) for s in snrs for _ in seeds])

    def measures(self, height: Tensor) -> dict[str, Tensor]:
        """Each measure as (levels, draws)."""
        truth = self.surface.height.expand_as(height)
        found = {
            "ssim": ssim(height, truth, self.surface.data_range),
            "rmse": rmse(height, truth),
            "angle": mean_angular_error(height, truth),
        }
        return {k: v.view(len(self.snrs), -1) for k, v in found.items()}


def gains(method: dict[str, Tensor], reference: dict[str, Tensor]) -> dict[str, list[float]]:
    """Mean error of the reference over the mean error of the method, per noise level."""
    return {
        "1-ssim": ((1 - reference["ssim"]).mean(1) / (1 - method["ssim"]).mean(1)).tolist(),
        "rmse": (reference["rmse"].mean(1) / method["rmse"].mean(1)).tolist(),
        "angle": (reference["angle"].mean(1) / method["angle"].mean(1)).tolist(),
    }


def run_table(case: Case, n_iter: int, sweep: Sequence[float]) -> list[dict[str, Any]]:
    """Least squares, DLS as it comes, and DLS at the best threshold of the sweep (chosen on the same draws)."""
    start = case.measures(LeastSquares()(case.gradient))
    default = case.measures(DLS()(case.gradient))
    swept = {}
    for factor in sweep:
        swept[factor] = case.measures(DLS(lam=0.5, mu=factor * case.sigma, n_iter=n_iter, tol=0)(case.gradient))
        print(
            f"  {case.name}: mu = {factor} sigma, SSIM",
            *(f"{s:.4f}" for s in swept[factor]["ssim"].mean(1)),
            flush=True,
        )
    rows = []
    for i, snr in enumerate(case.snrs):
        best = max(swept, key=lambda f: float(swept[f]["ssim"][i].mean()))
        row: dict[str, Any] = {"surface": case.name, "snr": snr, "draws": len(case.seeds), "best_mu_over_sigma": best}
        for method, found in (("least_squares", start), ("dls", default), ("dls_best", swept[best])):
            row |= {f"{method}_{k}": float(v[i].mean()) for k, v in found.items()}
            row[f"{method}_ssim_spread"] = float(found["ssim"][i].std(correction=0))
        if snr in SNRS:
            row |= {f"paper_{k}": v[SNRS.index(snr)] for k, v in PAPER[case.name].items()}
        rows.append(row)
    return rows


def run_quick(case: Case) -> list[dict[str, Any]]:
    """DLS as it comes, its slow waves shrunk, and SlopeDLS, with the SSIM of the paper."""
    g, plain, height = case.gradient, LeastSquares()(case.gradient), DLS()(case.gradient)
    found = {
        "least squares": plain,
        "DLS": height,
        "DLS, slow waves": shrink_slow_waves(height, plain, noise_level(g)),
        "SlopeDLS": SlopeDLS()(g),
    }
    measured = {name: case.measures(z) for name, z in found.items()}
    rows = []
    for i, snr in enumerate(case.snrs):
        row: dict[str, Any] = {"surface": case.name, "SNR (dB)": snr}
        row |= {name: float(m["ssim"][i].mean()) for name, m in measured.items()}
        row["paper: DLS"] = PAPER[case.name]["dls"][SNRS.index(snr)]
        row |= {f"RMSE: {name}": float(m["rmse"][i].mean()) for name, m in measured.items()}
        rows.append(row)
        print(*row.values(), flush=True)
    return rows


def run_trials(case: Case, n_iter: int, factors: Sequence[float]) -> list[dict[str, Any]]:
    """Each change alone, at the best of a few thresholds where several are given."""
    start = case.measures(LeastSquares()(case.gradient))
    rows = []
    for label, change in TRIALS.items():
        began, found = time.perf_counter(), []
        for factor in factors:
            options = {"lam": 0.5, "n_iter": n_iter, "tol": 0.0} | change
            found.append(gains(case.measures(DLS(mu=factor * case.sigma, **options)(case.gradient)), start))
        best = [max(f["1-ssim"][i] for f in found) for i in range(len(case.snrs))]
        best_rmse = [max(f["rmse"][i] for f in found) for i in range(len(case.snrs))]
        seconds = (time.perf_counter() - began) / len(factors) / len(case.gradient)
        rows.append({"trial": label, "gain": best, "rmse_gain": best_rmse, "seconds": seconds})
        print(f"  {label:30}", *(f"{g:.2f}" for g in best), f"  {seconds:.1f} s each", flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table: SSIM, then RMSE and mean angular error of the surface's normals."""
    header = ["surface", "SNR (dB)", "least squares", "DLS", "DLS, best mu", "paper: DCTLS", "paper: DLS"]
    header += ["RMSE: least squares", "DLS", "angle: least squares", "DLS"]
    keys = ["least_squares_ssim", "dls_ssim", "dls_best_ssim", "paper_dctls", "paper_dls"]
    lines = []
    for r in rows:
        line = [r["surface"], r["snr"], *(f"{r[k]:.3f}" if k in r else "" for k in keys)]
        line += [f"{r[f'{m}_rmse']:.2f}" for m in ("least_squares", "dls")]
        line += [f"{r[f'{m}_angle']:.2f}°" for m in ("least_squares", "dls")]
        lines.append(line)
    return markdown_table(header, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small surfaces, one draw, few iterations: does it run?")
    parser.add_argument("--quick", action="store_true", help="no sweep; slow waves shrunk, and SlopeDLS, up to 20 dB")
    parser.add_argument("--trials", action="store_true", help="single changes to the algorithm on Tent at 1, 10, 20 dB")
    parser.add_argument("--seeds", type=int, default=3, help="noise draws per row")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for the results")
    args = parser.parse_args()
    out = args.out or results_folder(args.smoke)
    seeds = range(args.first_seed, args.first_seed + (1 if args.smoke else args.seeds))
    n, n_iter = (48, 3) if args.smoke else (200, 100)
    sweep: Sequence[float] = (1.5,) if args.smoke else SWEEP
    if args.trials:
        trials = run_trials(Case("tent", (1, 10, 20), seeds, n), n_iter, (1.5,) if not args.smoke else sweep)
        path = write_json(out / "trials.json", trials=trials)
    elif args.quick:
        with torch.no_grad():
            quick = [
                row for name in PAPER for row in run_quick(Case(name, SNRS[:1] if args.smoke else SNRS[:4], seeds, n))
            ]
        lines = [[*map(str, [*r.values()][:2]), *(f"{x:.3f}" for x in [*r.values()][2:])] for r in quick]
        path = write_json(out / "slow_waves.json", settings={"size": n, "seeds": [*seeds]}, rows=quick)
        note = "\nSSIM, then RMSE in pixels; means of the draws.\n\n"
        command = f"benchmarks.quality.dls --quick --seeds {args.seeds}"
        (out / "slow_waves.md").write_text(markdown_table([*quick[0]], lines) + note + made_by(command))
    else:
        rows = [row for name in PAPER for row in run_table(Case(name, SNRS, seeds, n), n_iter, sweep)]
        path = write_json(out / "quality.json", rows=rows)
        (out / "quality.md").write_text(table(rows))
        print(table(rows))
    print(f"written: {path}")


if __name__ == "__main__":
    main()
