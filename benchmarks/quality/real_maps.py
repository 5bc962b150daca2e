"""Normal maps with true depth: `python -m benchmarks.quality.real_maps FOLDER` (without: scenes that were not fitted).

FOLDER holds a folder for each object, with `normal_map.png` (x right, y up, z to the viewer), `mask.png`, `K.txt` (the
intrinsics, 3 x 3) and `depth_gt.npz` (`depth_gt`: the depth, NaN outside the object) or `depth_gt.npy`; objects of the
DiLiGenT photometric-stereo benchmark can be laid out so. Without a folder, the scenes `UNSEEN` of `scenes.py` are
taken. Each map is integrated as it is, with noise of 5, 10 and 20 degrees (root mean square angle), and in 8 bits. The
measure is the field's: the depth is scaled by the median of truth / estimate, then the mean absolute error (MADE), in
the unit of the truth; for scenes seen from square to it, the mean absolute error less the median. Pixels that a noisy
normal turned away are not counted. Writes JSON and Markdown tables, and with --pictures an error map for each method
and the jumps of `piecewise`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.report import markdown_table, results_folder, write_json
from benchmarks.quality.scenes import FAMILIES, UNSEEN, Scene, eight_bits, noisy, scene
from torchdls import INTEGRATORS, io, normals_to_gradient
from torchdls.metrics import mean_absolute_depth_error

METHODS = ("least_squares", "bilateral", "slope_dls", "piecewise")
LEVELS = ("0", "5", "10", "20", "8bit")


class Run(NamedTuple):
    """A depth (1, 1, H, W), where it is there, the probability of jumps or None, and the seconds it took."""

    depth: Tensor
    mask: Tensor
    jump: Tensor | None
    seconds: float


def load(folder: Path) -> Scene:
    """One object, cut to its mask with a border of one pixel."""
    field, camera = io.load_field(folder / "normal_map.png"), io.load_camera(folder / "K.txt").double()
    truth = next(p for p in (folder / "depth_gt.npz", folder / "depth_gt.npy") if p.exists())
    depth = np.load(truth)
    depth = torch.from_numpy(depth["depth_gt"] if truth.suffix == ".npz" else depth).double()[None, None]
    mask = io.load_mask(folder / "mask.png") & depth.isfinite()
    normals = torch.nn.functional.normalize(torch.where(mask, field.values.double(), 0), dim=1)
    rows, columns = (mask[0, 0].any(d).nonzero().flatten() for d in (1, 0))
    top, left = (max(int(i[0]) - 1, 0) for i in (rows, columns))
    part = (..., slice(top, int(rows[-1]) + 2), slice(left, int(columns[-1]) + 2))
    moved = camera.clone()
    moved[0, 2] -= left
    moved[1, 2] -= top
    return Scene(folder.name, normals[part], mask[part], depth[part], moved)


def spoilt(one: Scene, level: str, seed: int) -> Tensor:
    """Its normals with noise of so many degrees, or in 8 bits."""
    return eight_bits(one.normals) if level == "8bit" else noisy(one.normals, float(level), seed)


def integrate(one: Scene, normals: Tensor, name: str) -> Run:
    """The depth by one method."""
    focal = None if one.camera is None else float(one.camera[0, 0])
    options: dict[str, Any] = {"bilateral": {"focal_length": focal or 1.0}, "piecewise": {"focal_length": focal}}
    began = time.process_time()
    field = normals_to_gradient(normals, mask=one.mask, camera=one.camera)
    with torch.no_grad():
        found = INTEGRATORS[name](**options.get(name, {})).solve(field.gradient, field.mask)
    seconds = time.process_time() - began
    depth = -found.height if one.camera is None else found.height.exp()
    return Run(depth, field.mask, getattr(found, "jump", None), seconds)


def aligned(one: Scene, run: Run) -> Tensor:
    """The depth in the unit of the truth: scaled by the median ratio, or moved by the median difference."""
    truth, depth = one.depth[run.mask], run.depth[run.mask]
    return run.depth + (truth - depth).median() if one.camera is None else run.depth * (truth / depth).median()


def error(one: Scene, run: Run) -> float:
    if one.camera is None:
        return float((aligned(one, run) - one.depth)[run.mask].abs().mean())
    return float(mean_absolute_depth_error(run.depth, torch.where(run.mask, one.depth, 1), run.mask))


def draw(one: Scene, runs: dict[str, Run], path: Path) -> None:
    """Error maps on one scale, and the jumps."""
    import matplotlib.pyplot as plt

    maps = {n: torch.where(r.mask, aligned(one, r) - one.depth, torch.nan)[0, 0].numpy() for n, r in runs.items()}
    most = max(float(np.nanquantile(np.abs(m), 0.98)) for m in maps.values())
    jumps = {n: r.jump[0].amax(0).numpy() for n, r in runs.items() if r.jump is not None}
    _, axes = plt.subplots(1, len(maps) + len(jumps) + 1, figsize=(3 * (len(maps) + len(jumps) + 1), 3.3))
    axes[0].imshow(((one.normals[0] + 1) / 2).movedim(0, -1).clamp(0, 1))
    for axis, (name, m) in zip(axes[1:], maps.items(), strict=False):
        axis.imshow(m, cmap="coolwarm", vmin=-most, vmax=most)
        axis.set_title(f"{name} {error(one, runs[name]):.3g}")
    for axis, (name, m) in zip(axes[1 + len(maps) :], jumps.items(), strict=False):
        axis.imshow(m, vmin=0, vmax=1)
        axis.set_title(f"jumps, {name}")
    for axis in axes:
        axis.axis("off")
    plt.tight_layout()
    plt.savefig(path, dpi=60)
    plt.close()


def measure(
    scenes: list[Scene], levels: list[str], methods: list[str], seeds: list[int], pictures: Path | None
) -> list[dict[str, Any]]:
    rows = []
    for one in scenes:
        for level in levels:
            for seed in seeds if level not in ("0", "8bit") else seeds[:1]:
                normals = spoilt(one, level, seed)
                runs = {name: integrate(one, normals, name) for name in methods}
                about = {"object": one.name, "level": level, "seed": seed, "pixels": int(one.mask.sum())}
                for name, run in runs.items():
                    rows.append(about | {"method": name, "made": error(one, run), "seconds": run.seconds})
                print(one.name, level, seed, *(f"{n} {error(one, r):.4g}" for n, r in runs.items()), flush=True)
                if pictures is not None and seed == seeds[0]:
                    pictures.mkdir(parents=True, exist_ok=True)
                    draw(one, runs, pictures / f"{one.name}_{level}.png")
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """A table for each level: a line for each object, a column for each method; means over the seeds."""
    parts = []
    methods = list(dict.fromkeys(r["method"] for r in rows))
    for level in dict.fromkeys(r["level"] for r in rows):
        here = [r for r in rows if r["level"] == level]
        lines = []
        for name in dict.fromkeys(r["object"] for r in here):
            lines.append([name, *(_mean(here, "made", object=name, method=m) for m in methods)])
        lines.append(["CPU s each", *(_mean(here, "seconds", method=m) for m in methods)])
        title = {"0": "as they are", "8bit": "8 bits"}.get(level, f"noise of {level} degrees")
        parts.append(f"### {title}\n\n{markdown_table(['MADE', *methods], lines)}")
    return "\n".join(parts)


def _mean(rows: list[dict[str, Any]], what: str, **which: str) -> str:
    found = [r[what] for r in rows if all(r[k] == v for k, v in which.items())]
    return f"{sum(found) / len(found):.3g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the objects")
    parser.add_argument("--smoke", action="store_true", help="two small scenes, without noise")
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), choices=list(LEVELS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of the noise")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(INTEGRATORS))
    parser.add_argument("--size", type=int, default=128, help="of the scenes")
    parser.add_argument("--scenes", nargs="+", help="such as rooms-1000, in place of all unseen ones")
    parser.add_argument("--pictures", type=Path, help="folder for pictures")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    levels = ["0"] if args.smoke else args.levels
    if args.folder is not None and not args.smoke:
        scenes = [load(p.parent) for p in sorted(args.folder.glob("*/normal_map.png"))]
        if not scenes:
            raise SystemExit(f"{args.folder}: no folder in it holds a normal_map.png")
    else:
        names = args.scenes or [f"{family}-{seed}" for seed in UNSEEN for family in FAMILIES]
        names, size = (("ramps-0", "smooth-0"), 32) if args.smoke else (names, args.size)
        scenes = [scene(name.split("-")[0], int(name.split("-")[1]), size) for name in names]
    rows = measure(scenes, levels, args.methods, args.seeds, args.pictures)
    out = args.out or results_folder(args.smoke or args.folder is None)
    out.mkdir(parents=True, exist_ok=True)
    path = write_json(out / "real.json", rows=rows)
    (out / "real.md").write_text(table(rows))
    print(table(rows), f"written: {path}", sep="\n")


if __name__ == "__main__":
    main()
