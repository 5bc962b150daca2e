"""Surfaces out of core: `python -m benchmarks.speed.large` (minutes, 4 GB of disk; --smoke, or --sizes 4096 8192).

Time, the largest memory of the process's own (pages of files left out), and the difference from the whole where that is
made as well (least squares up to 4096 pixels a side, SlopeDLS and DLS up to 1024 or `--whole`). `--method slope_dls
--surface tent --tile 256` measures SlopeDLS by tiles, `--method dls` DLS: errors of the tiles, the whole and least
squares on a surface with noise (5 dB), and time of the core.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.common.report import results_folder, write_json
from benchmarks.common.timing import fresh_process
from torchdls import DLS, Integrator, LeastSquares, SlopeDLS, SoupDIL, add_noise, large
from torchdls.surfaces import SURFACES


def own_megabytes() -> float:
    """What the process holds beside pages of files."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


class Watch:
    """The largest memory while the block runs, looked at twenty times a second."""

    def __enter__(self) -> Watch:
        self.most, self._stop = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()
        return self

    def _look(self) -> None:
        while not self._stop.wait(0.05):
            self.most = max(self.most, own_megabytes())

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def write_field(path: Path, n: int) -> None:
    """Slopes of waves and hills with noise, written in bands."""
    field = np.lib.format.open_memmap(path, "w+", np.float32, (2, n, n))
    x = np.linspace(0, 20, n, dtype=np.float32)
    for start in range(0, n, 512):
        y, rng = x[start : start + 512, None], np.random.default_rng(start)
        field[0, start : start + 512] = np.cos(x) * np.sin(y) + 0.3 * rng.standard_normal((len(y), n), np.float32)
        field[1, start : start + 512] = np.sin(x) * np.cos(y) + 0.3 * rng.standard_normal((len(y), n), np.float32)


def point(n: int, megabytes: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        write_field(Path(folder, "g.npy"), n)
        begin, start = own_megabytes(), time.perf_counter()
        with Watch() as watch:
            result = large.integrate(Path(folder, "g.npy"), Path(folder, "z.npy"), memory=megabytes * 2**20)
        row: dict[str, Any] = {"size": n, "memory": megabytes, "tile": result.tile}
        row |= {"seconds": time.perf_counter() - start, "own_megabytes": watch.most, "before_megabytes": begin}
        if n <= 4096:
            found = np.load(Path(folder, "z.npy"))
            whole = LeastSquares()(torch.from_numpy(np.load(Path(folder, "g.npy"))))[0].numpy()
            row["difference"] = float(np.abs(found - whole).max() / np.ptp(whole))
    return row


def write_surface(folder: Path, name: str, n: int, draw: int) -> None:
    """A surface with noise of 5 dB, and its heights."""
    surface = SURFACES[name](n, dtype=torch.float32)
    noisy = add_noise(surface.gradient, 5, torch.Generator().manual_seed(draw))
    np.save(folder / "g.npy", noisy[0].numpy())
    np.save(folder / "true.npy", surface.height[0, 0].numpy())


def method_of(recipe: str) -> Integrator:
    """SlopeDLS of a recipe, or DLS of so many iterations."""
    if recipe.startswith("dls"):
        return DLS(learner=SoupDIL(order="block"), select=False, n_iter=int(recipe[3:]))
    return SlopeDLS(recipe=recipe)  # type: ignore[arg-type]


def tiles(folder: Path, tile: int, recipe: str, whole_up_to: int) -> dict[str, Any]:
    """SlopeDLS or DLS by tiles of the surface in a folder."""
    torch.set_num_threads(1)
    begin, start, cpu = own_megabytes(), time.perf_counter(), time.process_time()
    with Watch() as watch:
        integrator = method_of(recipe)
        result = large.integrate(folder / "g.npy", folder / "z.npy", integrator=integrator, tile=tile)
    row: dict[str, Any] = {"recipe": recipe, "size": result.shape[0], "tile": tile, "tiles": result.tiles}
    row |= {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - cpu}
    row |= {"own_megabytes": watch.most, "before_megabytes": begin}
    true, g = np.load(folder / "true.npy"), torch.from_numpy(np.load(folder / "g.npy"))
    row["rmse"] = deviation(np.load(folder / "z.npy"), true)
    row["rmse_least_squares"] = deviation(LeastSquares()(g)[0].numpy(), true)
    if result.shape[0] <= whole_up_to:
        cpu = time.process_time()
        row["rmse_whole"] = deviation(integrator(g)[0].numpy(), true)
        row["cpu_seconds_whole"] = time.process_time() - cpu
    return row


def deviation(height: np.ndarray[Any, Any], true: np.ndarray[Any, Any]) -> float:
    """Root mean square of the error, less its mean."""
    return float((height - true.astype(np.float64)).std())


def measure_tiles(args: argparse.Namespace) -> list[dict[str, Any]]:
    rows = []
    for n, draw in product([96] if args.smoke else args.sizes, range(args.draws)):
        with tempfile.TemporaryDirectory() as folder:
            write_surface(Path(folder), args.surface, n, draw)
            tile = 16 if args.smoke else args.tile
            recipe = f"dls{args.iterations}" if args.method == "dls" else args.recipe
            given = folder, str(tile), recipe, str(args.whole)
            said = fresh_process("benchmarks.speed.large", "--tiles", *given)
        rows.append({"surface": args.surface, "draw": draw} | json.loads(said.splitlines()[-1]))
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--sizes", type=int, nargs="+", default=[2048, 4096, 8192, 16384])
    parser.add_argument("--memory", type=int, default=1024, help="megabytes (default: 1024)")
    parser.add_argument("--method", choices=("least_squares", "slope_dls", "dls"), default="least_squares")
    parser.add_argument("--surface", choices=SURFACES, default="tent", help="of slope_dls")
    parser.add_argument("--tile", type=int, default=512, help="of slope_dls and dls")
    parser.add_argument("--recipe", choices=("blend", "quick"), default="quick", help="of slope_dls")
    parser.add_argument("--iterations", type=int, default=3, help="of dls")
    parser.add_argument("--draws", type=int, default=1, help="of the noise, each as above")
    parser.add_argument("--whole", type=int, default=1024, help="the largest size that is made whole as well")
    parser.add_argument("--tiles", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--point", nargs=2, type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.point:
        print(json.dumps(point(*args.point)))
        return
    if args.tiles:
        print(json.dumps(tiles(Path(args.tiles[0]), int(args.tiles[1]), args.tiles[2], int(args.tiles[3]))))
        return
    if args.smoke or args.method != "least_squares":
        recipe = "dls" if args.method == "dls" else args.recipe
        name = f"large_tiles_{args.surface}_{recipe}_{args.tile}" + "_draws" * (args.draws > 1)
        write_json(results_folder(args.smoke) / f"{name}.json", points=measure_tiles(args))
        if not args.smoke:
            return
    rows = []
    for n in [96, 128] if args.smoke else args.sizes:
        said = fresh_process("benchmarks.speed.large", "--point", str(n), str(1 if args.smoke else args.memory))
        rows.append(json.loads(said.splitlines()[-1]))
        print(rows[-1], flush=True)
    write_json(results_folder(args.smoke) / "large.json", points=rows)


if __name__ == "__main__":
    main()
