"""One row per method: `python -m benchmarks.quality.methods` (add --smoke for a smoke run).

Every integrator with its defaults, and those forms of some that are not, on a smooth surface, a creased one, one that
jumps, and the smooth one with outliers: RMSE in pixels and seconds of a core, means over fresh noise. Slopes of 20 dB;
the jump is a lower half that rises from the upper one, tied to it at the left; outliers are 2 % of the samples, off by
20 times the root mean square slope. Writes JSON and a table; `--docs` runs nothing, and puts the figures of the JSON
into the table of docs/which.md, as errors beside that of least squares.
"""

from __future__ import annotations

import argparse
import json
import re
import time
import warnings
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.common.report import ROOT, made_by, markdown_table, results_folder, write_json
from torchdls import (
    INTEGRATORS,
    SURFACES,
    AnisotropicDiffusion,
    Integrator,
    MEstimator,
    MumfordShah,
    SlopeDLS,
    add_noise,
    rmse,
)

SNR = 20
# What is compared with: rows above all others.
FIRST = ("least_squares", "l1", "slope_dls")
# Forms that are not the default.
FORMS: dict[str, Integrator] = {
    "slope_dls (robust)": SlopeDLS(robust=True),
    "m_estimator (joint)": MEstimator(joint=True),
    "anisotropic_diffusion (follow = field)": AnisotropicDiffusion(follow="field"),
    "mumford_shah (4 indicators)": MumfordShah(indicators=4),
}


def fields(size: int, seed: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Kind -> slopes and the true height."""
    generator = torch.Generator().manual_seed(seed)
    smooth, creased = SURFACES["peaks"](size), SURFACES["tent"](size)

    def noisy(gradient: Tensor) -> Tensor:
        return add_noise(gradient, SNR, generator)

    ramp = torch.linspace(0, size / 8, size)
    hinged, slopes = smooth.height.clone(), smooth.gradient.clone()
    hinged[..., size // 2 :, :] += ramp  # tied at the left, apart at the right
    slopes[:, 0, size // 2 :] += ramp[1] - ramp[0]
    calm = noisy(smooth.gradient)
    bad = torch.rand(calm.shape, generator=generator) < 0.02
    wild = 20 * smooth.gradient.square().mean().sqrt() * torch.randn(calm.shape, generator=generator)
    return {
        "smooth": (calm, smooth.height),
        "creased": (noisy(creased.gradient), creased.height),
        "jumping": (noisy(slopes), hinged),
        "outliers": (torch.where(bad, calm + wild, calm), smooth.height),
    }


def into_docs() -> None:
    """The last column of the table of docs/which.md, and the line that says where it is from."""
    found = json.loads((ROOT / "results" / "methods.json").read_text())
    errors = {name: values for name, *values, _ in found["rows"]}
    path = ROOT.parent / "docs" / "which.md"
    lines = path.read_text(encoding="utf-8").splitlines()
    for i, line in enumerate(lines):
        if match := re.match(r"(\| `(\w+)` \| `\w+` \| .*?) \|(?: [\d. /]+ \|)?$", line):
            shares = [a / b for a, b in zip(errors[match[2]], errors["least_squares"], strict=True)]
            lines[i] = f"{match[1]} | {' / '.join(f'{s:.2f}' for s in shares)} |"
            last = i
    made = f"Made by `python -m benchmarks.quality.methods` at {found['environment']['commit']}."
    if lines[last + 2].startswith("Made by"):
        lines[last + 2] = made
    else:
        lines[last + 1 : last + 1] = ["", made]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small surfaces, one draw: does it run?")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=3, help="noise draws per row")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--docs", action="store_true", help="only put the figures of the last run into docs/which.md")
    args = parser.parse_args()
    if args.docs:
        return into_docs()
    size, seeds = (20, 1) if args.smoke else (args.size, args.seeds)
    draws = [fields(size, 9000 + seed) for seed in range(seeds)]
    rows = []
    methods = {name: INTEGRATORS[name]() for name in (*FIRST, *(n for n in INTEGRATORS if n not in FIRST))}
    for name, method in (methods | FORMS).items():
        errors: list[float] = []
        start = time.process_time()
        with torch.no_grad(), warnings.catch_warnings(action="ignore"):
            for kind in draws[0]:
                gradient, truth = (torch.cat([d[kind][part] for d in draws]) for part in (0, 1))
                errors.append(float(rmse(method(gradient), truth).mean()))
        rows.append([name, *errors, (time.process_time() - start) / (4 * seeds)])
        print(*rows[-1], flush=True)
    out = args.out or results_folder(args.smoke)
    header = ["method", *draws[0], "seconds each"]
    table = markdown_table(header, rows)
    write_json(out / "methods.json", settings={"size": size, "snr": SNR, "seeds": seeds}, header=header, rows=rows)
    text = f"# Every method with its defaults\n\nRMSE in pixels, {size} x {size}, {SNR} dB, means of {seeds} draws.\n\n"
    (out / "methods.md").write_text(f"{text}{table}\n{made_by('benchmarks.quality.methods')}")


if __name__ == "__main__":
    main()
