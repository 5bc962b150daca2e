"""What has an input of its own: `python -m benchmarks.quality.other_inputs` (add --smoke for a smoke run).

Sequences (a planted low-rank one, and a surface that moves), slopes at scattered points, measured heights, and a mesh
from normal images: the error of each method beside that of what one would do without it. RMSE in pixels, for the mesh
the spread of its radii in percent; means over fresh noise. Writes JSON and a table.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import griddata
from scipy.ndimage import gaussian_filter
from torch import Tensor

from benchmarks.common.report import made_by, markdown_table, results_folder, write_json
from torchdls import (
    DLS,
    SURFACES,
    LeastSquares,
    NormalViews,
    OnlineDLS,
    SequenceDLS,
    add_noise,
    denoise_height,
    fit_mesh,
    integrate_scattered,
    rmse,
)

FIRST_SEED = 9400
Row = tuple[str, str, float]


def sequences(size: int, frames: int, seed: int) -> list[Row]:
    """Each way on two sequences of 3 dB: two shapes that change into one another, and one that moves by pixels."""
    a, b = (SURFACES[name](size) for name in ("peaks", "tent"))
    share = torch.linspace(0, 1, frames).view(-1, 1, 1, 1)
    wide = SURFACES["peaks"](size + frames)
    windows = [(slice(None), slice(None), slice(t, t + size), slice(t, t + size)) for t in range(frames)]
    kinds = {
        "two shapes": (share * a.height + (1 - share) * b.height, share * a.gradient + (1 - share) * b.gradient),
        "moving": (torch.cat([wide.height[w] for w in windows]), torch.cat([wide.gradient[w] for w in windows])),
    }
    methods = {
        "least squares": LeastSquares(),
        "DLS, frame by frame": DLS(select=False),
        "SequenceDLS": SequenceDLS(),
        "OnlineDLS": OnlineDLS(),
    }
    rows = []
    for kind, (height, slopes) in kinds.items():
        truth = height - height.mean((-2, -1), keepdim=True)
        noisy = add_noise(slopes, 3, torch.Generator().manual_seed(seed))
        rows += [(f"sequence, {kind}", name, float(rmse(m(noisy), truth).mean())) for name, m in methods.items()]
    return rows


def scattered(count: int, noise: float, seed: int) -> list[Row]:
    """sin(x) cos(y / 2) from slopes at random points; beside least squares on a grid of interpolated slopes."""
    generator = torch.Generator().manual_seed(seed)
    x = 6 * torch.rand(count, 2, generator=generator, dtype=torch.float64)
    g = torch.stack([x[:, 0].cos() * (x[:, 1] / 2).cos(), -0.5 * x[:, 0].sin() * (x[:, 1] / 2).sin()], -1)
    g = g + noise * torch.randn(g.shape, generator=generator, dtype=torch.float64)
    line = torch.linspace(0.5, 5.5, 41, dtype=torch.float64)
    at = torch.stack([t.flatten() for t in torch.meshgrid(line, line, indexing="xy")], -1)
    truth = (at[:, 0].sin() * (at[:, 1] / 2).cos()).numpy()
    slopes = griddata(x.numpy(), g.numpy(), at.numpy(), method="linear")
    filled = np.where(np.isnan(slopes), griddata(x.numpy(), g.numpy(), at.numpy(), method="nearest"), slopes)
    field = torch.from_numpy(filled.reshape(41, 41, 2)).movedim(-1, 0)[None]
    found = {
        "interpolated slopes, least squares": LeastSquares(pixel_size=5 / 40)(field).flatten(),
        "integrate_scattered": integrate_scattered(x, g, at),
    }
    label = f"{count} scattered slopes, noise {noise:g}"
    return [(label, name, float(np.std(z.numpy() - truth))) for name, z in found.items()]


def heights(size: int, seed: int) -> list[Row]:
    """Tent with white noise of a fifth of its standard deviation; beside the Gaussian filter that is best for it."""
    truth = SURFACES["tent"](size).height
    sigma = float(truth.std()) / 5
    noisy = truth + sigma * torch.randn(truth.shape, generator=torch.Generator().manual_seed(seed))
    blurred = [torch.from_numpy(gaussian_filter(noisy[0, 0].numpy(), s))[None, None] for s in (0.5, 0.8, 1.2, 1.8, 2.5)]
    found = {"as it is": [noisy], "best Gaussian filter": blurred, "denoise_height": [denoise_height(noisy, sigma)]}
    return [("measured heights", name, min(float(rmse(z, truth)) for z in some)) for name, some in found.items()]


def globe(rows: int) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a sphere: rings of points, each turned by half a step, between two poles."""
    u = torch.linspace(0, torch.pi, rows + 1, dtype=torch.float64)[1:-1]
    n, rings = 2 * rows, []
    for i, angle in enumerate(u):
        v = (torch.arange(n, dtype=torch.float64) + i / 2) * 2 * torch.pi / n
        rings.append(torch.stack([angle.sin() * v.cos(), angle.sin() * v.sin(), angle.cos().expand(n)], -1))
    x = torch.cat([*rings, torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=torch.float64)])
    top, faces = len(x) - 2, []
    for j in range(n):
        k = (j + 1) % n
        faces += [[top, j, k], [top + 1, (rows - 2) * n + k, (rows - 2) * n + j]]
        for i in range(rows - 2):
            a, b, c, d = i * n + j, i * n + k, (i + 1) * n + j, (i + 1) * n + k
            faces += [[a, c, b], [b, c, d]]
    return x, torch.tensor(faces)


def views(n: int, noise: float, generator: torch.Generator) -> NormalViews:
    """Normal images of the unit sphere, whose normals are its points, from six sides at a distance of 4."""
    eye, distance = torch.eye(3, dtype=torch.float64), 4.0
    K = torch.tensor([[1.6 * n, 0, (n - 1) / 2], [0, 1.6 * n, (n - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    ray = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ torch.linalg.inv(K).mT
    ray = torch.nn.functional.normalize(ray, dim=-1)
    along = distance * ray[..., 2]
    under = along.square() - distance**2 + 1
    point = (along - under.clamp(min=0).sqrt())[..., None] * ray - torch.tensor([0, 0, distance]).double()
    images, poses = [], []
    for i in range(6):
        ahead, right = eye[i % 3] * (-1) ** (i // 3), eye[(i + 1) % 3]
        spoilt = point + noise * torch.randn(point.shape, generator=generator, dtype=torch.float64)
        normal = torch.nn.functional.normalize(spoilt, dim=-1) * torch.tensor([1.0, -1, -1]) * (under > 0)[..., None]
        images.append(normal.movedim(-1, 0))
        R = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
        poses.append(torch.cat([R, torch.tensor([[0], [0], [distance]]).double()], 1))
    return NormalViews(torch.stack(images), K, torch.stack(poses))


def mesh(rows: int, seed: int) -> list[Row]:
    """From an ellipsoid with noise back to the sphere."""
    generator = torch.Generator().manual_seed(seed)
    x, faces = globe(rows)
    start = x * torch.tensor([1.2, 0.9, 1.0], dtype=torch.float64)
    start = start + 0.01 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    kinds: dict[str, Callable[[], Tensor]] = {"the mesh it starts from": lambda: start}
    for noise in (0.0, 0.1):
        shown = views(64, noise, generator)
        kinds[f"fit_mesh, normals {'as they are' if noise == 0 else 'with noise of 6 degrees'}"] = partial(
            lambda field: fit_mesh(start, faces, field, n_iter=8).vertices, shown
        )
    rows_made = []
    for name, make in kinds.items():
        radius = (lambda z: (z - z.mean(0)).norm(dim=1))(make())
        rows_made.append(("sphere from six normal images, %", name, 100 * float(radius.std() / radius.mean())))
    return rows_made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small inputs, one draw: does it run?")
    parser.add_argument("--seeds", type=int, default=3, help="noise draws per row")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    size, frames, count, rings, seeds = (16, 5, 40, 6, 1) if args.smoke else (40, 8, 400, 12, args.seeds)
    total: dict[tuple[str, str], list[float]] = {}
    with torch.no_grad():
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            found = [*sequences(size, frames, seed), *heights(size, seed), *mesh(rings, seed)]
            found += [row for n in (count // 4, count) for noise in (0.0, 0.1) for row in scattered(n, noise, seed)]
            for kind, name, error in found:
                total.setdefault((kind, name), []).append(error)
    rows = [[*labels, sum(errors) / len(errors)] for labels, errors in total.items()]
    for row in rows:
        print(*row, flush=True)
    out, by = args.out or results_folder(args.smoke), made_by("benchmarks.quality.other_inputs")
    write_json(out / "other_inputs.json", settings={"size": size, "frames": frames, "seeds": seeds}, rows=rows)
    what = f"Errors, means of {seeds} draws; sequences of {frames} frames of {size} x {size} at 3 dB."
    table = markdown_table(["input", "method", "error"], rows)
    (out / "other_inputs.md").write_text(f"# What has an input of its own\n\n{what}\n\n{table}\n{by}")


if __name__ == "__main__":
    main()
