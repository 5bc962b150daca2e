"""`integrate_many`: every surface once, as by itself, whatever form the dataset has."""

import pytest
import torch
from torch.utils.data import DataLoader

from tests.helpers.maps import slopes
from torchdls import DLS, LeastSquares, SlopeDLS, integrate_many


def test_each_as_by_itself_and_small_ones_together():
    sizes = [(32, 32), (16, 48), (32, 32), (70, 70), (16, 48), (32, 32)]
    fields = [slopes(*size, seed)[0] for seed, size in enumerate(sizes)]
    found = {result.number: result for result in integrate_many(fields, LeastSquares())}
    assert sorted(found) == list(range(6))
    for k, field in enumerate(fields):
        assert torch.equal(found[k].height, LeastSquares()(field))
    assert [found[k].together for k in range(6)] == [3, 2, 3, 1, 2, 3]
    assert found[0].iterations == 0
    assert found[0].converged is True
    assert found[0].noise is None


def test_all_together_where_bits_may_differ():
    fields = [slopes(70, 66, seed)[0] for seed in range(3)]
    found = list(integrate_many(fields, LeastSquares(), exact=False))
    assert [result.together for result in found] == [3, 3, 3]
    for result in found:
        torch.testing.assert_close(result.height, LeastSquares()(fields[result.number]), rtol=0, atol=1e-4)


def test_forms_of_a_dataset():
    g = torch.cat([slopes(16, 16, seed) for seed in range(4)])
    mask = torch.ones(4, 1, 16, 16, dtype=torch.bool)
    mask[..., :3, :5] = False
    weight = torch.rand(4, 1, 16, 16, generator=torch.Generator().manual_seed(0)) + 0.5
    expected = [LeastSquares()(*(field[k] for field in (g, mask, weight))) for k in range(4)]
    mapping = [{"gradient": g, "mask": mask, "weight": weight}]
    tuples = [(g[k], mask[k], weight[k]) for k in range(4)]
    loader = DataLoader(torch.utils.data.TensorDataset(g, mask, weight), batch_size=3)
    for dataset in (mapping, tuples, loader):
        found = {result.number: result.height for result in integrate_many(dataset, LeastSquares())}
        assert all(torch.equal(found[k], expected[k]) for k in range(4))
    shared = list(integrate_many([(g, mask[:1])], LeastSquares()))  # a mask for the whole batch
    assert torch.equal(shared[2].height, LeastSquares()(g[2], mask[0]))


def test_noise_and_iterations_of_iterative_methods():
    (slope,) = integrate_many([slopes(24, 24)], SlopeDLS.fast())
    assert slope.noise == pytest.approx(float(SlopeDLS.fast().solve(slopes(24, 24)).noise))
    (dls,) = integrate_many([slopes(24, 24)], DLS(n_iter=2, tol=0))
    assert (dls.iterations, dls.converged) == (2, False)


def test_a_bad_surface_stops_the_rest_only_if_it_shall():
    fields = [slopes(16, 16, k)[0] for k in range(3)]
    fields[1][0, 3, 3] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        list(integrate_many(fields, LeastSquares()))
    found = {result.number: result for result in integrate_many(fields, LeastSquares(), errors="return")}
    assert found[1].height is None
    assert "not finite" in found[1].error
    assert torch.equal(found[2].height, LeastSquares()(fields[2]))


@pytest.mark.parametrize(
    "item, match",
    [([1, 2], "gradient int given"), ({"normals": 1}, "holds normals"), ((), "0 parts"), (torch.ones(3), "(3,)")],
)
def test_items_that_are_none(item, match):
    with pytest.raises(TypeError, match=match.replace("(", r"\(").replace(")", r"\)")):
        list(integrate_many([item], LeastSquares()))


@pytest.mark.parametrize("options, match", [({"memory": 0}, "memory=0"), ({"errors": "x"}, "errors='x'")])
def test_bad_options(options, match):
    with pytest.raises(ValueError, match=match):
        integrate_many([], LeastSquares(), **options)
