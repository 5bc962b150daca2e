"""Off the full square with white noise: `python -m benchmarks.quality.conditions` (--smoke, --quick, --method DLS).

Larger surfaces, masks, terrain at three smoothings, noise of other kinds than is assumed, and gross errors. A row is a
surface under a condition at a noise level: RMSE (and 1 - SSIM) of least squares over those of the method, means over
fresh draws of noise from seed 2100 on, on which nothing was chosen. With a folder of objects (see `real_maps`) their
masks are among the masks. Writes JSON with every row and a Markdown table.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from benchmarks.common.report import markdown_table, results_folder, write_json
from torchdls import DLS, SURFACES, Integrator, LeastSquares, SlopeDLS, Surface, add_noise, io, rmse, ssim
from torchdls.noise import noise_sigma
from torchdls.surfaces import terrain

Damage = Callable[[Tensor, int, int], Tensor]  # of a clean gradient, at a noise level, by a seed


class Case(NamedTuple):
    """A surface under a condition."""

    condition: str
    surface: Surface
    damage: Damage
    mask: Tensor | None = None


def seeded(seed: int, snr: int) -> torch.Generator:
    return torch.Generator().manual_seed(977 * seed + snr)


METHODS: dict[str, Integrator] = {"SlopeDLS": SlopeDLS(), "SlopeDLS.fast": SlopeDLS.fast(), "DLS": DLS()}
# Against gross errors.
ROBUST: dict[str, Integrator] = {"SlopeDLS": SlopeDLS(robust=True), "SlopeDLS.fast": SlopeDLS.fast(robust=True)}


def white(clean: Tensor, snr: int, seed: int) -> Tensor:
    return add_noise(clean, snr, seeded(seed, snr))


def blurred(clean: Tensor, snr: int, seed: int) -> Tensor:
    """White noise averaged over 3 x 3 pixels, brought back to its level."""
    noise = white(clean, snr, seed) - clean
    smooth = functional.avg_pool2d(functional.pad(noise, (1, 1, 1, 1), mode="replicate"), 3, 1)
    return clean + smooth * (noise.std() / smooth.std())


def signal_dependent(clean: Tensor, snr: int, seed: int) -> Tensor:
    """Noise that grows from half to one and a half of its level with the steepness."""
    steep = clean.norm(dim=1, keepdim=True)
    factor = 0.5 + steep / steep.max().clamp(min=1e-9)
    return clean + factor * (white(clean, snr, seed) - clean)


def eight_bits(clean: Tensor, snr: int, seed: int) -> Tensor:
    """The normals of the noisy slopes in 8 bits a channel."""
    noisy = white(clean, snr, seed)
    normals = functional.normalize(torch.cat([-noisy, torch.ones_like(noisy[:, :1])], 1), dim=1)
    coded = ((normals + 1) * 127.5).round() / 127.5 - 1
    return -coded[:, :2] / coded[:, 2:].clamp(min=1 / 255)


def tilted(clean: Tensor, snr: int, seed: int) -> Tensor:
    """A constant error of both slopes as large as the noise."""
    return white(clean, snr, seed) + noise_sigma(clean, snr)[:, None, None, None]


def gross(share: float) -> Damage:
    """A share of the samples wrong by 10 times the root mean square of the slopes."""

    def damage(clean: Tensor, snr: int, seed: int) -> Tensor:
        noisy, g = white(clean, snr, seed), seeded(seed, snr + 500)
        wrong = torch.rand(clean[:, :1].shape, generator=g) < share
        size = 10 * clean.square().mean().sqrt()
        return torch.where(wrong, noisy + size * torch.randn(clean.shape, generator=g), noisy)

    return damage


def masks(n: int, folder: Path | None) -> dict[str, Tensor]:
    """A disk, a ring, holes, and the outlines of objects."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n),) * 2, indexing="ij")
    r, holes = x.square() + y.square(), torch.ones(n, n, dtype=torch.bool)
    for k in range(12):
        cx, cy = math.sin(7.1 * k + 1), math.cos(4.3 * k)
        holes &= (x - cx).square() + (y - cy).square() > (0.05 + 0.01 * k) ** 2
    found = {"disk": r < 0.8, "ring": (r < 0.9) & (r > 0.25), "holes": holes}
    for path in sorted(folder.glob("*/mask.png")) if folder else ():
        whole = io.load_mask(path)[0, 0].float()
        rows, columns = (whole.any(d).nonzero().flatten() for d in (1, 0))
        part = whole[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        found[path.parent.name] = functional.interpolate(part[None, None], (n, n), mode="area")[0, 0] > 0.5
    return {name: mask[None, None] for name, mask in found.items()}


def surface(name: str, n: int) -> Surface:
    return terrain(n) if name == "terrain" else SURFACES[name](n)


def cases(n: int, names: Sequence[str], large: int, folder: Path | None) -> Iterator[Case]:
    for name in names:
        yield Case(f"{large} x {large}", surface(name, large), white)
    for kind, mask in masks(n, folder).items():
        yield from (Case(f"mask: {kind}", surface(name, n), white, mask) for name in names)
    for smoothing in (1.0, 2.0, 4.0):
        yield Case(f"terrain, smoothing {smoothing:g}", terrain(n, smoothing=smoothing), white)
    wrong = {"blurred": blurred, "signal-dependent": signal_dependent, "8 bits": eight_bits, "tilt": tilted}
    for kind, damage in wrong.items():
        yield from (Case(f"noise: {kind}", surface(name, n), damage) for name in names)
    for share in (0.01, 0.03, 0.1):
        yield from (Case(f"gross errors: {share:.0%}", surface(name, n), gross(share)) for name in names)


def measure(case: Case, snrs: Sequence[int], seeds: Sequence[int], chosen: Sequence[str]) -> Iterator[dict[str, Any]]:
    """A row for every method and level."""
    clean, mask = case.surface.gradient, case.mask
    gradient = torch.cat([case.damage(clean, snr, k) for snr in snrs for k in seeds])
    truth = case.surface.height.expand(len(gradient), -1, -1, -1)
    if case.damage is tilted:  # the plane that it adds belongs to the data
        truth = truth + LeastSquares()(gradient - torch.cat([white(clean, s, k) for s in snrs for k in seeds]))

    def errors(z: Tensor) -> tuple[Tensor, Tensor]:
        similar = ssim(z, truth, case.surface.data_range, None if mask is None else mask.expand_as(z))
        level, seen = (e.view(len(snrs), -1).mean(1) for e in (rmse(z, truth, mask), 1 - similar))
        return level, seen

    methods = METHODS | (ROBUST if case.condition.startswith("gross") else {})
    plain = errors(LeastSquares()(gradient, mask))
    for name in chosen:
        found = errors(methods[name](gradient, mask))
        for k, snr in enumerate(snrs):
            gains = [float(a[k] / b[k].clamp(min=1e-9)) for a, b in zip(plain, found, strict=True)]
            robust = "robust " if methods[name] is not METHODS[name] else ""
            row = {"condition": case.condition, "surface": case.surface.name, "snr": snr, "method": robust + name}
            yield row | {"rmse": gains[0], "1-ssim": gains[1], "rmse_error": float(found[0][k])}


def table(rows: list[dict[str, Any]]) -> str:
    """Geometric means over the surfaces (RMSE / 1-SSIM), the worst row as method over least squares."""
    snrs, lines = sorted({r["snr"] for r in rows}), []
    for condition, method in dict.fromkeys((r["condition"], r["method"]) for r in rows):
        mine = [r for r in rows if (r["condition"], r["method"]) == (condition, method)]

        def mean(chosen: list[dict[str, Any]], key: str) -> float:
            return math.exp(sum(math.log(r[key]) for r in chosen) / len(chosen))

        by_level = [[r for r in mine if r["snr"] == s] for s in snrs]
        cells = [f"{mean(level, 'rmse'):.2f} / {mean(level, '1-ssim'):.2f}" for level in by_level]
        worst = " / ".join(f"{1 / min(r[key] for r in mine):.2f}" for key in ("rmse", "1-ssim"))
        lines.append([condition, method, *cells, worst])
    return markdown_table(["condition", "gain of", *(f"{s} dB" for s in snrs), "worst row"], lines)


def every_row(rows: list[dict[str, Any]]) -> str:
    snrs = sorted({r["snr"] for r in rows})
    found = {(r["condition"], r["surface"], r["method"], r["snr"]): r for r in rows}
    lines = [
        [*key, *(f"{found[*key, s]['rmse']:.2f} / {found[*key, s]['1-ssim']:.2f}" for s in snrs)]
        for key in dict.fromkeys(k[:3] for k in found)
    ]
    return markdown_table(["condition", "surface", "gain of", *(f"{s} dB" for s in snrs)], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of objects, for their masks")
    parser.add_argument("--smoke", action="store_true", help="one small surface, one level: does it run?")
    parser.add_argument("--quick", action="store_true", help="six surfaces instead of fifteen, one draw instead of two")
    parser.add_argument("--first-seed", type=int, default=2100)
    parser.add_argument("--method", nargs="+", choices=METHODS, default=["SlopeDLS", "SlopeDLS.fast"])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    some = ("tent", "sphere", "gaussians", "steps", "chirp", "terrain")
    names: Sequence[str] = ("tent",) if args.smoke else some if args.quick else (*SURFACES, "terrain")
    n, large, snrs = (64, 72, [10]) if args.smoke else (96, 200, [5, 20])
    seeds = range(args.first_seed, args.first_seed + (1 if args.smoke or args.quick else 2))
    rows: list[dict[str, Any]] = []
    with torch.no_grad():
        for case in cases(n, names, large, args.folder):
            found = [*measure(case, snrs, seeds, args.method)]
            print(case.condition, case.surface.name, *(f"{r['rmse']:.3f}" for r in found), flush=True)
            rows += found
    out = args.out or results_folder(args.smoke)
    path = write_json(out / "conditions.json", settings={"snr": snrs, "seeds": [*seeds], "size": n}, rows=rows)
    note = f"RMSE / 1-SSIM of least squares over that of the method, {n} x {n}, draws {seeds[0]} to {seeds[-1]}.\n\n"
    (out / "conditions.md").write_text(note + table(rows) + "\n" + every_row(rows))
    print(table(rows), f"written: {path}", sep="\n")


if __name__ == "__main__":
    main()
