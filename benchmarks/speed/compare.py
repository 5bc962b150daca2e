"""torchdls beside what a user would take instead: `python -m benchmarks.speed.compare` (some minutes; add --smoke).

In every case the candidates take turns in one process (A B A B ..); the ratio of the medians is what travels to other
machines. Floors (a product with the dictionary, an FFT and its inverse, a copy) stand beside them, and each candidate's
peak memory is that of a process of its own. Writes JSON and Markdown, and the table of docs/results.md.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.common.peers import (
    ScipyPoisson,
    amg_cg,
    dbini,
    grad2surf,
    optional,
    spams_dictionary,
    spams_error,
    sparse_cg,
    sparse_direct,
)
from benchmarks.common.report import made_by, markdown_table, replace_section, results_folder, write_json
from benchmarks.common.timing import fresh_process, interleaved, peak_megabytes, statistics
from torchdls import (
    DLS,
    HarkerOLeary,
    LeastSquares,
    Patches,
    SoupDIL,
    add_noise,
    dct_dictionary,
    gradient_to_normals,
    soup_dil_sweep,
)
from torchdls.dictionary.soup_dil import Order, residual_sweep
from torchdls.surfaces import SURFACES

Run = Callable[[], Any]


class Case(NamedTuple):
    """Candidates of one task; the target is on the time of `ours` over that of `against`."""

    name: str
    ours: str
    against: str
    target: float
    candidates: dict[str, Run]
    timer: Callable[[float], dict[str, list[float]]] | None = None  # where the candidates cannot simply take turns


def noisy(size: int, dtype: torch.dtype, n: int = 1) -> torch.Tensor:
    surface = SURFACES["tent"](size, dtype=dtype)
    generator = torch.Generator().manual_seed(0)
    return torch.cat([add_noise(surface.gradient, 10, generator=generator) for _ in range(n)])


def least_squares(size: int, dtype: torch.dtype, target: float) -> Case:
    g, workers = noisy(size, dtype), torch.get_num_threads()
    p, q = (np.ascontiguousarray(x) for x in g[0].double().numpy())
    scipy, ours = ScipyPoisson(size, size, np.float64, workers), LeastSquares()
    floor = g[:, :1].contiguous()
    candidates: dict[str, Run] = {
        "torchdls": lambda: ours(g),
        "SciPy DCT, float64": lambda: scipy(p, q),
        "floor: rfft2 + irfft2": lambda: torch.fft.irfft2(torch.fft.rfft2(floor), s=floor.shape[-2:]),
        "floor: copy": floor.clone,
    }
    name = str(dtype).removeprefix("torch.")
    return Case(f"LeastSquares {size}^2 {name}", "torchdls", "SciPy DCT, float64", target, candidates)


def batch(n: int, size: int) -> Case:
    g, ours = noisy(size, torch.float64, n), LeastSquares()
    scipy, fields = ScipyPoisson(size, size, np.float64, torch.get_num_threads()), g.numpy()
    candidates: dict[str, Run] = {
        "torchdls batch": lambda: ours(g),
        "SciPy loop": lambda: [scipy(p, q) for p, q in fields],
    }
    return Case(f"LeastSquares {n} x {size}^2 float64", "torchdls batch", "SciPy loop", 0.7, candidates)


def masked(size: int, radius: float) -> Case:
    g, ours = noisy(size, torch.float64), LeastSquares(tol=1e-8)
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    inside = x**2 + y**2 < radius**2
    mask, (p, q) = torch.from_numpy(inside)[None, None], g[0].numpy()
    candidates: dict[str, Run] = {
        "torchdls": lambda: ours(g, mask),
        "SciPy spsolve": partial(sparse_direct, p, q, inside),
        "SciPy CG": partial(sparse_cg, p, q, inside),
    }
    if pyamg := optional("pyamg"):
        candidates["pyamg CG"] = partial(amg_cg, pyamg, p, q, inside)
    against = "pyamg CG" if pyamg else "SciPy spsolve"
    return Case(f"disk of {inside.sum()} pixels to 1e-8", "torchdls", against, 1 / 3, candidates)


def masked_normals(size: int) -> Case:
    g = noisy(size, torch.float64)
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    mask = torch.from_numpy(x**2 + y**2 < (0.47 * size) ** 2)
    ours, normals = LeastSquares(tol=1e-6), gradient_to_normals(g)[0].float()
    candidates: dict[str, Run] = {"torchdls": lambda: ours(g, mask[None, None])}
    if module := optional("dbini_torch"):
        candidates["dbini-torch, one step"] = partial(dbini, module, normals, mask)
    name = f"masked least squares {size}^2 to 1e-6"
    return Case(name, "torchdls", list(candidates)[-1], 1.0, candidates)


def harker_oleary(size: int) -> Case:
    g, ours = noisy(size, torch.float64), HarkerOLeary()
    p, q = g[0].numpy()
    candidates: dict[str, Run] = {"torchdls": lambda: ours(g)}
    if module := optional("pyGrad2Surf.g2s"):
        candidates["pyGrad2Surf"] = partial(grad2surf, module, p, q)
    return Case(f"HarkerOLeary {size}^2 float64", "torchdls", list(candidates)[-1], 0.1, candidates)


def sweep(size: int, order: Order, target: float) -> Case:
    """One sweep in the middle of DLS, where codes are sparse, as DLS runs it: from the residual, in place."""
    result = DLS(learner=SoupDIL(order), n_iter=4, tol=0.0).solve(noisy(size, torch.float32))
    D, B, mu = result.dictionary, result.codes, result.mu[:, None]
    R = (Patches().extract(result.height).mT - B.mT @ D.mT).mT
    product = torch.empty_like(B)
    candidates: dict[str, Run] = {
        "sweep": lambda: residual_sweep(R, D, B, mu, order=order),
        "floor: product": lambda: torch.bmm(D.mT, R, out=product),
    }
    return Case(f"{order} order {size}^2", "sweep", "floor: product", target, candidates)


def iteration(size: int, order: Order, target: float) -> Case:
    """A whole iteration of DLS (sweep, height, objective); the product is timed between iterations."""
    g, dls = noisy(size, torch.float32), DLS(learner=SoupDIL(order), n_iter=200, tol=0.0)
    result = DLS(n_iter=1).solve(g)
    D, B, product = result.dictionary, result.codes, torch.empty_like(result.codes)
    candidates: dict[str, Run] = {
        "DLS iteration": lambda: DLS(learner=SoupDIL(order), n_iter=2, tol=0.0)(g),
        "floor: product": lambda: torch.bmm(D.mT, B, out=product),
    }

    def timer(seconds: float) -> dict[str, list[float]]:
        times: dict[str, list[float]] = {name: [] for name in candidates}
        begin = last = time.perf_counter()

        def callback(iteration: int, _: Any) -> None:
            nonlocal last
            times["DLS iteration"].append(time.perf_counter() - last)
            start = time.perf_counter()
            candidates["floor: product"]()
            times["floor: product"].append(time.perf_counter() - start)
            last = time.perf_counter()
            if last - begin > seconds and iteration > 3:
                raise StopIteration

        with contextlib.suppress(StopIteration):
            dls.solve(g, callback=callback)
        return {name: t[1:] for name, t in times.items()}  # the first holds the start of the run

    return Case(f"DLS iteration, {order} order {size}^2", "DLS iteration", "floor: product", target, candidates, timer)


def many_small(n: int, size: int) -> Case:
    g, dls = noisy(size, torch.float32, n), DLS(n_iter=3, tol=0.0)
    candidates: dict[str, Run] = {"one batch": lambda: dls(g), "loop": lambda: [dls(x) for x in g]}
    return Case(f"DLS {n} x {size}^2, 3 iterations", "one batch", "loop", 0.25, candidates)


def dictionary_pass(size: int) -> Case:
    """One pass over the patches from the cosine dictionary, with about five nonzeros per patch."""
    P, D0, B0, mu = patches_for_learning(size)
    candidates: dict[str, Run] = {"sweep": lambda: soup_dil_sweep(P, D0, B0, mu, order="block")}
    X, D = (np.asfortranarray(t[0].numpy()) for t in (P, D0))
    if spams := optional("spams"):
        candidates["SPAMS online pass"] = partial(spams_dictionary, spams, X, D, 1, torch.get_num_threads())
    few = np.ascontiguousarray(X.T[:: max(1, X.shape[1] // 4000)])
    if learn := optional("sklearn.decomposition"):
        coder = learn.SparseCoder(D.T, transform_algorithm="omp", transform_n_nonzero_coefs=5)
        candidates[f"scikit-learn OMP, {len(few)} patches"] = lambda: coder.transform(few)
    if learn := optional("dictlearn"):
        few, start = few.astype(float), D.T.astype(float)
        ksvd = learn.DictionaryLearning(64, n_nonzero_coefs=5, max_iter=1, dict_init=start, random_state=0)
        candidates[f"dictlearn K-SVD, {len(few)} patches"] = lambda: ksvd.fit(few)
    against = "SPAMS online pass" if spams else "sweep"
    return Case(f"dictionary pass, {X.shape[1]} patches", "sweep", against, 1.0, candidates)


def error_curve(size: int, passes: tuple[int, ...]) -> list[tuple[Any, ...]]:
    """Passes over the patches, then seconds and error of torchdls and of SPAMS, coded alike; none without SPAMS."""
    spams = optional("spams")
    if spams is None:
        return []
    P, D0, B0, mu = patches_for_learning(size)
    X, start = (np.asfortranarray(t[0].numpy()) for t in (P, D0))
    rows: list[tuple[Any, ...]] = [(0, 0.0, (error := spams_error(spams, X, start)), 0.0, error)]
    for n in passes:

        def sweeps(n: int = n) -> np.ndarray:
            D, B = D0, B0
            for _ in range(n):
                D, B = soup_dil_sweep(P, D, B, mu, order="block")
            return D[0].numpy()

        spams_run = partial(spams_dictionary, spams, X, start, n, torch.get_num_threads())
        runs: dict[str, Callable[[], Any]] = {"sweep": sweeps, "SPAMS": spams_run}
        seconds = {name: median(t) for name, t in interleaved(runs, 0.0).items()}
        errors = {name: spams_error(spams, X, run()) for name, run in runs.items()}
        rows.append((n, seconds["sweep"], errors["sweep"], seconds["SPAMS"], errors["SPAMS"]))
    return rows


def patches_for_learning(size: int) -> tuple[torch.Tensor, ...]:
    P = Patches().extract(LeastSquares()(noisy(size, torch.float32)))
    P = (P.mT - P.mT.mean(-1, keepdim=True)).mT  # or the means would be most of what is to be fitted
    D = dct_dictionary(8, 64)[None]
    B = (D.mT @ P).contiguous()
    mu = B.abs().flatten().kthvalue(int(B.numel() * (1 - 5 / 64))).values  # five nonzeros per patch
    return P, D, torch.where(B.abs() > mu, B, 0), mu[None]


CASES: dict[str, Callable[[], Case]] = {
    "ls512d": partial(least_squares, 512, torch.float64, 1.0),
    "ls1024d": partial(least_squares, 1024, torch.float64, 1.0),
    "ls512f": partial(least_squares, 512, torch.float32, 0.6),
    "ls1024f": partial(least_squares, 1024, torch.float32, 0.6),
    "batch": partial(batch, 64, 128),
    "masked": partial(masked, 256, 119.7),
    "normals": partial(masked_normals, 128),
    "harker": partial(harker_oleary, 512),
    "block": partial(sweep, 512, "block", 6),
    "atom": partial(sweep, 512, "atom", 10),
    "iteration": partial(iteration, 512, "block", 12),
    "iteration_atom": partial(iteration, 512, "atom", 12),
    "small": partial(many_small, 64, 64),
    "dictionary": partial(dictionary_pass, 512),
}
SMOKE: dict[str, Callable[[], Case]] = {
    "ls": partial(least_squares, 96, torch.float64, 1.0),
    "masked": partial(masked, 48, 20),
    "normals": partial(masked_normals, 32),
    "harker": partial(harker_oleary, 24),
    "block": partial(sweep, 48, "block", 6),
    "iteration": partial(iteration, 48, "block", 12),
    "small": partial(many_small, 3, 16),
    "dictionary": partial(dictionary_pass, 40),
}


CURVE = "Error ||P - D B||^2 / ||P||^2 with five nonzeros per patch, after so many passes over the patches:"


def rows(results: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for result in results.values():
        for name, s in result["candidates"].items():
            ours = name == result["ours"]
            verdict = f"{result['ratio']:.2f} (target {result['target']:.2f})" if ours else ""
            against = result["against"] if ours else ""
            spread = f"{s['q1_ms']:.1f} .. {s['q3_ms']:.1f}"
            memory = f"{s['peak_mb']:.0f}" if "peak_mb" in s else ""
            yield result["name"], name, f"{s['median_ms']:.2f}", spread, memory, verdict, against


def milliseconds(x: float) -> str:
    return f"{x:,.1f}" if x < 100 else f"{x:,.0f}"


def summary(results: dict[str, Any]) -> str:
    """The table of docs/results.md: ours beside what it is held against."""
    header = ("task", "torchdls, ms", "beside it", "ms", "ratio", "target")
    lines = []
    for r in results.values():
        ours, other = (r["candidates"][r[k]]["median_ms"] for k in ("ours", "against"))
        ratios = f"{r['ratio']:.2f}", f"{r['target']:.2f}"
        lines.append((r["name"], milliseconds(ours), r["against"], milliseconds(other), *ratios))
    return markdown_table(header, lines)


def curve_table(curve: list[tuple[Any, ...]]) -> str:
    header = ("passes", "torchdls, s", "error", "SPAMS, s", "error")
    return markdown_table(header, [(n, f"{a:.2f}", f"{e:.2e}", f"{b:.2f}", f"{f:.2e}") for n, a, e, b, f in curve])


def measure(key: str, case: Case, seconds: float, memory: bool) -> dict[str, Any]:
    times = case.timer(seconds) if case.timer else interleaved(case.candidates, seconds)
    ratio = median(times[case.ours]) / median(times[case.against])
    stats = {name: statistics(t) for name, t in times.items()}
    if memory:
        for name in stats:
            stats[name]["peak_mb"] = float(fresh_process("benchmarks.speed.compare", "--alone", key, name).split()[-1])
    print(f"{case.name}: {ratio:.2f} x {case.against} (target {case.target:.2f})", flush=True)
    about = {name: getattr(case, name) for name in ("name", "ours", "against", "target")}
    return {**about, "candidates": stats, "ratio": ratio}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--only", nargs="*", help="the cases to run")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=6.0, help="time for each case")
    parser.add_argument("--no-memory", action="store_true", help="leave out the processes that measure memory")
    parser.add_argument("--alone", nargs=2, metavar=("CASE", "CANDIDATE"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cases = SMOKE if args.smoke else CASES
    with torch.no_grad():
        if args.alone:
            key, name = args.alone
            CASES[key]().candidates[name]()
            print(peak_megabytes())
            return
        chosen = {k: c for k, c in cases.items() if not args.only or k in args.only}
        seconds = 0.1 if args.smoke else args.seconds
        memory = not (args.smoke or args.no_memory)
        results = {key: measure(key, build(), seconds, memory) for key, build in chosen.items()}
        whole = not args.only
        curve = error_curve(40 if args.smoke else 512, (1,) if args.smoke else (1, 2, 4)) if whole else []
    folder: Path = results_folder(args.smoke)
    write_json(folder / "compare.json", threads=args.threads, results=results, error_against_time=curve)
    header = ("task", "candidate", "median ms", "quartiles ms", "peak MB", "ratio", "against")
    made = f"\n{made_by('benchmarks.speed.compare')}"
    text = summary(results) + made + (f"\n{CURVE}\n\n{curve_table(curve)}{made}" if curve else "")
    (folder / "compare.md").write_text(f"{text}\n{markdown_table(header, rows(results))}")
    print(text)
    print(f"wrote {folder / 'compare.md'}")
    if whole and not args.smoke:
        about = f"Medians of runs in turns, {args.threads} threads; a ratio below 1 means that torchdls is faster."
        replace_section(Path(__file__).resolve().parents[2] / "docs" / "results.md", "speed", f"{about}\n\n{text}")


if __name__ == "__main__":
    main()
