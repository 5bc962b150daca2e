"""Meshes from normals: a sphere and a wave from their own, the gradient by autograd, the metric by SciPy."""

import numpy as np
import pytest
import torch

from tests.helpers.fields import random_field
from torchdls import fit_mesh
from torchdls.mesh import turn, turn_adjoint


def face_normals(x, faces):
    p, q, r = x[faces].unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(q - p, r - p), dim=1)


def sphere(rows=6, columns=8):
    """Rings between two poles."""
    u = torch.linspace(0, torch.pi, rows + 1, dtype=torch.float64)[1:-1]
    v = torch.arange(columns, dtype=torch.float64) * 2 * torch.pi / columns
    rings = torch.stack(
        [u.sin()[:, None] * v.cos(), u.sin()[:, None] * v.sin(), u.cos()[:, None].expand(-1, columns)], -1
    )
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    x = torch.cat([rings.flatten(0, 1), poles])
    n, faces = len(x), []
    for j in range(columns):
        k = (j + 1) % columns
        faces += [[n - 2, j, k], [n - 1, (rows - 2) * columns + k, (rows - 2) * columns + j]]
        for i in range(rows - 2):
            a, b, c, d = i * columns + j, i * columns + k, (i + 1) * columns + j, (i + 1) * columns + k
            faces += [[a, c, d], [a, d, b]]
    return x, torch.tensor(faces)


def grid_faces(n):
    """Two triangles for each cell of n x n points."""
    at = torch.arange(n * n).view(n, n)
    a, b, c, d = (t.flatten() for t in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    return torch.cat([torch.stack([a, b, d], 1), torch.stack([a, d, c], 1)])


def test_a_sphere_from_its_normals():
    """From an ellipsoid with noise: round again, of the mean position of the start; the scale is free."""
    truth, faces = sphere()
    start = truth * torch.tensor([1.3, 0.8, 1.0], dtype=torch.float64) + 0.02 * random_field(*truth.shape, seed=1)
    found = fit_mesh(start, faces, face_normals(truth, faces), n_iter=8)
    assert (found.energy.diff() < 0).all()
    assert found.energy[-1] < 1e-8 * found.energy[0]
    assert (face_normals(found.vertices, faces) - face_normals(truth, faces)).norm(dim=1).max() < 1e-3
    torch.testing.assert_close(found.vertices.mean(0), start.mean(0))
    radius = (found.vertices - found.vertices.mean(0)).norm(dim=1)
    assert radius.std() < 0.02 * radius.mean()


def test_an_open_wave_keeps_its_scale_and_place():
    y, x = torch.meshgrid(*(torch.arange(7, dtype=torch.float64),) * 2, indexing="ij")
    truth = torch.stack([x, y, (x / 2).sin() * (y / 3).cos()], -1).flatten(0, 1)
    faces = grid_faces(7)
    found = fit_mesh(truth * torch.tensor([1, 1, 0.0]).double(), faces, face_normals(truth, faces), n_iter=8)
    assert found.energy[-1] < 1e-6 * found.energy[0]
    turned = face_normals(found.vertices, faces) - face_normals(truth, faces)
    assert turned.norm(dim=1).mean() < 1e-2


def test_derivative_of_the_normals_by_autograd():
    x, faces = sphere(4, 5)
    x, d = x + 0.1 * random_field(*x.shape, seed=2), random_field(*x.shape)
    y = random_field(*faces.shape, seed=4)
    _, expected = torch.func.jvp(lambda x: face_normals(x, faces), (x,), (d,))
    torch.testing.assert_close(turn(x, faces, d), expected)
    torch.testing.assert_close((turn_adjoint(x, faces, y) * d).sum(), (expected * y).sum())


def test_along_the_normals_of_a_flat_mesh_it_is_the_cotangent_laplacian():
    y, x = torch.meshgrid(*(torch.arange(4, dtype=torch.float64),) * 2, indexing="ij")
    flat = torch.stack([x + 0.1 * y, y, 0 * x], -1).flatten(0, 1)
    faces, points = grid_faces(4), flat.numpy()
    K = np.zeros((16, 16))
    for face in faces.tolist():
        for i, j, k in (face, face[1:] + face[:1], face[2:] + face[:2]):
            a, b = points[j] - points[i], points[k] - points[i]
            half = a @ b / np.linalg.norm(np.cross(a, b)) / 2
            K[[j, k], [j, k]] += half
            K[[j, k], [k, j]] -= half
    h = random_field(16, seed=4)
    turned = turn(flat, faces, torch.stack([0 * h, 0 * h, h], 1))
    p, q, r = flat[faces].unbind(1)
    areas = torch.linalg.cross(q - p, r - p).norm(dim=1) / 2
    assert float((areas[:, None] * turned.square()).sum()) == pytest.approx(h.numpy() @ K @ h.numpy())


def test_bad_arguments():
    x, faces = sphere(3, 4)
    n = face_normals(x, faces)
    for bad, match in (
        ((x[:, :2], faces, n), "vertices"), ((x, faces[:, :2], n), "faces"), ((x, faces, n[1:]), "normals"),
        ((x, faces + 50, n), "faces"), ((x * float("nan"), faces, n), "vertices"), ((x, faces, 0 * n), "normals"),
        ((0 * x, faces, n), "without area"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            fit_mesh(*bad)
    with pytest.raises(TypeError, match="faces"):
        fit_mesh(x, faces.double(), n)
    with pytest.raises(ValueError, match="tol"):
        fit_mesh(x, faces, n, tol=-1.0)
