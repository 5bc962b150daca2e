"""Scenes with jumps whose normals are exact: `python -m benchmarks.quality.scenes` draws them.

Six families, each a function of a seed: smooth bodies that overlap (`smooth`), groups of boxes and wedges
(`polyhedral`), rooms seen from inside (`rooms`), rods and plates before a wall (`thin`), ramps hinged at one side
(`ramps`) and strips that part from each other (`stripes`). The seeds of `FITTED` are for fitting settings, those of
`UNSEEN` are looked at once, by the benchmark. Normals are x right, y up, z to the viewer; depths grow away.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Distance = Callable[[Array], Array]  # points (.., 3), OpenCV's frame -> signed distance

FITTED = tuple(range(12))
UNSEEN = tuple(range(1000, 1006))
_FAR = 1e9


class Scene(NamedTuple):
    """Normals (1, 3, H, W), mask and true depth (1, 1, H, W), camera (3, 3) or None for a view from square to it."""

    name: str
    normals: Tensor
    mask: Tensor
    depth: Tensor
    camera: Tensor | None


class Body(NamedTuple):
    """A convex body: planes n.x <= d (k, 3), (k,), within a sphere or an infinite cylinder if it has a radius."""

    planes: Array
    reach: Array
    centre: Array
    radius: float = 0.0
    axis: Array | None = None
    inside: bool = False  # a room: what is seen is its far wall


def scene(family: str, seed: int, size: int = 128) -> Scene:
    """One scene, by the name of its family and its seed."""
    rng = np.random.default_rng([sorted(FAMILIES).index(family), seed])
    return FAMILIES[family](f"{family}-{seed}", rng, size)


def rotation(rng: np.random.Generator, upright: bool = False) -> Array:
    """Any rotation, or one about the vertical."""
    if upright:
        a = rng.uniform(0, np.pi)
        return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def box(centre: Array, half: Array, turn: Array, inside: bool = False) -> Body:
    planes = np.concatenate([turn.T, -turn.T])
    return Body(planes, planes @ centre + np.concatenate([half, half]), centre, inside=inside)


def wedge(centre: Array, half: Array, turn: Array) -> Body:
    """A box cut along the diagonal of one of its sides."""
    body = box(centre, half, turn)
    slope = turn @ (np.array([half[1], -half[0], 0]) / np.hypot(half[0], half[1]))
    return body._replace(planes=np.vstack([body.planes, slope]), reach=np.append(body.reach, slope @ centre))


def ball(centre: Array, radius: float) -> Body:
    return Body(np.zeros((0, 3)), np.zeros(0), centre, radius)


def rod(centre: Array, radius: float, half: float, axis: Array) -> Body:
    planes = np.stack([axis, -axis])
    return Body(planes, planes @ centre + half, centre, radius, axis)


def hit(body: Body, origin: Array, ray: Array) -> tuple[Array, Array]:
    """Where rays (.., 3) from one point meet a body: the distance along them, _FAR for never, and the normal there."""
    along, offset = ray @ body.planes.T, body.reach - body.planes @ origin
    with np.errstate(divide="ignore", invalid="ignore"):
        at = offset / along
    entry, leave = np.where(along < 0, at, -_FAR), np.where(along > 0, at, _FAR)
    normals = body.planes
    if body.radius:
        near, far, centre = _quadric(body, origin, ray)
        entry, leave = np.concatenate([entry, near[..., None]], -1), np.concatenate([leave, far[..., None]], -1)
    chosen = leave.argmin(-1) if body.inside else entry.argmax(-1)
    first, last = entry.max(-1), leave.min(-1)
    blocked = ((along == 0) & (offset < 0)).any(-1)
    found = (last > 1e-6) if body.inside else (first < last) & (first > 1e-6)
    t = np.where(found & ~blocked, last if body.inside else first, _FAR)
    normal = np.zeros(ray.shape)
    for k, n in enumerate(normals):
        normal[chosen == k] = -n if body.inside else n
    if body.radius:
        point = origin + np.where(t < _FAR, t, 0)[..., None] * ray - centre
        if body.axis is not None:
            point = point - (point @ body.axis)[..., None] * body.axis
        curved = chosen == len(normals)
        normal[curved] = (point / body.radius)[curved]
    return t, normal


def _quadric(body: Body, origin: Array, ray: Array) -> tuple[Array, Array, Array]:
    start, direction = origin - body.centre, ray
    if body.axis is not None:
        start = start - (start @ body.axis) * body.axis
        direction = ray - (ray @ body.axis)[..., None] * body.axis
    a, b = (direction**2).sum(-1), direction @ start
    root = b**2 - a * (start @ start - body.radius**2)
    half, misses = np.sqrt(np.maximum(root, 0)), root <= 0
    near, far = (-b - half) / a, (-b + half) / a
    return np.where(misses, _FAR, near), np.where(misses, -_FAR, far), body.centre


def view(name: str, bodies: list[Body], turn: Array, origin: Array, focal: float, size: int) -> Scene:
    """What a camera sees of convex bodies; its mask is where it sees one at less than 89.4 degrees."""
    ray, camera = rays(focal, size)
    ray_world = ray @ turn.T
    t, normal = np.full(ray.shape[:-1], _FAR), np.zeros(ray.shape)
    for body in bodies:
        near, n = hit(body, origin, ray_world)
        closer = near < t
        t, normal = np.where(closer, near, t), np.where(closer[..., None], n, normal)
    return seen(name, normal @ turn, t, ray, camera)


def rays(focal: float, size: int) -> tuple[Array, Array]:
    """Rays (H, W, 3) of depth 1 and the camera."""
    middle = (size - 1) / 2
    camera = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    return np.stack([(x - middle) / focal, (y - middle) / focal, np.ones((size, size))], -1), camera


def seen(name: str, normal: Array, t: Array, ray: Array, camera: Array) -> Scene:
    """The scene of depths and normals in OpenCV's frame."""
    facing = -(normal * ray).sum(-1) / np.linalg.norm(ray, axis=-1)
    mask = (t < _FAR) & (facing > 1e-2)
    turned = normal * np.array([1, -1, -1])
    return scene_of(name, np.where(mask[..., None], turned, [0, 0, 1.0]), mask, np.where(mask, t, np.nan), camera)


def scene_of(name: str, normal: Array, mask: NDArray[np.bool_], depth: Array, camera: Array | None) -> Scene:
    normals = torch.from_numpy(np.moveaxis(normal, -1, 0).copy())[None]
    inside, far = (torch.from_numpy(a.copy())[None, None] for a in (mask, depth))
    return Scene(name, normals, inside, far, None if camera is None else torch.from_numpy(camera))


def trace(name: str, distance: Distance, focal: float, size: int, away: float = 10.0) -> Scene:
    """What a camera sees of a signed-distance function around the point `away` before it; its largest part."""
    ray, camera = rays(focal, size)
    length, centre = np.linalg.norm(ray, axis=-1), np.array([0, 0, away])
    t = np.full(ray.shape[:-1], 0.5 * away)
    for _ in range(160):
        t = t + np.clip(distance(ray * t[..., None] - centre), -1, 1) * 0.7 / length
    point, e = ray * t[..., None] - centre, 1e-5
    found = (np.abs(distance(point)) < 1e-4) & (t < 2 * away)
    normal = np.stack([distance(point + e * u) - distance(point - e * u) for u in np.eye(3)], -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return seen(name, normal, np.where(found, t, _FAR), ray, camera)


def smooth(name: str, rng: np.random.Generator, size: int) -> Scene:
    """Balls, capsules, tori, rounded boxes and cups, blended where they meet."""
    parts = [_part(rng, first=k == 0) for k in range(rng.integers(3, 7))]
    blend = rng.choice([0.02, 0.05, 0.12])
    ripple, waves = rng.choice([0, 0, 0.015, 0.03]), rng.uniform(5, 14, 3)

    def distance(p: Array) -> Array:
        d = reduce(lambda a, b: -blend * np.logaddexp(-a / blend, -b / blend), [part(p) for part in parts])
        return d + ripple * np.sin(waves * p + [1, 2, 3]).prod(-1) if ripple else d

    return trace(name, distance, 3.2 * size, size)


def _part(rng: np.random.Generator, first: bool) -> Distance:
    kind, turn = rng.integers(0, 5), rotation(rng)
    centre = np.zeros(3) if first else rng.uniform(-1, 1, 3) * [1.1, 1.1, 0.8]
    r = rng.uniform(0.35, 0.9) * (1.2 if first else 0.8)
    end, half = rng.uniform(-1, 1, 3), rng.uniform(0.2, 0.6, 3) * r * 1.5

    def capsule(q: Array) -> Array:
        h = np.clip(q @ end / (end @ end), 0, 1)
        return np.linalg.norm(q - h[..., None] * end, axis=-1) - 0.4 * r

    def torus(q: Array) -> Array:
        return np.hypot(np.hypot(q[..., 0], q[..., 1]) - r, q[..., 2]) - 0.35 * r

    def rounded(q: Array) -> Array:
        d = np.abs(q) - half
        return np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(-1), 0) - 0.06

    def cup(q: Array) -> Array:
        return np.maximum(np.abs(np.linalg.norm(q, axis=-1) - r) - 0.08, q[..., 2] - 0.2 * r)

    shapes = (lambda q: np.linalg.norm(q, axis=-1) - r, capsule, torus, rounded, cup)
    return lambda p: shapes[kind]((p - centre) @ turn)


def polyhedral(name: str, rng: np.random.Generator, size: int) -> Scene:
    """A group of boxes, wedges, plates and rods, seen from afar."""
    bodies = []
    for k in range(rng.integers(3, 8)):
        kind, turn, c = rng.integers(0, 5), rotation(rng), rng.uniform(-0.8, 0.8, 3) * (k > 0)
        if kind <= 1:
            bodies.append(box(c, rng.uniform(0.1, 0.7, 3), turn))
        elif kind == 2:
            bodies.append(wedge(c, rng.uniform(0.2, 0.7, 3), turn))
        elif kind == 3:
            bodies.append(rod(c, rng.uniform(0.1, 0.5), rng.uniform(0.2, 1), turn[0]))
        else:
            bodies.append(box(c, np.append(rng.uniform(0.3, 0.8, 2), 0.04), turn))
    return view(name, bodies, np.eye(3), np.array([0, 0, -8.0]), 3.0 * size, size)


def rooms(name: str, rng: np.random.Generator, size: int) -> Scene:
    """A room from inside, with boxes, tables, balls and columns on its floor."""
    u = rng.uniform
    wide, high, deep = u(1.6, 3), u(1.1, 1.6), u(3.5, 7)
    bodies = [box(np.array([0, 0, deep / 2 - 1]), np.array([wide, high, deep / 2 + 1]), np.eye(3), inside=True)]
    for _ in range(rng.integers(3, 8)):
        bodies += _furniture(rng, np.array([u(-0.85, 0.85) * wide, high, u(1.4, deep - 1.4)]))
    a, b = u(-0.5, 0.5), -u(0.05, 0.4)
    about = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    down = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return view(name, bodies, about @ down, np.array([u(-0.6, 0.6), u(-0.5, 0.2), -0.2]), u(0.7, 1.2) * size, size)


def _furniture(rng: np.random.Generator, foot: Array) -> list[Body]:
    u, turn, up = rng.uniform, rotation(rng, upright=True), np.array([0, -1.0, 0])
    kind = rng.integers(0, 5)
    if kind == 0:
        half = np.array([u(0.2, 0.6), u(0.15, 0.6), u(0.2, 0.6)])
        return [box(foot + half[1] * up, half, turn)]
    if kind == 1:
        half = np.array([u(0.3, 0.8), u(0.1, 0.4), u(0.2, 0.5)])
        return [wedge(foot + half[1] * up, half, turn)]
    if kind == 2:
        r = u(0.2, 0.45)
        return [ball(foot + r * up, r)]
    if kind == 3:
        half_height = u(0.3, 1.0)
        return [rod(foot + half_height * up, u(0.05, 0.4), half_height, up)]
    x, z, tall, thick = u(0.4, 0.9), u(0.3, 0.6), u(0.5, 0.9), u(0.02, 0.05)
    legs = [np.array([i * (x - 0.06), 0, j * (z - 0.06)]) for i in (-1, 1) for j in (-1, 1)]
    parts = [box(foot + tall / 2 * up + turn @ leg, np.array([0.04, tall / 2, 0.04]), turn) for leg in legs]
    return [box(foot + tall * up, np.array([x, thick, z]), turn), *parts]


def thin(name: str, rng: np.random.Generator, size: int) -> Scene:
    """Rods, bars and plates before a wall that is a little oblique, seen from near."""
    u = rng.uniform
    tilt = np.array([u(-0.4, 0.4), u(-0.4, 0.4), -1])
    tilt /= np.linalg.norm(tilt)
    wall = Body(tilt[None], np.array([-u(3.6, 4.6)]), np.zeros(3))
    bodies = [wall]
    for _ in range(rng.integers(4, 9)):
        c, turn = np.array([u(-1.2, 1.2), u(-1.2, 1.2), u(2.4, 3.4)]), rotation(rng)
        kind = rng.integers(0, 4)
        if kind == 0:
            bodies.append(rod(c, u(0.03, 0.1), u(0.4, 1.2), turn[0]))
        elif kind == 1:
            bodies.append(box(c, np.array([u(0.03, 0.07), u(0.5, 1.2), u(0.03, 0.07)]), turn))
        elif kind == 2:
            bodies.append(box(c, np.array([u(0.2, 0.6), u(0.2, 0.6), 0.02]), turn))
        else:
            bodies.append(ball(c, u(0.08, 0.4)))
    return view(name, bodies, np.eye(3), np.zeros(3), u(0.9, 1.6) * size, size)


def ramps(name: str, rng: np.random.Generator, size: int) -> Scene:
    """Rectangles that rise from a gentle bump along one side: jumps at three sides, joined at the fourth."""
    y, x = np.mgrid[:size, :size].astype(float)
    u, c = rng.uniform, size / 2
    z = u(4, 12) * np.exp(-((x - c) ** 2 + (y - c) ** 2) / (2 * u(25, 50) ** 2))
    zy, zx = np.gradient(z)
    for _ in range(rng.integers(1, 4)):
        left, top, wide, tall = u(0.05, 0.6) * size, u(0.05, 0.7) * size, u(0.2, 0.4) * size, u(0.15, 0.3) * size
        rise = u(0.15, 0.5) * rng.choice([-1, 1])
        part = (x >= left) & (x < left + wide) & (y >= top) & (y < top + tall)
        z, zx = np.where(part, z + rise * (x - left), z), np.where(part, zx + rise, zx)
    return _relief(name, z, zx, zy, rng)


def stripes(name: str, rng: np.random.Generator, size: int) -> Scene:
    """Strips that lie together at one end and part from each other towards the other."""
    y, x = np.mgrid[:size, :size].astype(float)
    wide, bend = size / rng.integers(4, 10), rng.uniform(0.1, 0.5, 64)
    k = (x // wide).astype(int)
    start = rng.uniform(0, 0.3) * size
    past = np.maximum(y - start, 0) / size
    z = size * bend[k] * past**2 + 6 * np.sin(x / size * 3)
    return _relief(name, z, 18 / size * np.cos(x / size * 3), 2 * bend[k] * past, rng)


def _relief(name: str, z: Array, zx: Array, zy: Array, rng: np.random.Generator) -> Scene:
    """A height, turned by some quarters, as a scene seen from square to it."""
    quarters = int(rng.integers(0, 4))
    n = np.stack([-zx, zy, np.ones_like(z)], -1)  # y up
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    for _ in range(quarters):
        n, z = np.rot90(n), np.rot90(z)
        n = np.stack([-n[..., 1], n[..., 0], n[..., 2]], -1)
    return scene_of(name, np.ascontiguousarray(n), np.ones(z.shape, bool), np.ascontiguousarray(-z), None)


FAMILIES: dict[str, Callable[[str, np.random.Generator, int], Scene]] = {
    "smooth": smooth, "polyhedral": polyhedral, "rooms": rooms, "thin": thin, "ramps": ramps, "stripes": stripes,
}  # fmt: skip


def noisy(normals: Tensor, degrees: float, seed: int) -> Tensor:
    """Unit normals (N, 3, H, W), turned by normal noise: `degrees` is the root mean square of the angle."""
    if not degrees:
        return normals
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(normals.shape, generator=generator, dtype=normals.dtype) * np.deg2rad(degrees) / 2**0.5
    noise = noise - (noise * normals).sum(1, keepdim=True) * normals
    return torch.nn.functional.normalize(normals + noise, dim=1)


def eight_bits(normals: Tensor) -> Tensor:
    """As an 8-bit picture holds them."""
    return torch.nn.functional.normalize(((normals + 1) / 2 * 255).round() / 255 * 2 - 1, dim=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=Path("scenes.png"))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(FITTED[:4]))
    parser.add_argument("--smoke", action="store_true", help="one small scene of each family, no picture")
    args = parser.parse_args()
    scenes = [scene(f, s, 32 if args.smoke else 128) for f in FAMILIES for s in args.seeds[: 1 if args.smoke else 99]]
    for one in scenes:
        print(one.name, int(one.mask.sum()), "pixels")
    if args.smoke:
        return
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(2 * len(FAMILIES), len(args.seeds), figsize=(2 * len(args.seeds), 4 * len(FAMILIES)))
    for one, pair in zip(scenes, axes.reshape(len(FAMILIES), 2, -1).transpose(0, 2, 1).reshape(-1, 2), strict=True):
        pair[0].imshow(((one.normals[0] + 1) / 2).movedim(0, -1).clamp(0, 1))
        pair[1].imshow(one.depth[0, 0])
        for axis in pair:
            axis.axis("off")
    plt.tight_layout()
    plt.savefig(args.out, dpi=60)


if __name__ == "__main__":
    main()
