"""Meshes from normals: a sphere and a wave from their own, the gradient by autograd, the metric by SciPy."""

import numpy as np
import pytest
import torch

from tests.helpers.fields import random_field
from torchdls import NormalViews, fit_mesh
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


def ball(times=2):
    """A sphere of equal triangles: an icosahedron, each face cut into four, so many times."""
    g = (1 + 5**0.5) / 2
    corners = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g], [0, 1, -g]]
    x = torch.tensor([*corners, [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]], dtype=torch.float64)
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
             (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
             (8, 6, 7), (9, 8, 1)]  # fmt: skip
    points = [*torch.nn.functional.normalize(x, dim=1)]
    for _ in range(times):
        known: dict = {}

        def middle(i, j, known=known):
            key = min(i, j), max(i, j)
            if key not in known:
                known[key] = len(points)
                points.append(torch.nn.functional.normalize(points[i] + points[j], dim=0))
            return known[key]

        cut = [(i, j, k, middle(i, j), middle(j, k), middle(k, i)) for i, j, k in faces]
        faces = [f for i, j, k, a, b, c in cut for f in ((i, a, c), (j, b, a), (k, c, b), (a, b, c))]
    return torch.stack(points), torch.tensor(faces)


def six_views(n=48, distance=4.0, noise=0.0):
    """Normal images of the unit sphere by cameras on the six half-axes: the ray meets it in closed form."""
    eye = torch.eye(3, dtype=torch.float64)
    K = torch.tensor([[1.6 * n, 0, (n - 1) / 2], [0, 1.6 * n, (n - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    ray = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ torch.linalg.inv(K).T
    ray = torch.nn.functional.normalize(ray, dim=-1)
    images, poses = [], []
    for i in range(6):
        ahead = eye[i % 3] * (-1) ** (i // 3)
        right = eye[(i + 1) % 3]
        R = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
        centre = torch.tensor([0, 0, distance], dtype=torch.float64)  # of the sphere, before the camera
        along = ray @ centre
        under = along.square() - distance**2 + 1
        normal = (along - under.clamp(min=0).sqrt())[..., None] * ray - centre
        normal = torch.nn.functional.normalize(normal + noise * random_field(n, n, 3, seed=i), dim=-1)
        flipped = normal * torch.tensor([1, -1, -1]) * (under > 0)[..., None]
        images.append(flipped.movedim(-1, 0))
        poses.append(torch.cat([R, centre[:, None]], 1))
    return NormalViews(torch.stack(images), K, torch.stack(poses))


def test_views_know_the_normals_of_a_sphere():
    """Every point is seen by some camera; by one alone what faces it, and by none what is off the object."""
    views, (x, faces) = six_views(), ball()
    outward = torch.nn.functional.normalize(x[faces].mean(1), dim=1)
    assert (views(outward, outward) - outward).norm(dim=1).max() < 5e-3
    one = NormalViews(views.normals[:1], views.cameras, views.poses[:1])
    to_camera = torch.nn.functional.normalize(torch.tensor([-4.0, 0, 0]).double() - outward, dim=1)
    faced = (outward * to_camera).sum(1) > 0.3
    assert torch.equal(one(outward, outward).any(1), faced)
    assert 0.2 < faced.double().mean() < 0.5
    assert not views(9 * outward, outward).any()


@pytest.mark.parametrize("noise, bound", [(0.0, 0.08), (0.1, 0.14)])
def test_a_sphere_from_its_normal_images(noise, bound):
    """From an ellipsoid with noise, seen by six cameras: round, of about the size of the start, no face turned over."""
    truth, faces = ball()
    start = truth * torch.tensor([1.2, 0.9, 1.0], dtype=torch.float64) + 0.02 * random_field(*truth.shape, seed=1)
    found = fit_mesh(start, faces, six_views(noise=noise), n_iter=8).vertices
    rough, smooth = ((x - x.mean(0)).norm(dim=1) for x in (start, found))
    assert smooth.std() / smooth.mean() < bound * rough.std() / rough.mean()
    assert abs(smooth.mean() / rough.mean() - 1) < 0.1
    assert ((face_normals(found, faces) * found[faces].mean(1)).sum(1) > 0).all()


@pytest.mark.slow
def test_a_field_lets_faces_slide_where_fixed_targets_of_a_round_surface_spoil_them():
    truth, faces = sphere(6, 10)
    start = truth * torch.tensor([1.3, 0.8, 1.0], dtype=torch.float64) + 0.02 * random_field(*truth.shape, seed=1)
    middles = torch.nn.functional.normalize(truth[faces].mean(1), dim=1)

    def spread(normals):
        x = fit_mesh(start, faces, normals, n_iter=6).vertices
        radius = (x - x.mean(0)).norm(dim=1)
        return radius.std() / radius.mean()

    assert spread(lambda c, n: c / c.norm(dim=1, keepdim=True)) < min(0.03, 0.5 * spread(middles))


def test_faces_without_a_target_follow_those_that_have_one():
    """A wave of which the normals are known on one half: the other half keeps its shape where the metric lets it."""
    y, x = torch.meshgrid(*(torch.arange(9, dtype=torch.float64),) * 2, indexing="ij")
    truth, faces = torch.stack([x, y, (x / 2).sin()], -1).flatten(0, 1), grid_faces(9)
    target = face_normals(truth, faces)
    known = truth[faces].mean(1)[:, 1] < 4
    found = fit_mesh(truth * torch.tensor([1, 1, 0.0]).double(), faces, lambda c, n: target * known[:, None], n_iter=8)
    error = (face_normals(found.vertices, faces) - target).norm(dim=1)
    flat = (target - torch.tensor([0, 0, 1]).double()).norm(dim=1)
    assert error[known].mean() < 1e-2
    assert error[~known].mean() < flat[~known].mean()


def test_what_is_no_field_of_normals_is_named():
    x, faces = sphere(3, 4)
    with pytest.raises(ValueError, match="tells no face"):
        fit_mesh(x, faces, lambda c, n: 0 * n)
    with pytest.raises(ValueError, match=r"normals\(\.\.\) \(1, 3\)"):
        fit_mesh(x, faces, lambda c, n: n[:1])
    with pytest.raises(TypeError, match=r"normals\(\.\.\)"):
        fit_mesh(x, faces, lambda c, n: n.float())
    images, eye, poses = torch.zeros(2, 3, 4, 4), torch.eye(3), torch.zeros(2, 3, 4)
    for bad, match in (
        ((images[:, :2], eye, poses), "normals"), ((images, eye[:2], poses), "cameras"),
        ((images, eye, poses[0]), "poses"), ((images, eye, poses, 1.0), "facing=1.0"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            NormalViews(*bad)
    with pytest.raises(TypeError, match="cameras"):
        NormalViews(images, eye.double(), poses)


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
