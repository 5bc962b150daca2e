"""LeastSquares from 16^2 to 2048^2 beside SciPy in the same precision, and sweeps of patches as `unfold` lays them out.

`OMP_NUM_THREADS=1 python -m benchmarks.speed.small_calls` (two minutes; add --smoke; SPAMS takes part where the
environment says so). One thread; candidates take turns in one process,
and medians of its processor time are compared. "Solve alone" is what is left of a call without `nn.Module` and the
checks of what comes in and goes out. Writes JSON and Markdown.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from statistics import median
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import torch.nn.functional as F

from benchmarks.common.peers import ScipyPoisson, optional
from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from benchmarks.common.timing import interleaved
from benchmarks.speed.compare import noisy
from torchdls import DLS, LeastSquares, SoupDIL, _compiled, backends, soup_dil_sweep
from torchdls.dictionary.soup_dil import Order, residual_sweep
from torchdls.solvers import integrate_direct

SIZES = (16, 32, 64, 96, 128, 256, 512, 1024, 2048)


def medians(candidates: dict[str, Callable[[], Any]], seconds: float) -> dict[str, float]:
    """Microseconds of each."""
    return {
        name: 1e6 * median(times) for name, times in interleaved(candidates, seconds, clock=time.process_time).items()
    }


def least_squares(size: int, dtype: torch.dtype, seconds: float) -> dict[str, Any]:
    g, ours = noisy(size, dtype), LeastSquares()
    p, q = (np.ascontiguousarray(x) for x in g[0].numpy())
    scipy = ScipyPoisson(size, size, p.dtype, 1)
    candidates: dict[str, Callable[[], Any]] = {
        "torchdls": lambda: ours(g),
        "solve alone": lambda: integrate_direct(g),
        "checks": lambda: ours._check_fields(g),
        "SciPy": lambda: scipy(p, q),
    }
    return {"size": size, "dtype": str(dtype).removeprefix("torch."), **medians(candidates, seconds)}


def sweep(size: int, order: Order, seconds: float) -> dict[str, Any]:
    """In the middle of DLS, where codes are sparse; times in products of the dictionary with all codes."""
    result = DLS(learner=SoupDIL(order), n_iter=4, tol=0.0).solve(noisy(size, torch.float32))
    D, B, mu = result.dictionary, result.codes, result.mu[:, None]
    apart = F.unfold(result.height, 8, stride=2)
    together = apart.mT.contiguous().mT
    B = B.contiguous()  # as sweeps by PyTorch alone leave them
    R, codes, product = (together.mT - B.mT @ D.mT).mT, B.clone(), torch.empty_like(B)
    candidates: dict[str, Callable[[], Any]] = {
        "unfold": lambda: _alone(soup_dil_sweep, apart, D, B, mu, order=order),
        "in place": lambda: _alone(residual_sweep, R, D, codes, mu, order=order),
        "product": lambda: torch.bmm(D.mT, R, out=product),
    }
    if backends()["soup_dil_sweep"] == "numba":
        S, _, own = residual_sweep(R.clone(), D, codes.clone(), mu, order=order)
        candidates["unfold, loops"] = lambda: soup_dil_sweep(apart, D, B, mu, order=order)
        candidates["in place, loops"] = lambda: residual_sweep(S, D, own, mu, order=order)
    # Threads of SPAMS' own BLAS that idle would count as its time: 20 products in place of 4.
    spams = optional("spams") if os.environ.get("OMP_NUM_THREADS") == "1" else None
    if spams is not None:
        X, A, level = (np.asfortranarray(x[0].numpy()) for x in (apart, D, mu))
        candidates["SPAMS OMP"] = lambda: spams.omp(X, A, lambda1=float(level[0]) ** 2 / 2, numThreads=1)
    times = medians(candidates, seconds)
    in_products = {name: t / times["product"] for name, t in times.items()}
    return {"size": size, "order": order, "product, us": times["product"], **in_products}


def _alone(sweep: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """By PyTorch alone."""
    with patch.object(_compiled, "installed", lambda: False):
        return sweep(*args, **options)


def table(rows: list[dict[str, Any]], sweeps: list[dict[str, Any]]) -> str:
    header = ("size", "dtype", "torchdls, us", "solve alone", "checks", "SciPy, us", "ratio", "ratio, solve alone")
    lines = [
        (f"{r['size']}^2", r["dtype"], *(f"{r[k]:,.0f}" for k in ("torchdls", "solve alone", "checks", "SciPy")),
         f"{r['torchdls'] / r['SciPy']:.2f}", f"{r['solve alone'] / r['SciPy']:.2f}")
        for r in rows
    ]  # fmt: skip
    names = ("unfold", "in place", "unfold, loops", "in place, loops", "SPAMS OMP")
    below = [
        (f"{s['size']}^2", s["order"], f"{s['product, us'] / 1e3:.2f}", *(_products(s.get(name)) for name in names))
        for s in sweeps
    ]
    made = made_by("benchmarks.speed.small_calls")
    return (
        f"LeastSquares beside SciPy's cosine transforms, one thread:\n\n{markdown_table(header, lines)}\n{made}\n"
        "A sweep, in products of the dictionary with all codes: from the patches that `unfold` gives and in place as\n"
        "DLS runs it, by PyTorch alone and by compiled loops (the extra `fast`); beside it the orthogonal matching\n"
        "pursuit of SPAMS at the same threshold (with OMP_NUM_THREADS=1), which only codes:\n\n"
        f"{markdown_table(('size', 'order', 'product, ms', *names), below)}\n{made}"
    )


def _products(times: float | None) -> str:
    return "-" if times is None else f"{times:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--seconds", type=float, default=2.0, help="time for each row")
    args = parser.parse_args()
    torch.set_num_threads(1)
    seconds = 0.05 if args.smoke else args.seconds
    sizes = (16, 32) if args.smoke else SIZES
    orders: tuple[Order, ...] = ("block", "atom")
    with torch.no_grad():
        rows = [least_squares(n, dtype, seconds) for dtype in (torch.float32, torch.float64) for n in sizes]
        sweeps = [sweep(n, order, 2 * seconds) for n in ((40,) if args.smoke else (256, 512)) for order in orders]
    folder = results_folder(args.smoke)
    write_json(folder / "small_calls.json", rows=rows, sweeps=sweeps)
    text = table(rows, sweeps)
    (folder / "small_calls.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
