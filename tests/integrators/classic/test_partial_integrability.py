"""PartialIntegrability against dense least squares without the released edges."""

import numpy as np
import pytest
import torch

import torchdls
from tests.helpers import MASKS, random_field
from tests.helpers.oracles import differences, edge_vector
from torchdls import LeastSquares, PartialIntegrability
from torchdls.integrators.classic.curl_tree import CurlTree
from torchdls.operators.edges import cell_curl, present_edges
from torchdls.solvers import connected_components


def test_it_is_least_squares_without_the_released_rows():
    g = random_field(1, 2, 9, 11)
    method = PartialIntegrability(1.0, solve_tol=1e-12)
    kept = edge_vector((~method.released(g))[0]).astype(bool)
    assert 5 < (~kept).sum() < 60
    v = edge_vector(torchdls.edge_slopes(g)[0][0])
    z = np.linalg.lstsq(differences(9, 11).toarray()[kept], v[kept], rcond=None)[0]
    np.testing.assert_allclose(method(g).flatten(), z - z.mean(), atol=1e-8)


def test_a_wild_edge_is_released_and_no_other():
    """One slope far off in the middle of a noisy plane: the two cells beside it agree on it."""
    surface = torchdls.SURFACES["peaks"](24, dtype=torch.float64)
    v = torchdls.GradientOperator("forward")(surface.height) + 1e-3 * random_field(1, 2, 24, 24)
    v[0, 0, 11, 7] += 2.0
    method, fields = PartialIntegrability(8.0), PartialIntegrability()._check_fields(v)
    graph = CurlTree.of(fields)
    curl = cell_curl(v)
    noise = curl.abs().median().view(1, 1, 1) / 0.6745
    graph = graph._replace(v=v, w=present_edges(v), curl=curl, noise=noise)
    assert method._released(fields, graph).nonzero().tolist() == [[0, 0, 11, 7]]


def test_nothing_is_released_where_curl_is_within_its_noise():
    g = torchdls.SURFACES["peaks"](24, dtype=torch.float64).gradient + 0.1 * random_field(1, 2, 24, 24)
    method = PartialIntegrability(10.0)
    assert not method.released(g).any()
    torch.testing.assert_close(method(g), LeastSquares()(g), rtol=0, atol=1e-5)


def test_no_pixel_loses_its_hold():
    mask = MASKS["ring_and_islands"](16, 18)
    g = random_field(2, 2, 16, 18)
    released = PartialIntegrability(1e-3).released(g, mask)
    w = torchdls.edge_slopes(g, mask)[1]
    assert torch.equal(connected_components(w > 0).expand(2, -1, -1), connected_components((w > 0) & ~released))
    assert released.any()
    assert not (released & (w == 0)).any()


@pytest.mark.parametrize("options", [{"threshold": 0.0}, {"solve_tol": 0.0}, {"max_iter": 0}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        PartialIntegrability(**options)
