"""Real normal maps with ground truth: `python -m benchmarks.quality.real_maps FOLDER` (without: a rendered stand-in).

FOLDER holds a folder for each object, with `normal_map.png` (x right, y up, z to the viewer), `mask.png`, `K.txt` (the
intrinsics, 3 x 3) and `depth_gt.npz` (`depth_gt`: the depth, NaN outside the object); objects of the DiLiGenT
photometric-stereo benchmark can be laid out so. Each map is integrated in perspective, as it is and with noise added to
its slopes. The measure is the field's: the depth is scaled by the median of truth / estimate, then the mean absolute
error (MADE), in the unit of the truth. Writes JSON and a Markdown table.
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
from torchdls import INTEGRATORS, add_noise, io, normals_to_gradient
from torchdls.geometry import log_depth_to_depth

METHODS: dict[str, dict[str, Any]] = {
    "least_squares": {},
    "slope_dls": {},
    "dls": {},
    "weighted_least_squares": {},
    "total_variation": {},
    "l1": {},
    "m_estimator": {},
    "mumford_shah": {},
}


class Object(NamedTuple):
    """A gradient of log depth (1, 2, H, W), its mask (1, 1, H, W) and the true depth (1, 1, H, W)."""

    name: str
    gradient: Tensor
    mask: Tensor
    depth: Tensor


def load(folder: Path) -> Object:
    field = io.load_field(folder / "normal_map.png")
    camera = io.load_camera(folder / "K.txt")
    truth = torch.from_numpy(np.load(folder / "depth_gt.npz")["depth_gt"]).double()[None, None]
    mask = io.load_mask(folder / "mask.png") & truth.isfinite()
    found = normals_to_gradient(field.values.double(), mask=mask, camera=camera)
    return window(Object(folder.name, found.gradient, found.mask, truth))


def window(whole: Object) -> Object:
    """Cut to the mask, with a border of one pixel; the gradient of log depth does not depend on where it lies."""
    rows, columns = (whole.mask[0, 0].any(d).nonzero().flatten() for d in (1, 0))
    down, across = (slice(max(int(i[0]) - 1, 0), int(i[-1]) + 2) for i in (rows, columns))
    part = (..., down, across)
    return Object(whole.name, whole.gradient[part], whole.mask[part], whole.depth[part])


def stand_in(n: int) -> Object:
    """A rounded relief on a disk, 1500 away."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64),) * 2, indexing="ij")
    depth = (1500 - 40 * torch.exp(-3 * (x**2 + y**2)) + 2 * torch.cos(9 * x) * torch.cos(7 * y))[None, None]
    gradient = torch.stack([torch.gradient(depth[0, 0].log(), dim=d)[0] for d in (1, 0)])[None]
    mask = (x**2 + y**2 < 0.8)[None, None]
    return Object("stand-in", torch.where(mask, gradient, 0), mask, depth)


def made(log_depth: Tensor, true: Object) -> float:
    """Mean absolute error of the depth after scaling by the median ratio."""
    inside = true.mask & true.depth.isfinite()
    depth, truth = log_depth_to_depth(log_depth)[inside], true.depth[inside]
    return float((depth * (truth / depth).median() - truth).abs().mean())


def run(objects: list[Object], snrs: list[float | None], methods: list[str]) -> list[dict[str, Any]]:
    rows = []
    for one in objects:
        for snr in snrs:
            gradient = one.gradient
            if snr is not None:
                gradient = add_noise(gradient, snr, torch.Generator().manual_seed(0), mask=one.mask)
            for name in methods:
                began = time.perf_counter()
                with torch.no_grad():
                    height = INTEGRATORS[name](**METHODS[name])(gradient, mask=one.mask)
                seconds = time.perf_counter() - began
                row = {"object": one.name, "pixels": int(one.mask.sum()), "snr": snr, "method": name}
                rows.append(row | {"made": made(height, one), "seconds": seconds})
                print(*rows[-1].values(), flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """A line for each method, a column for each object and noise level."""
    columns = list(dict.fromkeys((r["object"], r["snr"]) for r in rows))
    names = [f"{name}{'' if snr is None else f', {snr:g} dB'}" for name, snr in columns]
    lines = []
    for method in dict.fromkeys(r["method"] for r in rows):
        mine = {(r["object"], r["snr"]): r for r in rows if r["method"] == method}
        seconds = sum(r["seconds"] for r in mine.values()) / len(mine)
        lines.append([f"`{method}`", *(f"{mine[c]['made']:.2f}" for c in columns), f"{seconds:.1f}"])
    return markdown_table(["MADE", *names, "s each"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the objects")
    parser.add_argument("--smoke", action="store_true", help="the stand-in alone, small")
    parser.add_argument("--snr", type=float, nargs="*", default=[20.0, 10.0], help="noise added to the slopes, in dB")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.folder is not None and not args.smoke:
        objects = [load(p.parent) for p in sorted(args.folder.glob("*/normal_map.png"))]
        if not objects:
            raise SystemExit(f"{args.folder}: no folder in it holds a normal_map.png")
    else:
        objects = [stand_in(32 if args.smoke else 200)]
    rows = run(objects, [None, *args.snr], args.methods)
    out = args.out or results_folder(args.smoke or args.folder is None)
    path = write_json(out / "real.json", rows=rows)
    (out / "real.md").write_text(table(rows))
    print(table(rows), f"written: {path}", sep="\n")


if __name__ == "__main__":
    main()
