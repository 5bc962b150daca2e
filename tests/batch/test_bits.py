"""A surface has the same bits alone and in a batch, where the batch says so; threads change none where it says so."""

import itertools

import pytest
import torch

from tests.helpers.maps import slopes
from torchdls import DLS, HarkerOLeary, LeastSquares, SlopeDLS
from torchdls.batch.lots import ENOUGH, in_lots, most_together, same_bits
from torchdls.batch.many import Member, together

CHEAP = [LeastSquares(), LeastSquares(pixel_size=(2.0, 0.5))]
SIZES = [(h, w) for h in (16, 32, 48, 64) for w in (16, 32, 48, 64)]


def noise(n, h, w, dtype=torch.float32):
    return torch.randn(n, 2, h, w, generator=torch.Generator().manual_seed(h * w), dtype=torch.float64).to(dtype)


def assert_alone_and_together(integrator, g, sizes):
    with torch.no_grad():
        alone = torch.cat([integrator.solve(part).height for part in g.split(1)])
        for size in sizes:
            assert torch.equal(torch.cat([integrator.solve(part).height for part in g.split(size)]), alone), size


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("integrator", CHEAP, ids=repr)
def test_least_squares(integrator, size, dtype):
    assert same_bits(integrator, size)
    assert_alone_and_together(integrator, noise(37, size[0], size[1], dtype), (2, 5, 16, 37))


def test_what_is_not_known_goes_alone():
    assert not same_bits(LeastSquares(), (80, 64))
    assert not same_bits(LeastSquares(), (63, 64))
    assert not same_bits(LeastSquares(boundary="dirichlet"), (32, 32))
    assert not same_bits(SlopeDLS(), (32, 32))
    assert not same_bits(DLS(), (32, 32))
    assert not same_bits(HarkerOLeary(), (32, 32))


def test_a_lot_that_has_other_bits_is_not_trusted():
    """A method whose surfaces feel their neighbours: the first lot finds it out, and all go alone."""

    class Neighbours(LeastSquares):
        def _report(self, fields):
            found = super()._report(fields)
            return found._replace(height=found.height + len(fields.gradient))

    members = [Member(k, slopes(16, 16, k), None, None) for k in range(6)]
    for integrator, trust in ((Neighbours(), False), (LeastSquares(), True)):
        trusted: dict = {}
        for _ in range(2):
            found = [result for result, _ in together(members, integrator, "kind", trusted)]
            assert trusted == {"kind": trust}
            assert {result.together for result in found} == {6 if trust else 1}
            for member, result in zip(members, found, strict=True):
                assert torch.equal(result.height, integrator.solve(member.gradient).height[0])


def test_lots_are_of_one_kind_and_full():
    items = list(itertools.islice(itertools.cycle([("a", 2**14), ("b", 2**15), (None, 2**20)]), 30))
    lots = list(in_lots(items, lambda item: item[0], lambda item: item[1], 2**30))
    assert sorted(map(str, itertools.chain(*lots))) == sorted(map(str, items))
    sizes = {kind: [len(lot) for lot in lots if lot[0][0] == kind] for kind in ("a", "b", None)}
    assert sizes == {"a": [4, 4, 2], "b": [2] * 5, None: [1] * 10}
    assert most_together(2**14, 2**30) * 2**14 == ENOUGH
    assert most_together(2**14, 2**30, exact=False) > 4
    assert most_together(2**14, 1) == 1


def test_what_waits_is_bounded():
    items = [(k % 100, 10) for k in range(1000)]
    waiting = most = 0
    memory = 4 * 16 * 2000  # room for 200 of 10 pixels; a lot is 12
    taken = iter(items)

    def counted():
        nonlocal waiting, most
        for item in taken:
            waiting += 1
            most = max(most, waiting)
            yield item

    for lot in in_lots(counted(), lambda item: item[0], lambda item: item[1], memory):
        waiting -= len(lot)
    assert waiting == 0
    assert 200 <= most <= 202
