"""Triangle meshes from target normals: Gauss-Newton in the space of shapes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_real, require
from torchdls._precision import full_precision
from torchdls._tracing import is_concrete


class MeshResult(NamedTuple):
    """What `fit_mesh` returns.

    Attributes:
        vertices: (V, 3).
        energy: (iterations + 1,) 1/2 sum of area |n - target|^2 over the faces, from the start on.
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


@full_precision
def fit_mesh(
    vertices: Tensor,
    faces: Tensor,
    normals: Tensor,
    *,
    n_iter: int = 30,
    tol: float = 1e-6,
    max_iter: int = 300,
) -> MeshResult:
    r"""Move the vertices of a triangle mesh until its faces have the normals that are given.

        min over x   E(x) = 1/2 \sum_f a_f |n_f(x) - m_f|^2,     a_f the areas of the start

    by the method of Gauss and Newton, damped in the metric of the cotangent Laplacian K (Levenberg, Marquardt):

        (J^T a J + damping K) d = J^T a (m - n),     J = dn/dx

    The damping falls tenfold after a step that lowers E, and grows tenfold, without a step, where it does not. Along
    the normals of a flat mesh J^T a J is K itself; damping in K lets long waves move as fast as short ones. The systems
    are solved by conjugate gradients in PyTorch, without a matrix.

    For surfaces that no height over a grid describes: closed shapes, several views, deflectometry on a first guess.
    Normals leave the position free, and the scale of closed shapes too: the mean of the vertices stays, the scale is
    about that of the start. Triangles are not made anew: the start must have the topology, and be near enough that none
    has to turn over. Targets that no mesh of these triangles has, such as those of the round surface itself, are fitted
    at the price of thin triangles: stop after a few iterations (`n_iter`) there. On a grid use the integrators, which
    are exact and far faster. Not differentiable: it runs without recording.

    Args:
        vertices: (V, 3), float32 or float64.
        faces: (F, 3) int64, counter-clockwise seen from outside.
        normals: (F, 3), a target for each face, of any length but 0.
        n_iter: limit of iterations.
        tol: stop once an iteration lowers E by less than `tol` of it, or E is below `tol`^2 times the area.
        max_iter: limit of conjugate-gradient steps in each iteration.

    Returns:
        MeshResult(vertices, energy, iterations).

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: shapes do not fit, a face names no vertex, a value is not finite, a normal is 0, a face has no
            area, or an option is out of range.

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
    _check(vertices, faces, normals, n_iter, tol)
    with torch.no_grad():
        x = vertices.detach().clone()
        target = torch.nn.functional.normalize(normals.detach(), dim=1)
        areas = _vector_areas(x, faces).norm(dim=1)
        energies, damping = [_energy(x, faces, target, areas)], 1e-1
        while len(energies) <= n_iter and float(energies[-1]) > tol**2 * float(areas.sum()):
            d = _step(x, faces, target, areas, damping, max_iter)
            moved = x + d - d.mean(0)
            lower = _energy(moved, faces, target, areas)
            if not bool(lower < energies[-1]):
                damping *= 10
                if damping > 1e6:
                    break
                continue
            small = float(energies[-1] - lower) <= tol * float(energies[-1])
            x, damping = moved, max(damping / 10, 1e-4)
            energies.append(lower)
            if small:
                break
    return MeshResult(x, torch.stack(energies), len(energies) - 1)


def _step(x: Tensor, faces: Tensor, target: Tensor, areas: Tensor, damping: float, max_iter: int) -> Tensor:
    """The displacement of one damped step of Gauss and Newton."""
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
    return torch.nn.functional.normalize(_vector_areas(x, faces), dim=1)


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


def _check(vertices: Tensor, faces: Tensor, normals: Tensor, n_iter: int, tol: float) -> None:
    name = "fit_mesh"
    check_real(name, "vertices", vertices)
    check_alike(name, "faces", faces, torch.int64)
    check_alike(name, "normals", normals, vertices.dtype)
    shapes = f"vertices {tuple(vertices.shape)}, faces {tuple(faces.shape)} and normals {tuple(normals.shape)} given"
    fits = vertices.ndim == faces.ndim == normals.ndim == 2 and vertices.shape[1] == 3 and len(faces) > 0
    fits = fits and faces.shape[1] == 3 and faces.shape == normals.shape
    require(fits, f"{name}: {shapes}, (V, 3), (F, 3) and (F, 3) are needed")
    require(isinstance(n_iter, int) and n_iter >= 0, f"{name}: n_iter={n_iter!r} given, at least 0 is needed")
    require(tol >= 0, f"{name}: tol={tol!r} given, at least 0 is needed")
    if not is_concrete(vertices):
        return
    inside = bool(((faces >= 0) & (faces < len(vertices))).all())
    require(inside, f"{name}: faces {tuple(faces.shape)} name vertices beyond 0 .. {len(vertices) - 1}")
    for label, field in (("vertices", vertices), ("normals", normals)):
        require(bool(field.isfinite().all()), f"{name}: {label} {tuple(field.shape)} is not finite")
    require(bool((normals.norm(dim=1) > 0).all()), f"{name}: normals {tuple(normals.shape)} holds a normal of length 0")
    require(
        bool((_vector_areas(vertices, faces).norm(dim=1) > 0).all()),
        f"{name}: faces {tuple(faces.shape)} holds a face without area",
    )
