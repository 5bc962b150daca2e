"""Connected components against SciPy, and the free constant of each."""

import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import connected_components as scipy_components

from tests.helpers import random_field, seeded
from tests.helpers.oracles import differences, edge_vector
from torchdls.solvers import connected_components
from torchdls.solvers.components import free_constants


def expected_labels(linked):
    """The smallest flat index in each pixel's component, by SciPy."""
    _, h, w = linked.shape
    A = differences(h, w)
    kept = A[np.flatnonzero(edge_vector(linked))]
    labels = scipy_components(abs(kept).T @ abs(kept), directed=False)[1]
    first = {label: index for index, label in reversed(list(enumerate(labels)))}
    return np.array([first[label] for label in labels]).reshape(h, w)


@pytest.mark.parametrize("density", [0.0, 0.3, 0.5, 0.6, 0.95, 1.0])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (2, 2), (17, 23)], ids=str)
def test_labels_are_scipys(shape, density):
    linked = torch.rand(3, 2, *shape, generator=seeded(int(100 * density))) < density
    labels = connected_components(linked)
    for n in range(3):
        np.testing.assert_array_equal(labels[n].numpy(), expected_labels(linked[n]))


def test_a_spiral_is_one_component():
    """The longest path that fits: every label has to travel all of it."""
    n = 41
    inside = torch.zeros(n, n, dtype=torch.bool)
    inside[0::2] = True
    inside[1::4, -1] = True
    inside[3::4, 0] = True
    for corridor in (inside, inside.T):
        linked = torch.zeros(1, 2, n, n, dtype=torch.bool)
        linked[0, 0, :, :-1] = corridor[:, :-1] & corridor[:, 1:]
        linked[0, 1, :-1] = corridor[:-1] & corridor[1:]
        assert connected_components(linked)[0][corridor].unique().tolist() == [0]


def test_absent_edges_join_nothing():
    linked = torch.zeros(1, 2, 3, 3, dtype=torch.bool)
    linked[:, 0, :, -1] = linked[:, 1, -1] = True
    assert connected_components(linked).flatten().tolist() == list(range(9))


def fields_for_gauge(kind):
    w = torch.zeros(2, 2, 9, 8, dtype=torch.float64)
    r = torch.zeros(2, 1, 9, 8, dtype=torch.float64)
    if kind == "one component and lone pixels":
        w[0, :, 2:7, 1:5] = w[1, :, :4, 3:6] = 1
    elif kind == "lone pixels alone":
        w[0, :, 2:7, 1:5] = 1
    else:
        w = (torch.rand(2, 2, 9, 8, generator=seeded(3)) < 0.5).double()
    if kind == "many components, one held":
        r[0, 0, 4, 4] = 2.0
    return w, r


@pytest.mark.parametrize(
    "kind", ["one component and lone pixels", "lone pixels alone", "many components", "many components, one held"]
)
def test_gauge_removes_the_mean_of_every_free_component(kind):
    w, r = fields_for_gauge(kind)
    x = random_field(2, 1, 9, 8)
    y = free_constants(w, r).remove(x)
    labels = connected_components(w > 0)
    for n in range(2):
        for label in labels[n].unique():
            inside = labels[n] == label
            held = bool((r[n, 0][inside] > 0).any())
            expected = x[n, 0][inside] if held else x[n, 0][inside] - x[n, 0][inside].mean()
            torch.testing.assert_close(y[n, 0][inside], expected)
    torch.testing.assert_close(free_constants(w, r).remove(y), y)
