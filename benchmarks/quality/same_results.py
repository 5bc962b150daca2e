"""Are the heights of every integrator those of another commit? `python -m benchmarks.quality.same_results c832d47`.

The registry runs on fixed inputs (full, masked with holes, weighted, anchored; float32 and float64), once with this
tree and once with the other commit, checked out into a scratch folder. A table says how far the heights differ, as a
part of their range. `--smoke` compares this tree with itself, on small inputs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.report import markdown_table

ROOT = Path(__file__).resolve().parents[2]
KINDS = ("full", "masked", "weighted", "anchored")


def inputs(kind: str, dtype: torch.dtype, size: int) -> dict[str, Tensor]:
    """Two noisy fields of unequal sides, with what the kind brings besides."""
    g = torch.Generator().manual_seed(1)
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64) for n in (size, size + 7)), indexing="ij")
    slopes = torch.stack([torch.cos(3 * x) * torch.sin(2 * y), 0.6 * torch.sin(3 * x) * torch.cos(2 * y)])
    field = slopes + 0.1 * torch.randn(2, 2, *x.shape, generator=g, dtype=torch.float64)
    inside = ((x.square() + y.square() < 0.9) & ((x - 0.2).square() + y.square() > 0.05)).expand(2, 1, -1, -1)
    weight = 0.1 + torch.rand(2, 1, *x.shape, generator=g, dtype=torch.float64)
    extra = {
        "full": {},
        "masked": {"mask": inside},
        "weighted": {"weight": weight.to(dtype)},
        "anchored": {"anchor": weight.to(dtype), "anchor_weight": (0.01 * inside).to(dtype)},
    }
    return {"gradient": field.to(dtype), **extra[kind]}


def heights(size: int) -> dict[str, np.ndarray]:
    """Of every integrator, input and precision; integrators leave out what they cannot honour."""
    from torchdls import INTEGRATORS

    found = {}
    warnings.simplefilter("ignore")
    for name in INTEGRATORS:
        for kind in KINDS:
            for dtype in (torch.float64, torch.float32):
                try:
                    height = INTEGRATORS[name]()(**inputs(kind, dtype, size))
                except ValueError:
                    continue
                found[f"{name} {kind} {str(dtype).removeprefix('torch.')}"] = height.double().numpy()
    return found


def of_tree(tree: Path, size: int, scratch: Path) -> dict[str, np.ndarray]:
    """The same by the package of another tree, in a process of its own."""
    code = """import sys, numpy
tree, root, target, size = sys.argv[1:]
sys.path.insert(0, tree)
import torchdls  # of the other tree; the benchmark itself is this tree's
sys.path[0] = root
from benchmarks.quality.same_results import heights
assert torchdls.__file__.startswith(tree), torchdls.__file__
numpy.savez(target, **heights(int(size)))"""
    target = scratch / f"{len(list(scratch.iterdir()))}.npz"
    environment = {**os.environ, "PYTHONPATH": "", "OMP_NUM_THREADS": "1"}  # two of two threads would spin
    command = [sys.executable, "-c", code, str(tree), str(ROOT), str(target), str(size)]
    subprocess.run(command, cwd=scratch, env=environment, check=True)
    with np.load(target) as content:
        return dict(content)


def compare(mine: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> list[list[str]]:
    """A row per method: the largest difference over the kinds of input, as a part of the range."""
    rows: dict[str, dict[str, float]] = {}
    for key, ours in mine.items():
        name, _, dtype = key.split()
        gap = float("inf") if key not in theirs else float(np.abs(ours - theirs[key]).max() / np.ptp(ours))
        row = rows.setdefault(name, {})
        row[dtype] = max(row.get(dtype, 0.0), gap)
    return [[name, *(f"{row[d]:.1e}" for d in ("float64", "float32"))] for name, row in rows.items()]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commit", nargs="?", default="HEAD")
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--smoke", action="store_true")
    arguments = parser.parse_args()
    size = 16 if arguments.smoke else arguments.size
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        mine = of_tree(ROOT, size, scratch)
        other = scratch / "tree"
        if arguments.smoke:
            other = ROOT
        else:
            subprocess.run(["git", "worktree", "add", "--detach", str(other), arguments.commit], cwd=ROOT, check=True)
        try:
            rows = compare(mine, of_tree(other, size, scratch))
        finally:
            if not arguments.smoke:
                subprocess.run(["git", "worktree", "remove", "--force", str(other)], cwd=ROOT, check=True)
    print(markdown_table(["integrator", "float64", "float32"], rows))


if __name__ == "__main__":
    main()
