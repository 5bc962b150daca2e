"""What each learner is worth: `python -m benchmarks.quality.learners` (add --smoke for a smoke run).

Planted dictionaries: patches of two atoms each, of 24 random ones (for `unitary` and `fixed` 16 orthonormal ones, for
`dino_kat` of rank 1, where `soup_dil` has a second row), under noise; the part of the planted atoms that 60 passes find
(|<d, atom>| > .99) from a start of patches, against the noise. Surfaces: DLS (the paper's iteration, select=False) with
each learner, the error of least squares over its own. Writes JSON and tables.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from torchdls import DLS, KSVD, LEARNERS, SURFACES, DinoKat, LeastSquares, add_noise, rmse, ssim

SIDE, ATOMS, NONZEROS = 4, 24, 2
SQUARE = ("unitary", "fixed")  # learners of orthonormal dictionaries
FLAT = "dino_kat", "soup_dil, rank 1"  # rows of atoms of rank 1


def learner(name: str) -> Any:
    """Each by its defaults, but that what counts nonzeros knows how many there are."""
    made = {"k_svd": lambda: KSVD(n_nonzero=NONZEROS), "dino_kat": lambda: DinoKat(rank=1, patch_size=(SIDE, SIDE))}
    return made.get(name, LEARNERS[name.partition(",")[0]])()


def unit(d: Tensor) -> Tensor:
    return d / d.norm(dim=0, keepdim=True)


def recovered(name: str, snr: float, patches: int, passes: int, seed: int) -> float:
    """Part of the planted atoms that are found."""
    generator, n = torch.Generator().manual_seed(seed), SIDE**2
    count = n if name in SQUARE else ATOMS
    atoms = unit(torch.randn(n, count, generator=generator).double())
    atoms = torch.linalg.qr(atoms).Q if name in SQUARE else atoms
    if name in FLAT:
        left, right = torch.randn(2, SIDE, count, generator=generator).double()
        atoms = unit(torch.einsum("ik,jk->ijk", left, right).flatten(0, 1))
    support = torch.rand(count, patches, generator=generator).argsort(0) < NONZEROS
    size = (1 + torch.rand(count, patches, generator=generator)) * torch.randn(
        count, patches, generator=generator
    ).sign()
    clean = atoms @ (support * size).double()
    noise = torch.randn(clean.shape, generator=generator).double()
    P = (clean + noise * clean.norm() / noise.norm() * 10 ** (-snr / 20))[None]
    D = unit(P[0, :, :count])[None]
    D = torch.linalg.qr(D).Q if name in SQUARE else D
    B, made = P.new_zeros(1, count, patches), learner(name)
    for _ in range(passes):
        _, D, B = made(P - D @ B, D, B, 0.8)
    return float(((D[0].mT @ atoms).abs().amax(0) > 0.99).double().mean())


def gains(name: str, surface: str, snr: int, size: int, seeds: int) -> tuple[float, float]:
    """RMSE and 1 - SSIM of least squares over those of DLS."""
    truth = SURFACES[surface](size)
    draws = [add_noise(truth.gradient, snr, torch.Generator().manual_seed(9100 + s)) for s in range(seeds)]
    heights = [m(torch.cat(draws)) for m in (LeastSquares(), DLS(select=False, learner=LEARNERS[name](), n_iter=30))]
    h = truth.height.expand_as(heights[0])
    errors = [(float(rmse(z, h).mean()), float((1 - ssim(z, h, truth.data_range)).mean())) for z in heights]
    return errors[0][0] / errors[1][0], errors[0][1] / errors[1][1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="few patches, small surfaces: does it run?")
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--seeds", type=int, default=2, help="noise draws per row")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    levels = [10] if args.smoke else [10, 20, 30]
    size, seeds, patches, passes = (16, 1, 60, 2) if args.smoke else (args.size, args.seeds, 800, 60)
    planted: list[list[Any]] = []
    surfaces: list[list[Any]] = []
    with torch.no_grad():
        for name in (*LEARNERS, FLAT[1]):
            shares = [sum(recovered(name, s, patches, passes, 9200 + i) for i in range(seeds)) / seeds for s in levels]
            planted.append([name, *shares])
            if name not in LEARNERS:
                continue
            pairs = [gains(name, s, snr, size, seeds) for s in ("tent", "peaks") for snr in (5, 20)]
            surfaces.append([name, *(f"{a:.2f} / {b:.2f}" for a, b in pairs)])
            print(planted[-1], surfaces[-1], flush=True)
    out, by = args.out or results_folder(args.smoke), made_by("benchmarks.quality.learners")
    write_json(out / "learners.json", settings={"size": size, "seeds": seeds}, planted=planted, surfaces=surfaces)
    columns = ["learner", *(f"{s} dB" for s in levels)], ["learner", "Tent, 5 dB", "20 dB", "Peaks, 5 dB", "20 dB"]
    tables = [markdown_table(c, rows) for c, rows in zip(columns, (planted, surfaces), strict=True)]
    found = (
        "Part of the planted atoms that are found, against the noise of the patches; `unitary` and `fixed` have "
        "orthonormal atoms, `dino_kat` and the last row atoms of rank 1."
    )
    gained = f"Gain of DLS over least squares (RMSE / 1 - SSIM), {size} x {size}."
    text = f"# What each learner is worth\n\n{found}\n\n{tables[0]}\n{by}\n{gained}\n\n{tables[1]}\n{by}"
    (out / "learners.md").write_text(text)


if __name__ == "__main__":
    main()
