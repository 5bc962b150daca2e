"""Triangle meshes from target normals: Gauss-Newton in the space of shapes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._checks import check_alike, check_real, check_together, require
from torchdls._precision import full_precision
from torchdls._tracing import is_concrete


class MeshResult(NamedTuple):
    """What `fit_mesh` returns.

    Attributes:
        vertices: (V, 3).
        energy: (iterations + 1,) 1/2 sum of area |n - target|^2 over the faces that have a target, from the start on.
        iterations: how many were made.

    Example:
        >>> vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> result = torchdls.fit_mesh(vertices, torch.tensor([[0, 1, 2]]), torch.tensor([[0.0, 0, 1]]))
        >>> result.iterations, float(result.energy[-1])
        (0, 0.0)
    """

    vertices: Tensor
    energy: Tensor
    iterations: int


NormalField = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class NormalViews:
    r"""Normals in space, as normal images of several cameras show them: what `fit_mesh` takes for `normals`.

    A point c of a surface with normal n is seen by view v at the pixel K_v (R_v c + t_v); what the image holds there,
    between its pixels by bilinear interpolation, is turned into the frame of the world. Views that see a point are
    averaged by the cosine at which they look on n:

        m(c, n) = normalised( \sum_v cos_v R_v^T S N_v(K_v (R_v c + t_v)) ),     S = diag(1, -1, -1)

    over the views with cos_v above `facing` and known normals all around the pixel. That a point is hidden behind other
    parts of the surface is not noticed.

    Args:
        normals: (V, 3, H, W), canonical in the axes of each camera (x right, y up, z to the viewer); 0 where unknown.
        cameras: (V, 3, 3) or (3, 3), intrinsics K for pixels (column, row) from 0.
        poses: (V, 3, 4), R and t from the world to each camera (x right, y down, z ahead).
        facing: least cosine between the normal and the way to the viewer.

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: shapes do not fit, or `facing` is not above 0 and below 1.

    Example:
        >>> images = torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1).expand(1, 3, 9, 9)  # a wall, seen face-on
        >>> camera, pose = torch.tensor([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), torch.eye(3, 4)[None]
        >>> views = torchdls.NormalViews(images, camera, pose)
        >>> views(torch.tensor([[0.1, 0.1, 2], [9, 0, 2]]), torch.tensor([[0.0, 0, -1], [0, 0, -1]]))
        tensor([[ 0.,  0., -1.],
                [ 0.,  0.,  0.]])
    """

    normals: Tensor
    cameras: Tensor
    poses: Tensor
    facing: float = 0.3

    def __post_init__(self) -> None:
        name = "NormalViews"
        check_together(name, normals=self.normals, cameras=self.cameras, poses=self.poses)
        shape, k, p = (tuple(t.shape) for t in (self.normals, self.cameras, self.poses))
        views = shape[:1]
        fits = len(shape) == 4 and shape[1] == 3 and 0 not in shape and min(shape[2:]) > 1 and p == (*views, 3, 4)
        fits = fits and k in {(3, 3), (*views, 3, 3)}
        needed = "(V, 3, H, W), (V, 3, 3) or (3, 3), and (V, 3, 4) are needed"
        require(fits, f"{name}: normals {shape}, cameras {k} and poses {p} given, {needed}")
        require(0 < self.facing < 1, f"{name}: facing={self.facing!r} given, a number above 0 and below 1 is needed")

    def __call__(self, centres: Tensor, normals: Tensor) -> Tensor:
        """(F, 3) normals at points (F, 3) of a surface with normals (F, 3); 0 where no view sees it."""
        R, t = self.poses[..., :3], self.poses[..., 3]
        points = centres @ R.mT + t[:, None]  # (V, F, 3)
        flip = points.new_tensor([1.0, -1.0, -1.0])
        facing = -(F.normalize(points, dim=-1) * (normals @ R.mT)).sum(-1)
        ahead = points[..., 2] > 0
        pixel = points @ self.cameras.mT
        pixel = pixel[..., :2] / torch.where(ahead, pixel[..., 2], 1)[..., None]
        size = pixel.new_tensor([self.normals.shape[-1] - 1, self.normals.shape[-2] - 1])
        known = (self.normals != 0).any(1, keepdim=True).to(points)
        at = (2 * pixel / size - 1)[:, None]
        seen = F.grid_sample(torch.cat([self.normals, known], 1), at, align_corners=True)[:, :, 0].mT  # (V, F, 4)
        some = ahead & (facing > self.facing) & (seen[..., 3] > 1 - 1e-3)
        turned = F.normalize(seen[..., :3] * flip, dim=-1) @ R
        return F.normalize((torch.where(some, facing, 0)[..., None] * turned).sum(0), dim=-1)


@full_precision
def fit_mesh(
    vertices: Tensor,
    faces: Tensor,
    normals: Tensor | NormalField,
    *,
    n_iter: int = 30,
    tol: float = 1e-6,
    max_iter: int = 300,
) -> MeshResult:
    r"""Move the vertices of a triangle mesh until its faces have the normals that are given.

        min over x   E(x) = 1/2 \sum_f a_f |n_f(x) - m_f|^2,     a_f the areas of the start

    where m_f is one normal for each face, or that of a field of normals in space, m(c_f, n_f) at the centre c_f of the
    face, such as normal images of calibrated cameras (`NormalViews`), which is read anew after every step,

    by the method of Gauss and Newton, damped in the metric of the cotangent Laplacian K (Levenberg, Marquardt):

        (J^T a J + damping K) d = J^T a (m - n),     J = dn/dx

    The damping falls tenfold after a step that lowers E, and grows tenfold, without a step, where it does not. Along
    the normals of a flat mesh J^T a J is K itself; damping in K lets long waves move as fast as short ones. The systems
    are solved by conjugate gradients in PyTorch, without a matrix.

    For surfaces that no height over a grid describes: closed shapes, several views, deflectometry on a first guess.
    Normals leave the position free, and the scale of closed shapes too: the mean of the vertices stays, the scale is
    about that of the start. Triangles are not made anew: the start must have the topology, and be near enough that none
    has to turn over. Targets that no mesh of these triangles has, such as those of the round surface itself, are fitted
    at the price of thin triangles: stop after a few iterations (`n_iter`) there, or give them as a field, which each
    face reads where it lies. On a grid use the integrators, which
    are exact and far faster. Not differentiable: it runs without recording.

    Args:
        vertices: (V, 3), float32 or float64.
        faces: (F, 3) int64, counter-clockwise seen from outside.
        normals: (F, 3), a target for each face, of any length but 0; or a function of the centres (F, 3) and normals
            (F, 3) of the faces that returns targets, 0 for faces that it tells nothing of. Those only follow smoothly.
        n_iter: limit of iterations.
        tol: stop once an iteration lowers E by less than `tol` of it, or E is below `tol`^2 times the area.
        max_iter: limit of conjugate-gradient steps in each iteration.

    Returns:
        MeshResult(vertices, energy, iterations).

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: shapes do not fit, a face names no vertex, a value is not finite, a normal is 0, a face has no
            area, an option is out of range, or a field of normals has no target for any face.

    Source: after Balzer, "A Gauss-Newton method for the integration of spatial normal fields in shape space", Journal
    of Mathematical Imaging and Vision 44, 2012 (not confirmed: there displacements are along the normal); cotangent
    weights: Pinkall, Polthier (1993).

    Example:
        >>> corners = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
        >>> around = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
        >>> faces = torch.tensor(around)
        >>> spoilt = corners + 0.2 * torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
        >>> target = corners[faces].mean(1)  # of an octahedron
        >>> result = torchdls.fit_mesh(spoilt, faces, target)
        >>> bool(result.energy[-1] < 1e-6 * result.energy[0])
        True
    """
    _check(vertices, faces, n_iter, tol)
    if not callable(normals):
        _check_targets(vertices, faces, normals)
    with torch.no_grad():
        x = vertices.detach().clone()
        areas = _vector_areas(x, faces).norm(dim=1)
        target, trust = _targets(x, faces, normals, areas)
        require(not is_concrete(x) or bool((trust > 0).any()), "fit_mesh: normals tells no face of a target")
        energies, damping = [_energy(x, faces, target, trust)], 1e-1
        while len(energies) <= n_iter and float(energies[-1]) > tol**2 * float(areas.sum()):
            d = _step(x, faces, target, trust, damping, max_iter)
            moved = x + d - d.mean(0)
            there, its_trust = _targets(moved, faces, normals, areas)
            both = torch.minimum(trust, its_trust)  # faces that come into view, or leave it, are no gain and no loss
            before, after = _energy(x, faces, target, both), _energy(moved, faces, there, both)
            if not bool(after < before):
                damping *= 10
                if damping > 1e6:
                    break
                continue
            x, target, trust, damping = moved, there, its_trust, max(damping / 10, 1e-4)
            energies.append(_energy(x, faces, target, trust))
            if float(before - after) <= tol * float(before):
                break
    return MeshResult(x, torch.stack(energies), len(energies) - 1)


def _targets(x: Tensor, faces: Tensor, normals: Tensor | NormalField, areas: Tensor) -> tuple[Tensor, Tensor]:
    """Targets (F, 3) of length 1 or 0, and how much each counts (F,)."""
    if isinstance(normals, Tensor):
        found = normals.detach()
    else:
        found = normals(x[faces].mean(1), normals_of(x, faces))
        check_alike("fit_mesh", "normals(..)", found, x.dtype)
        fits = found.shape == faces.shape and bool(found.isfinite().all())
        require(fits, f"fit_mesh: normals(..) {tuple(found.shape)}, finite values {tuple(faces.shape)} are needed")
    return F.normalize(found, dim=1), torch.where(found.any(1), areas, 0)


def _step(x: Tensor, faces: Tensor, target: Tensor, areas: Tensor, damping: float, max_iter: int) -> Tensor:
    """The displacement of one damped step of Gauss and Newton; `areas` are the weights of the faces."""
    edges, weights = cotangents(x, faces)
    diagonal = torch.zeros_like(x[:, 0]).index_add(0, edges.flatten(), weights.repeat_interleave(2))

    def apply(d: Tensor) -> Tensor:
        pull = weights[:, None] * (d[edges[:, 0]] - d[edges[:, 1]])
        spread = torch.zeros_like(d).index_add(0, edges[:, 0], pull).index_add(0, edges[:, 1], -pull)
        turned = areas[:, None] * turn(x, faces, d)
        return turn_adjoint(x, faces, turned) + damping * spread

    misfit = areas[:, None] * (target - normals_of(x, faces))
    return _conjugate_gradients(apply, turn_adjoint(x, faces, misfit), diagonal, max_iter)


def normals_of(x: Tensor, faces: Tensor) -> Tensor:
    """(F, 3) normals of length 1."""
    return F.normalize(_vector_areas(x, faces), dim=1)


def turn(x: Tensor, faces: Tensor, d: Tensor) -> Tensor:
    """(F, 3), J d: how normals turn where vertices move by d (V, 3)."""
    a = _vector_areas(x, faces)
    p, q, r = x[faces].unbind(1)
    dp, dq, dr = d[faces].unbind(1)
    change = (torch.linalg.cross(dq - dp, r - p) + torch.linalg.cross(q - p, dr - dp)) / 2
    return _across(a, change)


def turn_adjoint(x: Tensor, faces: Tensor, y: Tensor) -> Tensor:
    """(V, 3), J^T y of y (F, 3)."""
    p, q, r = x[faces].unbind(1)
    pull = _across(_vector_areas(x, faces), y) / 2
    spread = torch.zeros_like(x)
    for corner, edge in enumerate((q - r, r - p, p - q)):
        spread = spread.index_add(0, faces[:, corner], torch.linalg.cross(edge, pull))
    return spread


def _across(a: Tensor, y: Tensor) -> Tensor:
    """(I - n n^T) y / |a| with n the direction of a: how the direction changes with the vector."""
    area = a.norm(dim=1, keepdim=True)
    n = a / area
    return (y - n * (n * y).sum(1, keepdim=True)) / area


def cotangents(x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Edges (3 F, 2), each once for every face at it, and half the cotangent of the angle that faces it, at least 0.

    Obtuse angles have negative cotangents; left out, the metric stays positive semidefinite.
    """
    edges, weights = [], []
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        a, b = x[faces[:, j]] - x[faces[:, i]], x[faces[:, k]] - x[faces[:, i]]
        double = torch.linalg.cross(a, b).norm(dim=1)
        edges.append(faces[:, [j, k]])
        weights.append(((a * b).sum(1) / double.clamp(min=torch.finfo(x.dtype).tiny)).clamp(min=1e-3) / 2)
    return torch.cat(edges), torch.cat(weights)


def _vector_areas(x: Tensor, faces: Tensor) -> Tensor:
    """(F, 3) normals of the length of the area."""
    p, q, r = x[faces].unbind(1)
    return torch.linalg.cross(q - p, r - p) / 2


def _energy(x: Tensor, faces: Tensor, target: Tensor, areas: Tensor) -> Tensor:
    return (areas[:, None] * (normals_of(x, faces) - target).square()).sum() / 2


def _conjugate_gradients(apply, b: Tensor, diagonal: Tensor, max_iter: int) -> Tensor:  # type: ignore[no-untyped-def]
    """H x = b for three columns that share a step, with the diagonal as preconditioner, to 1e-6."""
    x, r = torch.zeros_like(b), b.clone()
    y = r / diagonal[:, None]
    p, rho, end = y.clone(), (r * y).sum(), 1e-12 * b.square().sum()
    for _ in range(max_iter):
        if bool(r.square().sum() <= end):
            break
        h = apply(p)
        length = rho / (p * h).sum()
        x, r = x + length * p, r - length * h
        y = r / diagonal[:, None]
        rho, before = (r * y).sum(), rho
        p = y + rho / before * p
    return x


def _check(vertices: Tensor, faces: Tensor, n_iter: int, tol: float) -> None:
    name = "fit_mesh"
    check_real(name, "vertices", vertices)
    check_alike(name, "faces", faces, torch.int64)
    shapes = f"vertices {tuple(vertices.shape)} and faces {tuple(faces.shape)} given"
    fits = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == 3 and len(faces) > 0 and faces.shape[1] == 3
    require(fits, f"{name}: {shapes}, (V, 3) and (F, 3) are needed")
    require(isinstance(n_iter, int) and n_iter >= 0, f"{name}: n_iter={n_iter!r} given, at least 0 is needed")
    require(tol >= 0, f"{name}: tol={tol!r} given, at least 0 is needed")
    if not is_concrete(vertices):
        return
    inside = bool(((faces >= 0) & (faces < len(vertices))).all())
    require(inside, f"{name}: faces {tuple(faces.shape)} name vertices beyond 0 .. {len(vertices) - 1}")
    require(bool(vertices.isfinite().all()), f"{name}: vertices {tuple(vertices.shape)} is not finite")
    require(
        bool((_vector_areas(vertices, faces).norm(dim=1) > 0).all()),
        f"{name}: faces {tuple(faces.shape)} holds a face without area",
    )


def _check_targets(vertices: Tensor, faces: Tensor, normals: Tensor) -> None:
    name = "fit_mesh"
    check_alike(name, "normals", normals, vertices.dtype)
    shape = tuple(normals.shape)
    require(normals.shape == faces.shape, f"{name}: normals {shape} given, {tuple(faces.shape)} as faces is needed")
    if is_concrete(normals):
        require(bool(normals.isfinite().all()), f"{name}: normals {shape} is not finite")
        require(bool((normals.norm(dim=1) > 0).all()), f"{name}: normals {shape} holds a normal of length 0")
