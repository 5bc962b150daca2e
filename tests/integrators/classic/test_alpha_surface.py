"""AlphaSurface against SciPy's trees and against least squares; what it does with wild slopes."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from scipy.sparse.csgraph import minimum_spanning_tree

import torchdls
from tests.helpers import MASKS, random_field, uniform_field
from torchdls import AlphaSurface, LeastSquares
from torchdls.integrators.classic.curl_tree import CurlTree
from torchdls.operators.edges import present_edges
from torchdls.solvers.spanning_forest import spanning_forest

MASK = MASKS["ring_and_islands"](16, 18)


@pytest.mark.parametrize(
    "mask", [torch.ones_like(MASK), MASK, MASKS["sieve"](16, 18)], ids=["full", "islands", "sieve"]
)
def test_the_forest_is_that_of_scipy(mask):
    cost = uniform_field(2, 2, 16, 18) + 0.01
    live = (torchdls.edge_slopes(cost, mask)[1] > 0).expand(2, -1, -1, -1)
    found = spanning_forest(cost, cost, live)
    pixel = np.arange(16 * 18).reshape(16, 18)
    for i in range(2):
        x, y = live[i].numpy()[0, :, :-1], live[i].numpy()[1, :-1]
        start = np.concatenate([pixel[:, :-1][x], pixel[:-1][y]])
        end = np.concatenate([pixel[:, 1:][x], pixel[1:][y]])
        weights = np.concatenate([cost[i, 0, :, :-1].numpy()[x], cost[i, 1, :-1].numpy()[y]])
        tree = minimum_spanning_tree(sp.coo_matrix((weights, (start, end)), shape=(288, 288)).tocsr())
        assert int(found[i].sum()) == tree.nnz
        assert float(cost[i][found[i]].sum()) == pytest.approx(tree.sum(), rel=1e-12)
        assert not (found[i] & ~live[i]).any()


def test_equal_costs_give_a_tree_too():
    ones = torch.ones(1, 2, 7, 9)
    assert int(spanning_forest(ones, ones, present_edges(ones) > 0).sum()) == 62


def test_edges_that_agree_are_all_taken_and_exact():
    """Slopes that are differences of heights: the tree alone finds them."""
    z = random_field(1, 1, 20, 20).cumsum(-1)
    z = z - z.mean()
    v = torchdls.GradientOperator("forward")(z)
    found = torchdls.solve(v, (CurlTree.of(fields_of(v)).tree).to(v.dtype), tol=1e-12)
    torch.testing.assert_close(found.height, z, rtol=0, atol=1e-8)


def fields_of(gradient):
    return AlphaSurface()._check_fields(gradient)


def test_infinite_alpha_is_least_squares_and_zero_the_tree():
    g = random_field(2, 2, 16, 18)
    everything = AlphaSurface(float("inf"), solve_tol=1e-12)
    torch.testing.assert_close(everything(g, MASK), LeastSquares(tol=1e-12)(g, MASK), rtol=0, atol=1e-8)
    graph = CurlTree.of(fields_of(g))
    tree = torchdls.solve(graph.v, graph.w * graph.tree, tol=1e-12).height
    torch.testing.assert_close(AlphaSurface(0.0, solve_tol=1e-12)(g), tree, rtol=0, atol=1e-8)
    misfit = (torchdls.GradientOperator("forward")(tree) - graph.v).abs()
    assert misfit[graph.tree].max() < 1e-8  # a tree has nothing to average


def test_more_passes_add_edges_until_none_is_left():
    g = torchdls.SURFACES["tent"](24, dtype=torch.float64).gradient + 0.1 * random_field(1, 2, 24, 24)
    one, all_of_them = AlphaSurface(3.0, n_iter=1).solve(g), AlphaSurface(3.0).solve(g)
    assert not bool(one.converged)
    assert bool(all_of_them.converged)
    assert 1 < int(all_of_them.iterations) < 50


def test_wild_samples_do_less_harm_than_to_least_squares():
    surface = torchdls.SURFACES["peaks"](40, dtype=torch.float64)
    for seed in range(3):
        wild = uniform_field(1, 1, 40, 40, seed=seed) < 0.02
        g = (
            surface.gradient
            + 0.05 * random_field(1, 2, 40, 40, seed=seed)
            + wild * 3 * random_field(1, 2, 40, 40, seed=9)
        )
        ours, plain = (torchdls.rmse(method(g), surface.height) for method in (AlphaSurface(), LeastSquares()))
        assert ours < 0.9 * plain


@pytest.mark.parametrize("options", [{"alpha": -1.0}, {"n_iter": 0}, {"solve_tol": 0.0}, {"max_iter": 0}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        AlphaSurface(**options)
