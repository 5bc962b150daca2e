"""SpectralPath: its eigenvector against a dense one, its tree against the walk itself."""

import heapq

import numpy as np
import pytest

from tests.helpers import random_field
from torchdls import SpectralPath, edge_slopes
from torchdls.integrators.classic.spectral_path import _tree
from torchdls.operators.edges import present_edges

H, W = 6, 7
NEIGHBOURS = ((0, 1), (1, 0), (0, -1), (-1, 0))


def inside(i, j):
    return 0 <= i < H and 0 <= j < W


def test_the_leading_eigenvector_is_that_of_the_dense_matrix():
    g = random_field(1, 2, H, W)
    n = np.stack([*-g[0].numpy(), np.ones((H, W))])
    n /= np.linalg.norm(n, axis=0)
    matrix = np.zeros((H * W, H * W))
    for i in range(H):
        for j in range(W):
            for a, b in ((i + di, j + dj) for di, dj in NEIGHBOURS):
                if inside(a, b):
                    matrix[i * W + j, a * W + b] = np.exp(-2 * 2 * (1 - n[:, i, j] @ n[:, a, b]))
    leading = np.abs(np.linalg.eigh(matrix)[1][:, -1])
    method = SpectralPath(mu=2.0, n_iter=3000)
    found = method._leading(method._check_fields(g))[0]
    np.testing.assert_allclose(found.flatten(), leading / leading.max(), atol=1e-8)


def walk(e):
    """Heights of each pixel from its edge, in the order of the walk: (from, to) pairs."""
    start = np.unravel_index(e.argmax(), e.shape)
    seen, edges = {tuple(map(int, start))}, []
    front: list = []

    def look(i, j):
        for a, b in ((i + di, j + dj) for di, dj in NEIGHBOURS):
            if inside(a, b) and (a, b) not in seen:
                ends = e[i, j], e[a, b]
                heapq.heappush(front, (-min(ends), -max(ends), (i, j), (a, b)))

    look(*next(iter(seen)))
    while front:
        *_, here, there = heapq.heappop(front)
        if there not in seen:
            seen.add(there)
            edges.append((here, there))
            look(*there)
    return next(iter(edges))[0], edges


def test_heights_are_the_sums_along_the_walk():
    g = random_field(1, 2, H, W, seed=3)
    method = SpectralPath(solve_tol=1e-12)
    start, edges = walk(method._leading(method._check_fields(g))[0].numpy())
    assert len(edges) == H * W - 1
    slopes, z = g[0].numpy(), np.zeros((H, W))
    for here, there in edges:
        axis = 0 if here[0] == there[0] else 1
        sign = there[1 - axis] - here[1 - axis]
        z[there] = z[here] + sign * (slopes[axis][here] + slopes[axis][there]) / 2
    assert z[start] == 0
    np.testing.assert_allclose(method(g)[0, 0], z - z.mean(), atol=1e-8)


def test_the_tree_holds_every_pixel_once():
    live = present_edges(edge_slopes(random_field(3, 2, H, W))[0]) > 0
    assert _tree(random_field(3, H, W), live).flatten(1).sum(1).tolist() == [H * W - 1] * 3


@pytest.mark.parametrize("options", [{"mu": 0.0}, {"n_iter": 0}, {"solve_tol": 0.0}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        SpectralPath(**options)
