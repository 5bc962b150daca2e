"""Gain over least squares on every surface: `python -m benchmarks.quality.gains` (add --smoke for a smoke run).

All analytic surfaces and real terrain, several noise levels and draws. SlopeDLS runs as it comes. DLS runs as it comes,
bare (`select=False`), at the best of a sweep of thresholds, chosen per row with the truth in hand, and with
`select=True`, which chooses without it. The comparators run at the best of a sweep. A row is a surface at a noise
level: the mean error of least squares over the mean error of the method. Writes JSON with every row and a Markdown
table of geometric means and worst rows, and a picture.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.report import markdown_table, results_folder, write_json
from torchdls import (
    DLS,
    L1,
    SURFACES,
    GradientOperator,
    LeastSquares,
    SlopeDLS,
    SpectralRegularization,
    Surface,
    TotalVariation,
    add_noise,
    edge_slopes,
)
from torchdls.metrics import mean_angular_error, rmse, ssim
from torchdls.noise import noise_level
from torchdls.solvers import solve_direct
from torchdls.surfaces import terrain

MEASURES = ("rmse", "1-ssim", "1-ssim, full range", "gradient", "angle")
THRESHOLDS = (1.0, 1.5, 2.25)  # of DLS, in units of the noise of one sample
WEIGHTS = (0.25, 0.5, 1.0, 2.0)  # of second-order TV, likewise
MODES = (8, 16, 24, 32, 48, 64)  # of spectral regularisation
SMOOTHINGS = (0.1, 1.0, 10.0)  # of TV and L1
Method = Callable[[Tensor], Tensor]


def second_order_tv(gradient: Tensor, weight: float, n_iter: int = 100) -> Tensor:
    r"""min 1/2 ||A z - v||^2 + weight sigma \sum_i ||(grad A z)_i||_2 by ADMM, both linear steps direct.

    Split as p = A z (slopes) and q = grad p (four second differences, one norm per pixel).
    """
    a = GradientOperator()
    v, _ = edge_slopes(gradient)
    sigma = noise_level(gradient)[:, None, None, None]
    rho, eta = 1.0, 2.0

    def second(p: Tensor) -> Tensor:
        return torch.cat([a(p[:, :1]), a(p[:, 1:])], 1)

    def second_adjoint(q: Tensor) -> Tensor:
        return torch.cat([a.adjoint(q[:, :2]), a.adjoint(q[:, 2:])], 1)

    z = solve_direct(a.adjoint(v), None)
    p, q = a(z), second(a(z))
    s, t = torch.zeros_like(p), torch.zeros_like(q)
    for _ in range(n_iter):
        z = solve_direct(a.adjoint(v + rho * (p - s)) / (1 + rho), None)
        right = (rho * (a(z) + s) + eta * second_adjoint(q - t)) / eta
        p = torch.cat([solve_direct(c, rho / eta) for c in right.split(1, 1)], 1)
        r = second(p) + t
        norm = r.norm(dim=1, keepdim=True)
        q = r * (1 - weight * sigma / (eta * norm.clamp(min=1e-30))).clamp(min=0)
        s, t = s + a(z) - p, r - q
    return z


def methods(n: int) -> dict[str, list[Method]]:
    """Each method as its candidates; of several the best counts, per row and measure."""

    def dls(mu: float) -> Method:
        return lambda g: DLS(lam=0.5, mu=mu * noise_level(g), n_iter=15, tol=0)(g)

    return {
        "SlopeDLS": [SlopeDLS()],
        "SlopeDLS.fast": [SlopeDLS.fast()],
        "SlopeDLS, plain": [SlopeDLS(recipe="plain")],
        "SlopeDLS, plain, learn=False": [SlopeDLS(recipe="plain", learn=False)],
        "SlopeDLS, plain, guard='sure'": [SlopeDLS(recipe="plain", guard="sure")],
        "second-order TV, best of 4": [lambda g, w=w: second_order_tv(g, w) for w in WEIGHTS],
        "DLS": [DLS()],
        "DLS, 15 iterations": [DLS(n_iter=15, tol=0)],
        "DLS, bare, 15 iterations": [DLS(n_iter=15, tol=0, select=False)],
        "DLS, best of 3": [dls(mu) for mu in THRESHOLDS],
        "DLS, select, 15 iterations": [DLS(n_iter=15, tol=0, select=True)],
        "SR, best of 6": [SpectralRegularization(m) for m in MODES if m <= n],
        "TV, best of 3": [TotalVariation(smoothing=s) for s in SMOOTHINGS],
        "L1, best of 3": [L1(smoothing=s) for s in SMOOTHINGS],
    }


def measures(height: Tensor, surface: Surface, levels: int) -> Tensor:
    """(measures, levels): errors, averaged over the draws of a noise level."""
    truth = surface.height.expand_as(height)
    full = float(truth.max() - truth.min())
    slopes = GradientOperator()(height - truth)
    found = [
        rmse(height, truth),
        1 - ssim(height, truth, surface.data_range),
        1 - ssim(height, truth, full),
        slopes.square().mean((1, 2, 3)).sqrt(),
        mean_angular_error(height, truth),
    ]
    return torch.stack(found).view(len(found), levels, -1).mean(-1)


def run(
    surfaces: Iterable[Surface], snrs: Sequence[int], seeds: Sequence[int], names: Sequence[str]
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """A row for every surface, noise level and method; and the seconds that each method took per field."""
    rows: list[dict[str, Any]] = []
    seconds: dict[str, float] = {}
    fields = 0
    for surface in surfaces:
        draws = [
            add_noise(surface.gradient, snr, torch.Generator().manual_seed(977 * seed + snr))
            for snr in snrs
            for seed in seeds
        ]
        gradient = torch.cat(draws)
        fields += len(gradient)
        plain = measures(LeastSquares()(gradient), surface, len(snrs))
        everything = methods(gradient.shape[-1])
        for name in names:
            candidates, start = everything[name], time.perf_counter()
            found = torch.stack([measures(method(gradient), surface, len(snrs)) for method in candidates])
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
            gain = plain / found.amin(0)
            for k, snr in enumerate(snrs):
                values = {
                    m: g if 0 < g < math.inf else None for m, g in zip(MEASURES, gain[:, k].tolist(), strict=True)
                }
                rows.append({"surface": surface.name, "snr": snr, "method": name, **values})
            print(f"{surface.name:10} {name:28}", *(f"{a:.2f}/{b:.2f}" for a, b in gain[:2].T), flush=True)
    return rows, {name: s / fields for name, s in seconds.items()}


def known(rows: Iterable[dict[str, Any]], measure: str) -> list[float]:
    """The gains in one measure; a row is left out where an error is 0 in single precision."""
    return [r[measure] for r in rows if r[measure] is not None]


def geometric_mean(values: Sequence[float]) -> float:
    return math.exp(sum(map(math.log, values)) / len(values)) if values else math.nan


def table(rows: list[dict[str, Any]], seconds: dict[str, float]) -> str:
    """Geometric means of the gains per noise level (RMSE / 1-SSIM), the worst row as method over least squares."""
    snrs = sorted({r["snr"] for r in rows})
    lines = []
    for name in seconds:
        mine = [r for r in rows if r["method"] == name]

        def cell(chosen: list[dict[str, Any]]) -> str:
            return " / ".join(f"{geometric_mean(known(chosen, m)):.2f}" for m in MEASURES[:3])

        low = [r for r in mine if r["snr"] <= 20]
        worst = " / ".join(f"{1 / min(known(mine, m)):.3f}" for m in MEASURES[:3])
        lines.append([name, cell(low), *(cell([r for r in mine if r["snr"] == s]) for s in snrs), worst])
    note = "Cells: RMSE / 1-SSIM at the surface's data range / 1-SSIM at the full range of its heights."
    return markdown_table(["gain", "up to 20 dB", *(f"{s} dB" for s in snrs), "worst row"], lines) + "\n" + note + "\n"


def surface_table(rows: list[dict[str, Any]]) -> str:
    """The gain of the first method on every surface (RMSE / 1-SSIM at the surface's data range)."""
    snrs = sorted({r["snr"] for r in rows})
    method = rows[0]["method"]
    found = {(r["surface"], r["snr"]): r for r in rows if r["method"] == method}
    lines = [
        [name, *(" / ".join(f"{found[name, s][m] or math.nan:.2f}" for m in MEASURES[:2]) for s in snrs)]
        for name in dict.fromkeys(r["surface"] for r in rows)
    ]
    return markdown_table([f"gain of {method}", *(f"{s} dB" for s in snrs)], lines)


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Gain against the noise level: the geometric mean of all surfaces, and every surface for the first method."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    first = rows[0]["method"]
    names = [n for n in dict.fromkeys(r["method"] for r in rows) if not n.startswith("SlopeDLS,")] or [first]
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
    snrs = sorted({r["snr"] for r in rows})
    for axis, measure in zip(axes, MEASURES[:2], strict=True):
        for surface in dict.fromkeys(r["surface"] for r in rows):
            mine = [r for r in rows if r["surface"] == surface and r["method"] == first]
            axis.plot(snrs, [r[measure] or math.nan for r in mine], color="0.85", zorder=1)
        for k, name in enumerate(names):
            levels = [[r for r in rows if r["method"] == name and r["snr"] == s] for s in snrs]
            means = [geometric_mean(known(level, measure)) for level in levels]
            width = 2.5 if name == first else 1.2
            axis.plot(snrs, means, f"C{k}", marker="o", markersize=3, linewidth=width, label=name)
        axis.plot([], [], color="0.85", label="SlopeDLS, each surface")
        axis.axhline(1, color="black", linewidth=0.6)
        axis.set(xlabel="SNR (dB)", ylabel=f"error of least squares / error ({measure})", yscale="log")
        axis.set_ylim(bottom=0.5)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("")
        axis.set_yticks([0.5, 1, 2, 5, 10, 20][: 3 if measure == "rmse" else 6])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small surfaces, one draw: does it run?")
    parser.add_argument("--quick", action="store_true", help="SlopeDLS and its fast variant alone")
    parser.add_argument("--method", nargs="+", choices=methods(96), metavar="NAME", help="some methods instead of all")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--snr", type=int, nargs="+", default=[1, 5, 10, 20, 30, 40, 60])
    parser.add_argument("--seeds", type=int, default=3, help="noise draws per row")
    parser.add_argument("--first-seed", type=int, default=900)
    parser.add_argument("--surface", nargs="+", help="some surfaces instead of all")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    n, snrs, names = (32, [1, 20], ["tent", "peaks"]) if args.smoke else (args.size, args.snr, args.surface)
    seeds = range(args.first_seed, args.first_seed + (1 if args.smoke else args.seeds))
    surfaces = [terrain(n) if name == "terrain" else SURFACES[name](n) for name in names or [*SURFACES, "terrain"]]
    chosen = args.method or [*methods(n)][: 2 if args.quick else None]
    with torch.no_grad():
        rows, seconds = run(surfaces, snrs, seeds, chosen)
    out = args.out or results_folder(args.smoke)
    settings = {"size": n, "snr": snrs, "seeds": [*seeds]}
    path = write_json(out / "gains.json", settings=settings, seconds=seconds, rows=rows)
    (out / "gains.md").write_text(table(rows, seconds) + "\n" + surface_table(rows))
    picture(rows, out / "gains.png")
    print(table(rows, seconds), *(f"{name}: {s:.2f} s per field" for name, s in seconds.items()), sep="\n")
    print(f"written: {path}")


if __name__ == "__main__":
    main()
