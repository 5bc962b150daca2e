"""The paper's evaluation with every integrator: `python -m benchmarks.quality.paper` (add --smoke for a smoke run).

Tables 1 and 2 (Tent and Vase at 200 x 200, 1 to 60 dB): each method of the paper with its default parameters and at the
best of a stated sweep (chosen by the mean SSIM of the draws, as the paper does), beside the paper's figures; then all
other integrators of the registry with their defaults. Figures 1 and 2 (renderings), figure 3 (ten noisy images, least
squares normals, reconstructions and zoom), and how DLS depends on its parameters. Noise draws run as one batch. Writes
JSON, Markdown tables and PNG figures.

Figure 3 is drawn for rendered terrain; with --images FOLDER, for images of yours (the paper's Frog, say): ten or so
grey or colour images in the order of their names, `lights.txt` (a line x y z for each, x right, y up, z to the viewer)
and, if there is one, a white `mask.png`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.paper_figures import comparison, photometric_figure, sweep_plot
from benchmarks.common.report import markdown_table, results_folder, write_json
from benchmarks.quality.dls import PAPER, SNRS, Case
from torchdls import DLS, INTEGRATORS, LeastSquares, noise_level, shrink_slow_waves

# The columns of the paper, by the names of the registry; the paper's figures for SNRS.
COLUMNS = {"dls": "DLS", "spectral_regularization": "SR", "total_variation": "TV", "least_squares": "DCTLS"}
PRINTED = {
    "tent": {
        "spectral_regularization": (0.944, 0.950, 0.956, 0.969, 0.978, 0.985, 0.988, 0.989),
        "total_variation": (0.918, 0.938, 0.957, 0.979, 0.989, 0.994, 0.996, 0.997),
    },
    "vase": {
        "spectral_regularization": (0.930, 0.934, 0.942, 0.961, 0.975, 0.982, 0.984, 0.985),
        "total_variation": (0.889, 0.911, 0.933, 0.965, 0.981, 0.990, 0.993, 0.995),
    },
}
for _name, _columns in PRINTED.items():
    _columns |= {"dls": PAPER[_name]["dls"], "least_squares": PAPER[_name]["dctls"]}

# What is swept. mu is in units of the estimated noise of one slope; all else is passed to the integrator as it is.
SWEEPS: dict[str, list[dict[str, Any]]] = {
    "dls": [{"mu": f} for f in (0.75, 1.0, 1.5, 2.0, 3.0)],
    "spectral_regularization": [
        {"modes": m, "basis": b} for b in ("cosine", "polynomial") for m in (6, 10, 14, 20, 28, 40, 60, 90, 140, 200)
    ],
    "total_variation": [{"smoothing": s} for s in (0.1, 0.3, 1.0, 3.0, 10.0)],
    "least_squares": [{}],
}
SLOW = {"horn_brooks"}  # a reference of thousands of relaxations, left out of the table of all methods
MEASURES = ("ssim", "rmse", "angle")
Found = dict[str, Tensor]  # measure -> (levels, draws)


def run(case: Case, name: str, options: Mapping[str, Any]) -> tuple[Found, float]:
    """A method on all levels and draws of the case, and the seconds it took per surface."""
    options = dict(options)
    if "mu" in options:
        options["mu"] = options["mu"] * noise_level(case.gradient)
    began = time.perf_counter()
    with torch.no_grad():
        height = INTEGRATORS[name](**options)(case.gradient)
    seconds = (time.perf_counter() - began) / len(case.gradient)
    return case.measures(height), seconds


def fit_sweep(name: str, sweep: Sequence[dict[str, Any]], n: int) -> list[dict[str, Any]]:
    """The entries of a sweep that a surface of n pixels a side allows."""
    return [o for o in sweep if name != "spectral_regularization" or o["modes"] <= n]


def best_of_sweep(case: Case, name: str, sweep: Sequence[dict[str, Any]]) -> tuple[Found, list[str]]:
    """For each level, what the parameters of the highest mean SSIM found, and which they are."""
    found = [run(case, name, options)[0] for options in sweep]
    chosen = torch.stack([f["ssim"].mean(1) for f in found]).argmax(0).tolist()
    best = {k: torch.stack([found[c][k][level] for level, c in enumerate(chosen)]) for k in MEASURES}
    words = [", ".join(f"{k}={v}" for k, v in o.items() if k in ("mu", "modes", "basis", "smoothing")) for o in sweep]
    return best, [words[c] for c in chosen]


def paper_rows(case: Case, sweeps: Mapping[str, Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """One row per noise level: for each column of the paper default, best of sweep and the printed figure."""
    rows: list[dict[str, Any]] = [
        {"surface": case.name, "snr": snr, "draws": len(case.seeds), "methods": {}} for snr in case.snrs
    ]
    for name in [c for c in COLUMNS if c in INTEGRATORS]:
        default, seconds = run(case, name, {})
        best, settings = best_of_sweep(case, name, sweeps[name])
        for i, row in enumerate(rows):
            entry = {"default": statistics(default, i), "best": statistics(best, i), "best_parameters": settings[i]}
            printed = PRINTED[case.name][name][SNRS.index(row["snr"])]
            row["methods"][name] = entry | {"paper_ssim": printed, "seconds": seconds}
        print(f"  {case.name}: {name}", *(f"{float(s):.3f}" for s in best["ssim"].mean(1)), flush=True)
    for row in rows:
        best = {name: e["best"]["ssim"]["mean"] for name, e in row["methods"].items()}
        row["first"] = max(best, key=best.__getitem__)
    return rows


def statistics(found: Found, level: int) -> dict[str, dict[str, float]]:
    """Mean and standard deviation over the draws of one noise level."""
    return {k: {"mean": float(v[level].mean()), "spread": float(v[level].std(correction=0))} for k, v in found.items()}


def with_slow_waves(gradient: Tensor) -> Tensor:
    """DLS as it comes, then the waves that its patches cannot see."""
    return shrink_slow_waves(DLS()(gradient), LeastSquares()(gradient), noise_level(gradient))


def all_rows(case: Case) -> list[dict[str, Any]]:
    """Every integrator of the registry with its defaults, and DLS around the robust data terms."""
    methods: dict[str, Any] = {name: INTEGRATORS[name] for name in INTEGRATORS if name not in SLOW}
    for term in ("total_variation", "l1"):
        if term in INTEGRATORS:
            methods[f"dls({term})"] = lambda term=term: DLS(data_term=INTEGRATORS[term]())
    methods |= {"dls(select=False)": lambda: DLS(select=False), "dls, slow waves shrunk": lambda: with_slow_waves}
    rows = []
    for name, factory in methods.items():
        began = time.perf_counter()
        with torch.no_grad():
            found = case.measures(factory()(case.gradient))
        seconds = (time.perf_counter() - began) / len(case.gradient)
        levels = {str(snr): statistics(found, i) for i, snr in enumerate(case.snrs)}
        rows.append({"surface": case.name, "method": name, "seconds": seconds, "levels": levels})
    return rows


def dependence(case: Case, smoke: bool) -> dict[str, dict[str, list[float]]]:
    """Mean SSIM gain of DLS, (1 - SSIM of least squares)/(1 - SSIM), against each of its parameters."""
    start, _ = run(case, "least_squares", {})
    values: dict[str, list[Any]] = {
        "lam": [0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0],
        "mu / noise": [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0],
        "iterations": [1, 2, 5, 10, 20, 50, 100],
        "patch size": [4, 6, 8, 10, 12],
        "stride": [1, 2, 3, 4, 6, 8],
    }
    curves: dict[str, dict[str, list[float]]] = {}
    for label, axis in values.items():
        axis = axis[1:3] if smoke else axis
        gains = []
        for x in axis:
            options = {
                "lam": {"lam": x},
                "mu / noise": {"mu": x},
                "iterations": {"n_iter": x, "tol": 0},
                "patch size": {"patch_size": x, "n_atoms": int(x) ** 2},
                "stride": {"stride": x},
            }[label]
            found, _ = run(case, "dls", {"mu": 1.25, "n_iter": 2 if smoke else 30} | options)
            gains.append(((1 - start["ssim"]).mean(1) / (1 - found["ssim"]).mean(1)).tolist())
        curves[label] = {"values": axis} | {f"{snr} dB": [g[i] for g in gains] for i, snr in enumerate(case.snrs)}
    return curves


def tables(rows: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]]) -> str:
    """Markdown: a table in the shape of the paper's per surface and measure, then the one of all methods."""
    text = (
        "Best of the sweep / default parameters / (printed in the paper). Mean over the draws ± standard deviation.\n"
    )
    for surface in dict.fromkeys(r["surface"] for r in rows):
        part = [r for r in rows if r["surface"] == surface]
        names = list(part[0]["methods"])
        for measure, digits in (("ssim", 3), ("rmse", 2), ("angle", 2)):
            lines = []
            for r in part:
                line = [r["snr"]]
                for name in names:
                    e = r["methods"][name]
                    best = f"{e['best'][measure]['mean']:.{digits}f} ± {e['best'][measure]['spread']:.{digits}f}"
                    best = f"**{best}**" if measure == "ssim" and name == r["first"] else best
                    cell = f"{best} / {e['default'][measure]['mean']:.{digits}f}"
                    line.append(cell + (f" ({e['paper_ssim']:.3f})" if measure == "ssim" else ""))
                lines.append(line)
            unit = {"ssim": "SSIM", "rmse": "RMSE in pixels", "angle": "mean angular error in degrees"}[measure]
            header = ["SNR (dB)", *(COLUMNS[n] for n in names)]
            text += f"\n### {surface.capitalize()}, {unit}\n\n{markdown_table(header, lines)}"
    lost = [f"{r['surface']} at {r['snr']} dB ({COLUMNS[r['first']]})" for r in rows if r["first"] != "dls"]
    lost = [row for row, r in zip(lost, [r for r in rows if r["first"] != "dls"], strict=True) if r["snr"] <= 30]
    text += f"\nRows up to 30 dB where DLS is not first: {', '.join(lost) or 'none'}.\n"
    gap = max((abs(e["best"]["ssim"]["mean"] - e["paper_ssim"]) for r in rows
               if (e := r["methods"].get("least_squares"))), default=0.0)  # fmt: skip
    text += f"\nLargest distance of the DCTLS column from the paper's: {gap:.3f}.\n"
    snrs = list(others[0]["levels"])
    lines = [
        [o["surface"], f"`{o['method']}`", *(f"{o['levels'][s]['ssim']['mean']:.3f}" for s in snrs),
         *(f"{o['levels'][s]['rmse']['mean']:.2f}" for s in snrs), f"{o['seconds']:.2f}"]
        for o in others
    ]  # fmt: skip
    header = ["surface", "method", *(f"SSIM, {s} dB" for s in snrs), *(f"RMSE, {s} dB" for s in snrs), "s each"]
    return text + f"\n### All integrators with default parameters\n\n{markdown_table(header, lines)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small surfaces, one draw, short sweeps: does it run?")
    parser.add_argument("--draws", type=int, default=5, help="noise draws per row")
    parser.add_argument("--images", type=Path, help="folder of photometric images for figure 3")
    parser.add_argument("--out", type=Path, help="folder for the results")
    args = parser.parse_args()
    began = time.perf_counter()
    out = args.out or results_folder(args.smoke)
    out.mkdir(parents=True, exist_ok=True)
    n, seeds = (48, range(1)) if args.smoke else (200, range(args.draws))
    sweeps = {k: fit_sweep(k, v, n) for k, v in SWEEPS.items()}
    if args.smoke:
        sweeps = {k: v[1:3] or v for k, v in sweeps.items()}
        sweeps["dls"] = [o | {"n_iter": 2} for o in sweeps["dls"]]
    snrs, all_snrs = ((20, 30), (30,)) if args.smoke else (SNRS, (10, 30))
    rows, others = [], []
    for name in PRINTED:
        rows += paper_rows(Case(name, snrs, seeds, n), sweeps)
        others += all_rows(Case(name, all_snrs, seeds[:1], n))
    curves = dependence(Case("tent", (20,) if args.smoke else (1, 10, 20), seeds[:1], n), args.smoke)
    figure_3 = photometric_figure(out / "paper_figure_3.png", args.images, 48 if args.smoke else 200, COLUMNS)
    for number, (name, snr) in enumerate((("tent", 20), ("vase", 30)), 1):
        chosen = next(r for r in rows if r["surface"] == name and r["snr"] == snr)
        comparison(out / f"paper_figure_{number}.png", name, snr, n, chosen, COLUMNS)
    sweep_plot(out / "paper_sweeps.png", curves)
    path = write_json(
        out / "paper.json", seconds=time.perf_counter() - began, sweeps=sweeps, rows=rows, all=others,
        dependence=curves, figure_3=figure_3,
    )  # fmt: skip
    (out / "paper.md").write_text(tables(rows, others))
    print(tables(rows, others))
    print(f"written: {path}")


if __name__ == "__main__":
    main()
