"""Fields on edges and cells, edge by edge against loops."""

import torch

from tests.helpers import random_field
from torchdls.operators.edges import (
    beside_edges,
    cell_curl,
    cell_edges,
    complete_cells,
    edge_ends,
    edges_at_pixels,
    edges_behind,
    present_edges,
)

H, W = 5, 6
HERE = [(c, i, j) for c in (0, 1) for i in range(H) for j in range(W) if (j < W - 1 if c == 0 else i < H - 1)]


def edge_field(seed=0):
    return random_field(2, 2, H, W, seed=seed) * present_edges(torch.zeros(2, 2, H, W, dtype=torch.float64))


def ends(c, i, j):
    return (i, j), (i, j + 1) if c == 0 else (i + 1, j)


def test_present_edges_are_those_between_two_pixels():
    there = present_edges(random_field(2, 2, H, W))
    assert there.dtype == torch.float64
    assert {(int(c), int(i), int(j)) for n, c, i, j in there.nonzero() if n == 0} == set(HERE)
    assert torch.equal(there[0], there[1])


def test_sums_over_the_edges_at_a_pixel():
    v = edge_field()
    both, each, behind = torch.zeros(2, 1, H, W, dtype=v.dtype), torch.zeros_like(v), torch.zeros_like(v)
    for c, i, j in HERE:
        for a, b in ends(c, i, j):
            both[:, 0, a, b] += v[:, c, i, j]
            each[:, c, a, b] += v[:, c, i, j]
        far = ends(c, i, j)[1]
        behind[:, c, far[0], far[1]] = v[:, c, i, j]
    torch.testing.assert_close(edge_ends(v), both)
    torch.testing.assert_close(edges_at_pixels(v), each)
    assert torch.equal(edges_behind(v), behind)


def test_curl_goes_around_each_cell():
    v, (dx, dy) = edge_field(), (0.5, 2.0)
    curl = cell_curl(v, (dx, dy))
    for i in range(H - 1):
        for j in range(W - 1):
            around = dx * (v[:, 0, i, j] - v[:, 0, i + 1, j]) + dy * (v[:, 1, i, j + 1] - v[:, 1, i, j])
            torch.testing.assert_close(curl[:, i, j], around)
            four = torch.stack([v[:, 0, i, j], v[:, 0, i + 1, j], v[:, 1, i, j + 1], v[:, 1, i, j]], 1)
            assert torch.equal(cell_edges(v)[:, :, i, j], four)
    z = random_field(2, 1, H, W, seed=3)
    slopes = torch.zeros_like(v)
    slopes[:, 0, :, :-1], slopes[:, 1, :-1] = z[:, 0].diff(dim=-1) / dx, z[:, 0].diff(dim=-2) / dy
    assert cell_curl(slopes, (dx, dy)).abs().max() < 1e-12  # of a surface it vanishes
    live = torch.rand(2, 2, H, W, generator=torch.Generator().manual_seed(1)) < 0.8
    assert torch.equal(complete_cells(live), cell_edges(live.double()).amin(1) > 0)


def test_cells_beside_an_edge():
    cells = random_field(2, 1, H - 1, W - 1)[:, 0]
    beside = beside_edges(cells)
    for c, i, j in HERE:
        two = [(i, j), (i - 1, j) if c == 0 else (i, j - 1)]
        total = sum(cells[:, a, b] for a, b in two if 0 <= a < H - 1 and 0 <= b < W - 1)
        torch.testing.assert_close(beside[:, c, i, j], total + torch.zeros(2, dtype=cells.dtype))
