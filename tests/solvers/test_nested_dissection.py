"""The direct solver on masks, against dense and sparse solves of the same matrix."""

from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import spsolve

from torchdls.operators import GradientOperator
from torchdls.solvers.nested_dissection import elimination, factor


def edges_within(mask, w):
    w = w.clone()
    w[:, :1, :, :-1] *= mask[..., 1:] & mask[..., :-1]
    w[:, 1:, :-1] *= mask[:, :, 1:] & mask[:, :, :-1]
    w[:, 0, :, -1] = 0
    w[:, 1, -1] = 0
    return w


def problem(n, h, w, contrast, generator):
    """Masks with holes (the last one full), weights over many orders, weak anchors everywhere, a right-hand side."""
    mask = torch.rand(n, 1, h, w, generator=generator) > 0.2
    mask[:, :, 0, 0] = True
    mask[-1] = True
    exponents = torch.rand(n, 2, h, w, generator=generator, dtype=torch.float64)
    weight = edges_within(mask, 10 ** (contrast * (exponents - 1)))
    r = 1e-3 * torch.rand(n, 1, h, w, generator=generator, dtype=torch.float64) * mask
    return mask, weight, r, torch.randn(n, 1, h, w, generator=generator, dtype=torch.float64) * mask


def dense(weight, r, pixel_size):
    """H of one surface from its definition, column by column."""
    h, w = r.shape[-2:]
    columns = GradientOperator("forward", pixel_size)(torch.eye(h * w, dtype=torch.float64).view(-1, 1, h, w))
    A = columns.flatten(1)
    return (A * weight.flatten()) @ A.T + torch.diag(r.flatten())


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (9, 1), (3, 3), (7, 5), (13, 22), (30, 17)])
@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 2.0)])
def test_equals_a_dense_solve(size, pixel_size, generator):
    mask, weight, r, b = problem(3, *size, contrast=6, generator=generator)
    z = factor(weight, r, pixel_size).solve(b)
    for k in range(3):
        alive = mask[k].flatten()
        H = dense(weight[k], r[k], pixel_size)[alive][:, alive]
        expected = torch.zeros_like(b[k].flatten())
        expected[alive] = torch.linalg.solve(H, b[k].flatten()[alive])
        torch.testing.assert_close(z[k].flatten(), expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))


def test_equals_a_sparse_solve_on_a_larger_mask(generator):
    y, x = torch.meshgrid(torch.linspace(-1, 1, 120), torch.linspace(-1, 1, 90), indexing="ij")
    mask = ((x.square() + y.square() < 0.9) & ((x - 0.3).square() + y.square() > 0.04))[None, None]
    weight = edges_within(
        mask, 10 ** (-8 * (torch.rand(1, 2, 120, 90, generator=generator, dtype=torch.float64) > 0.95))
    )
    r = 1e-4 * mask.double()
    b = torch.randn(1, 1, 120, 90, generator=generator, dtype=torch.float64) * mask
    pixel = np.arange(120 * 90).reshape(120, 90)
    ends = np.concatenate([np.stack([pixel[:, :-1], pixel[:, 1:]], -1).reshape(-1, 2),
                           np.stack([pixel[:-1], pixel[1:]], -1).reshape(-1, 2)])  # fmt: skip
    w = np.concatenate([weight[0, 0, :, :-1].flatten(), weight[0, 1, :-1].flatten()])
    D = sparse.csr_array((np.repeat([[-1.0, 1.0]], len(w), 0).ravel(), ends.ravel(), np.arange(0, 2 * len(w) + 1, 2)))
    H = (D.T @ sparse.diags_array(w, dtype=float) @ D + sparse.diags_array(r.flatten().numpy(), dtype=float)).tocsc()
    alive = mask.flatten().numpy()
    expected = np.zeros(alive.shape)
    expected[alive] = spsolve(H[alive][:, alive], b.flatten().numpy()[alive])
    found = factor(weight, r).solve(b).flatten().numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("orders", [12, 60])
def test_every_number_of_the_inverse_is_right_at_any_contrast(orders, generator):
    """Against elimination in rational numbers, each to some units in its last place."""
    weight = edges_within(
        torch.ones(1, 1, 3, 7, dtype=torch.bool),
        10 ** (orders * (torch.rand(1, 2, 3, 7, dtype=torch.float64, generator=generator) - 0.5)),
    )
    r = torch.zeros(1, 1, 3, 7, dtype=torch.float64)
    r[0, 0, 1, 4] = 10.0**-orders
    found = factor(weight, r)
    for i in range(0, 21, 4):
        force = torch.zeros_like(r).flatten()
        force[i] = 1
        exact = rational_heights(weight[0], r[0], force)
        torch.testing.assert_close(found.solve(force.view_as(r)).flatten(), exact, rtol=1e-13, atol=0)


def rational_heights(weight, r, force):
    """H^{-1} f, by Gauss and Jordan in rational numbers."""
    h, w = r.shape[-2:]
    n = h * w
    H = [[Fraction(0)] * n + [Fraction(float(f))] for f in force]
    for i in range(n):
        H[i][i] += Fraction(float(r.flatten()[i]))
    for channel, step in ((0, 1), (1, w)):
        for i, c in enumerate(weight[channel].flatten().tolist()):
            if c:
                j, c = i + step, Fraction(c)
                H[i][i], H[j][j], H[i][j], H[j][i] = H[i][i] + c, H[j][j] + c, H[i][j] - c, H[j][i] - c
    for k in range(n):
        H[k] = [x / H[k][k] for x in H[k]]
        for i in range(n):
            if i != k and H[i][k]:
                H[i] = [x - H[i][k] * y for x, y in zip(H[i], H[k], strict=True)]
    return torch.tensor([float(row[n]) for row in H], dtype=torch.float64)


def test_a_surface_does_not_depend_on_its_batch(generator):
    _, weight, r, b = problem(3, 21, 18, 4, generator)
    together = factor(weight, r).solve(b)
    for k in range(3):
        alone = factor(weight[k : k + 1], r[k : k + 1]).solve(b[k : k + 1])
        torch.testing.assert_close(together[k : k + 1], alone, rtol=1e-10, atol=1e-10 * float(alone.abs().max()))


def test_single_precision_comes_back_single_and_right(generator):
    _, weight, r, b = problem(1, 21, 18, 2, generator)
    expected = factor(weight.float(), r.float()).solve(b.float().double())
    found = factor(weight.float(), r.float()).solve(b.float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected.float())


def test_every_pixel_is_eliminated_once_and_every_edge_enters_once(generator):
    mask = torch.rand(2, 23, 31, generator=generator) > 0.3
    levels = elimination(mask)
    fronts = [front for level in levels for front in level]
    pixels = torch.cat([f.own[f.own < mask.numel()] for f in fronts]).sort().values
    assert torch.equal(pixels, mask.flatten().nonzero()[:, 0])
    n_edges = int((mask[..., 1:] & mask[..., :-1]).sum() + (mask[:, 1:] & mask[:, :-1]).sum())
    assert len(torch.cat([f.edges[1] for f in fronts]).unique()) == n_edges


@pytest.mark.slow
@pytest.mark.parametrize("size", [128, 256, 512, 1024])
@pytest.mark.parametrize("contrast", [0, 6, 12])
def test_at_most_three_steps_at_any_contrast(size, contrast, generator):
    """Steps x <- x + M (b - H x), M the factor, until the residual is 1e-8 of b; weights jump along closed curves."""
    w = edges_within(torch.ones(1, 1, size, size, dtype=torch.bool), torch.ones(1, 2, size, size, dtype=torch.float64))
    y, x = torch.meshgrid(*(torch.arange(size, dtype=torch.float64) / size,) * 2, indexing="ij")
    waves = torch.sin(9 * x + 4 * torch.sin(7 * y)) + torch.cos(11 * y - 3 * x)
    inside = torch.nn.functional.pad((waves > 0.7).double(), (0, 1, 0, 1))[None, None]
    across = torch.cat([inside[..., :-1, 1:], inside[..., 1:, :-1]], 1) != inside[..., :-1, :-1]
    w = torch.where(across, 10.0**-contrast * w, w)
    r = torch.full((1, 1, size, size), 1e-8, dtype=torch.float64)
    A = GradientOperator("forward")
    b = A.adjoint(w * torch.randn(w.shape, generator=generator, dtype=torch.float64))
    found, z, steps = factor(w, r), torch.zeros_like(b), 0
    while (left := b - A.adjoint(w * A(z)) - r * z).norm() > 1e-8 * b.norm():
        z, steps = z + found.solve(left), steps + 1
        assert steps <= 3
    assert steps >= 1
