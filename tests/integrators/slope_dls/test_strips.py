"""The compiled loops against the coding by PyTorch alone, which other tests hold against dense matrices."""

from dataclasses import replace

import pytest
import torch

from tests.helpers import random_field
from torchdls import SlopeDLS, _compiled, backends
from torchdls.integrators.slope_dls import strips_fused
from torchdls.integrators.slope_dls.bases import PatchNoise, Places
from torchdls.integrators.slope_dls.coding import Coded
from torchdls.integrators.slope_dls.lines import atoms
from torchdls.integrators.slope_dls.runs import Run

pytestmark = pytest.mark.skipif(not _compiled.installed(), reason="Numba is not installed (the extra `fast`)")
STEPS = (1.0, 1.3)


def by_pytorch(monkeypatch, f, *args, **options):
    with monkeypatch.context() as alone:
        alone.setattr(_compiled, "installed", lambda: False)
        assert backends()["SlopeDLS"] == "torch"
        return f(*args, **options)


def both(monkeypatch, run, *args):
    """The sums by the loops and by PyTorch."""
    assert strips_fused.serves(*args[:3])
    found = run._code_patches(*args)
    return found, by_pytorch(monkeypatch, run._code_patches, *args)


def same(found, expected, rtol=1e-10):
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other.expand_as(one), rtol=rtol, atol=rtol * float(other.abs().max()))


@pytest.mark.parametrize("weights", ["size", "count", "equal"])
@pytest.mark.parametrize("size, offset", [(2, 0), (4, 1), (6, 2), (10, 0), (16, 5), (32, 3)])
def test_they_do_what_pytorch_does(size, offset, weights, monkeypatch):
    """Sides that end off the grid, a batch, and each surface with a level of its own."""
    x, places = random_field(2, 2, 41, 50, seed=size), Places((41, 50), size, offset)
    level = torch.tensor([0.5, 1.0], dtype=x.dtype)[:, None, None, None]
    found, expected = both(monkeypatch, Run(weights=weights), places, x, level, PatchNoise(places, STEPS))
    same(found, expected)
    assert float((found.total / found.weight - x).abs().max()) > 0.1  # something was cut


@pytest.mark.parametrize("where, turned", [("here", True), ("far", False), ("torus", False), ("torus", True)])
def test_noise_of_every_kind(where, turned, monkeypatch):
    x, torus = random_field(1, 2, 40, 48, seed=1), Places((40, 48), 8, 2)
    places = torus.around()[0] if where == "torus" else torus
    if where == "torus":
        x = random_field(1, 2, *places.shape, seed=1)
    noise = PatchNoise(torus, STEPS, turned, where)
    level = torch.full((1, 1, 1, 1), 0.8, dtype=x.dtype)
    same(*both(monkeypatch, Run(), places, x, level, noise))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_levels_and_trust_of_single_patches(threads, monkeypatch):
    """With more threads than surfaces, bands of strips; sums go on from those of other patches."""
    x, places = random_field(1, 2, 60, 45, seed=2), Places((60, 45), 8, 1)
    grid = tuple(len(line.positions) for line in places.lines)
    trust, level = (random_field(1, 2, *grid, seed=k).abs() for k in (3, 4))
    trust[..., :3] = 0
    args = places, x, level, PatchNoise(places, STEPS, where="far"), trust
    expected = by_pytorch(monkeypatch, Run()._code_patches, *args)
    monkeypatch.setattr(strips_fused, "_AT_ONCE", 1)
    torch.set_num_threads(threads)
    try:
        found = Run()._code_patches(*args)
        again = Run()._code_patches(*args, Coded(*(x.clone() for x in found)))
    finally:
        torch.set_num_threads(1)
    same(found, expected)
    same(again, [2 * x for x in expected])


def test_a_long_side_shares_the_noise_in_its_middle(monkeypatch):
    x, places = random_field(1, 2, 20, 260, seed=5), Places((20, 260), 8, 3)
    level = torch.ones(1, 1, 1, 1, dtype=x.dtype)
    same(*both(monkeypatch, Run(), places, x, level, PatchNoise(places, STEPS)))


def test_accuracy_in_float32_is_that_of_pytorch(monkeypatch):
    """Nothing is near a threshold of 0, so that rounding alone is seen."""
    x, level = random_field(1, 2, 64, 64, seed=6), torch.zeros(1, 1, 1, 1)
    for size in (4, 16, 32):
        places = Places((64, 64), size, 1)
        args = places, x.float(), level, PatchNoise(places, STEPS)
        exact = by_pytorch(monkeypatch, Run(weights="equal")._code_patches, places, x, level.double(), args[3])
        ours, theirs = (
            float((sums.total.double() - exact.total).abs().max())
            for sums in both(monkeypatch, Run(weights="equal"), *args)
        )
        assert ours < max(2 * theirs, 4e-6), size


@pytest.mark.parametrize("kind", ["blend", "quick", "disk", "periodic", "weight"])
def test_heights_are_those_of_pytorch(kind, monkeypatch):
    g = random_field(1, 2, 36, 44, seed=7) * 0.3 + 1
    y, x = torch.meshgrid(torch.arange(36.0), torch.arange(44.0), indexing="ij")
    recipe, boundary = "blend" if kind == "blend" else "quick", "periodic" if kind == "periodic" else "neumann"
    method = SlopeDLS(recipe=recipe, n_iter=2, boundary=boundary)
    mask = ((y - 18).square() + (x - 20).square() < 250)[None, None] if kind == "disk" else None
    weight = (0.5 + x / 44)[None, None].double() if kind == "weight" else None
    found, expected = method(g, mask, weight), by_pytorch(monkeypatch, method, g, mask, weight)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6 * float(expected.std()))


def test_what_they_do_not_serve_is_left_to_pytorch(monkeypatch):
    x, level = random_field(1, 2, 40, 40, seed=8), torch.full((1, 1, 1, 1), 0.5, dtype=torch.float64)
    monkeypatch.setattr(strips_fused, "code", lambda *_: pytest.fail("the loops leave no derivative, nor odd sizes"))
    places = Places((40, 40), 8, 1)
    assert Run()._code_patches(places, x.clone().requires_grad_(), level, PatchNoise(places, STEPS)).total.requires_grad
    for size in (5, 40):
        places = replace(places, size=size)
        Run()._code_patches(places, x, level, PatchNoise(places, STEPS))


@pytest.mark.parametrize("size", [8, 16, 17, 64, 97])
def test_atoms_are_even_or_odd(size):
    """To the last: the loops use the first half of each."""
    basis = atoms(size, True, like=torch.empty(0, dtype=torch.float64))
    torch.testing.assert_close(basis @ basis.mT, torch.eye(size, dtype=torch.float64), atol=1e-13, rtol=0)
    mirrored = (basis * basis.flip(1)).sum(1)
    torch.testing.assert_close(mirrored.abs(), torch.ones_like(mirrored), atol=1e-13, rtol=0)
    assert int((mirrored > 0).sum()) == (size + 1) // 2
    assert mirrored[:6].sign().tolist() == [1, -1] * 3  # polynomials, or cosines
