"""Fit the prior of `Piecewise` for cuts: `python -m benchmarks.quality.fit_jump_prior` (minutes).

Every edge of the fitted scenes is a row, once for each direction: its features, and whether the depth jumps there with
that side nearer (by more than a pixel beyond what the slopes of both ends allow). The scenes are seen clean, blurred
a little and with noise that was coded, as `Piecewise` sees them. The coefficients of a logistic regression (ridge 1)
that are quadratic in the noise are written into the package; a table of predicted and observed frequencies on the
scenes that were not fitted is printed, and drawn with --plot.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import pairwise
from math import radians
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import torchdls
from benchmarks.quality.scenes import FAMILIES, FITTED, UNSEEN, Scene, noisy, scene
from torchdls.dictionary.normals import blur
from torchdls.integrators.fields import Fields
from torchdls.integrators.piecewise.measured import measure
from torchdls.integrators.piecewise.prior import NAMES, Prior, continued, features, fitted

DEGREES = (0.4, 2.0, 5.0, 10.0, 20.0)
WHERE = Path(torchdls.__file__).parent / "integrators" / "piecewise" / "jump_prior.json"
KEPT = 0.02  # share of the edges that are not cut that is used, with as much more weight


class Rows(NamedTuple):
    """(n, F) features, (n,) label, contours that go on, noise in radians, and weight."""

    phi: Tensor
    cut: Tensor
    around: Tensor
    noise: Tensor
    weight: Tensor


def slopes_of(one: Scene, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes of the depth in pixels, and the mask."""
    found = torchdls.normals_to_gradient(normals, mask=one.mask, camera=one.camera)
    scale = -1.0 if one.camera is None else float(one.camera[0, 0])
    return scale * found.gradient, found.mask


def true_depth(one: Scene) -> Tensor:
    depth = torch.where(one.mask, one.depth, 1)
    return depth if one.camera is None else float(one.camera[0, 0]) * depth.log()


def views(one: Scene, seed: int, degrees: tuple[float, ...] = DEGREES) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Slopes, mask and noise left, for each level; clean ones also blurred."""
    for level in degrees:
        for width in (0.0, 0.6) if level < 1 else (0.0,):
            n = one.normals
            if width:
                n = torch.nn.functional.normalize(blur(torch.where(one.mask, n, 0), width), dim=1)
            n, sigma = noisy(n, level, seed), torch.zeros(1, dtype=n.dtype)
            if level > 1:
                sigma = torch.full_like(sigma, radians(level) / 2**0.5)
                n = torchdls.denoise_normals(n, one.mask, sigma).normals
            yield *slopes_of(one, n), sigma


def rows(scenes: list[Scene], degrees: tuple[float, ...] = DEGREES) -> Rows:
    found = []
    generator = torch.Generator().manual_seed(0)
    for seed, one in enumerate(scenes):
        p, mask = slopes_of(one, one.normals)
        true = measure(p, Fields(p, mask, None, None, None, (1, 1)), torch.zeros(1))
        y = true_depth(one)
        d = torchdls.operators.GradientOperator("forward")(y)
        low, high = true.slopes.amin(1), true.slopes.amax(1)
        jump = d - torch.minimum(torch.maximum(d, low), high)
        around = continued((jump.abs() > 1).double(), true.live)
        for p, mask, sigma in views(one, seed, degrees):
            m = measure(p, Fields(p, mask, None, None, None, (1, 1)), sigma)
            phi = features(m)[0].movedim(1, -1)
            drawn = torch.rand(m.live.shape[1:], generator=generator) < KEPT
            for direction, cut in enumerate(((jump > 1)[0], (jump < -1)[0])):
                kept = (m.live & true.live)[0] & (drawn | cut)
                label = cut[kept].double()
                weight = torch.where(label > 0, 1, 1 / KEPT)
                found.append(Rows(phi[direction][kept], label, around[0][kept], sigma.expand(len(label)), weight))
    return Rows(*(torch.cat(part) for part in zip(*found, strict=True)))


def design(data: Rows, coupled: bool) -> Tensor:
    x = torch.cat([data.phi, data.around[:, None]], 1) if coupled else data.phi
    s = (torch.rad2deg(data.noise) * 2**0.5 / 10)[:, None, None]
    return (torch.cat([torch.ones_like(s), s, s * s], 1) * x[:, None]).flatten(1)


def logistic(x: Tensor, y: Tensor, weight: Tensor, ridge: float = 1.0, n_iter: int = 40) -> Tensor:
    """Coefficients by Newton's method with bounded steps."""
    theta = torch.zeros(x.shape[1], dtype=x.dtype)
    theta[0] = -5
    eye = torch.eye(len(theta), dtype=x.dtype)
    for _ in range(n_iter):
        q = (x @ theta).clamp(-30, 30).sigmoid()
        step = torch.linalg.solve(
            (x.mT * (weight * q * (1 - q))) @ x + ridge * eye, x.mT @ (weight * (y - q)) - ridge * theta
        )
        step = step * min(1.0, 3 / float(step.abs().max()))
        theta = theta + step
        if float(step.abs().max()) < 1e-4:
            break
    return theta


def fit(data: Rows) -> Prior:
    width = data.phi.shape[1]
    alone, coupled = (logistic(design(data, c), data.cut, data.weight) for c in (False, True))
    return Prior(alone.view(3, width), coupled.view(3, width + 1))


def predicted(data: Rows, prior: Prior, coupled: bool) -> Tensor:
    theta = (prior.coupled if coupled else prior.alone).flatten()
    return (design(data, coupled) @ theta).clamp(-30, 30).sigmoid()


def calibration(q: Tensor, data: Rows) -> list[tuple[float, float, int]]:
    """Mean prediction, share of cuts and number of edges, in bins of the prediction."""
    edges = [0, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.6, 1.01]
    bins = [(q >= a) & (q < b) for a, b in pairwise(edges)]
    return [(mean(q[b], data.weight[b]), mean(data.cut[b], data.weight[b]), int(b.sum())) for b in bins if b.any()]


def mean(x: Tensor, weight: Tensor) -> float:
    return float((weight * x).sum() / weight.sum())


def loss(q: Tensor, data: Rows) -> float:
    return -mean(data.cut * q.log() + (1 - data.cut) * (1 - q).log(), data.weight)


def report(prior: Prior, seeds: tuple[int, ...], size: int) -> dict[str, list[tuple[float, float, int]]]:
    tables = {}
    for family in FAMILIES:
        data = rows([scene(family, seed, size) for seed in seeds])
        q = predicted(data, prior, False)
        rate = torch.full_like(q, mean(data.cut, data.weight))
        tables[family] = calibration(q, data)
        print(f"{family}: log loss {loss(q, data):.5f}, coupled {loss(predicted(data, prior, True), data):.5f},")
        print(f"   constant {loss(rate, data):.5f}; predicted:observed (edges)", end=" ")
        print(" ".join(f"{a:.4f}:{b:.4f}({n})" for a, b, n in tables[family]), flush=True)
    return tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the coefficients into the package")
    parser.add_argument("--check", action="store_true", help="no fit: the calibration of those in the package")
    parser.add_argument("--plot", type=Path, help="draw the calibration")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--smoke", action="store_true", help="small and few")
    args = parser.parse_args()
    size, seeds, unseen = (32, FITTED[:1], UNSEEN[:1]) if args.smoke else (args.size, FITTED, UNSEEN)
    scenes = [] if args.check else [scene(family, seed, size) for family in FAMILIES for seed in seeds]
    prior = fitted() if args.check else fit(rows(scenes))
    print("coefficients without noise:", dict(zip(NAMES, prior.alone[0].numpy().round(3).tolist(), strict=True)))
    if args.write and not args.check:
        data = {"names": NAMES, **{k: v.numpy().round(5).tolist() for k, v in prior._asdict().items()}}
        WHERE.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    tables = report(prior, unseen, size)
    if args.plot:
        import matplotlib.pyplot as plt

        for family, table in tables.items():
            plt.loglog([max(a, 1e-5) for a, _, _ in table], [max(b, 1e-5) for _, b, _ in table], "o-", label=family)
        plt.loglog([1e-5, 1], [1e-5, 1], "k:")
        plt.xlabel("predicted")
        plt.ylabel("observed")
        plt.legend()
        plt.savefig(args.plot, dpi=80)


if __name__ == "__main__":
    main()
