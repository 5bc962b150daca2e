"""Thin and small fields: a single pixel, row or column, two by two, corridors of one pixel, less than a patch."""

import pytest
import torch

from tests.helpers import random_field
from tests.helpers.methods import method
from torchdls import DLS, INTEGRATORS, HornBrooks, Huber, LeastSquares, SlopeDLS, edge_slopes
from torchdls.noise import noise_if_told

SIZES = [(1, 1), (1, 2), (1, 7), (7, 1), (2, 2), (2, 9), (3, 3), (40, 1)]
DTYPES = [torch.float32, torch.float64]


def plane(h, w, dtype):
    y, x = torch.meshgrid(*(torch.arange(n, dtype=dtype) for n in (h, w)), indexing="ij")
    g = torch.tensor([0.3, -0.7], dtype=dtype).view(1, 2, 1, 1).expand(1, 2, h, w).clone()
    return g, (0.3 * x - 0.7 * y)[None, None]


def corridor(h, w):
    """A path one pixel wide: along every other row, and down at their ends in turn."""
    mask = torch.zeros(1, 1, h, w, dtype=torch.bool)
    mask[..., ::2, :] = True
    for turn, row in enumerate(range(1, h - 1, 2)):
        mask[..., row, -1 if turn % 2 == 0 else 0] = True
    return mask


def check(integrator, g, z, *given):
    """The plane, with a derivative that is there and finite."""
    leaf = g.clone().requires_grad_()
    found = integrator(leaf, *given)
    assert found.requires_grad
    (found * random_field(*found.shape, seed=1).to(found)).sum().backward()
    assert leaf.grad.isfinite().all()
    if "plane_is_exact" not in method(INTEGRATORS.name_of(type(integrator)) or "").no or isinstance(integrator, DLS):
        tol = 2e-3 if isinstance(integrator, HornBrooks) else 1e-4
        torch.testing.assert_close(found.detach(), z, rtol=0, atol=tol * float(z.abs().max()) + 1e-6)
    assert found.isfinite().all()


def default(name):
    """The method at its defaults, but for one that needs thousands of sweeps there."""
    return INTEGRATORS[name](**({"relaxation": 1.8} if name == "horn_brooks" else {}))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", INTEGRATORS)
def test_planes_at_the_defaults(name, dtype):
    for size in SIZES:
        g, z = plane(size[0], size[1], dtype)
        check(default(name), g, z - z.mean())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "slope_dls" else ())
        for name in INTEGRATORS
        if "mask" in INTEGRATORS[name].accepts
    ],
)
def test_planes_in_corridors_of_one_pixel(name, dtype):
    for mask in (corridor(11, 9), corridor(11, 9).mT.contiguous(), torch.eye(12, dtype=torch.bool)[None, None]):
        g, z = plane(mask.shape[-2], mask.shape[-1], dtype)
        _, w = edge_slopes(g, mask)
        z = torch.where(mask, z - z[mask].mean(), 0) if bool((w > 0).any()) else torch.zeros_like(z)
        check(default(name), g, z, mask)


@pytest.mark.parametrize("size", [(1, 9), (9, 1), (5, 7), (7, 40), (1, 1)])
def test_dls_without_room_for_a_patch_is_its_data_term(size):
    g = random_field(2, 2, *size)
    anchors = {"anchor": random_field(2, 1, *size, seed=1), "anchor_weight": 0.3}
    for given in ({}, anchors):
        for data_term in (LeastSquares(), Huber()):
            for options in ({}, {"mu": 0.5}, {"learn": "shared"}, {"learner": "fixed"}):
                found = DLS(data_term=data_term, pixel_size=0.5, **options).solve(g, **given)
                expected = type(data_term)(pixel_size=0.5)(g, **given)
                torch.testing.assert_close(found.height, expected, rtol=0, atol=1e-9)
                assert found.codes.shape == (2, 64, 0)
                assert found.converged.all()
                assert (found.lam == 0).all()
                assert (found.objective.diff() == 0).all()
        if not given:
            torch.testing.assert_close(DLS(select=True)(g), LeastSquares()(g), rtol=0, atol=1e-9)


@pytest.mark.parametrize("integrator", [DLS(4, n_atoms=16), SlopeDLS(), SlopeDLS.fast(), SlopeDLS(recipe="plain")])
def test_noise_that_nothing_tells_means_least_squares(integrator):
    g, mask = random_field(1, 2, 11, 9), corridor(11, 9)
    expected = LeastSquares(tol=1e-10)(g, mask)
    torch.testing.assert_close(integrator(g, mask), expected, rtol=0, atol=2e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("integrator", [DLS(4, n_atoms=16, tol=0.0, n_iter=3), SlopeDLS(patch_sizes=(4, 8), n_iter=2)])
def test_beside_a_surface_that_tells_its_noise(integrator):
    g, mask = random_field(2, 2, 11, 9), torch.cat([corridor(11, 9), torch.ones(1, 1, 11, 9, dtype=torch.bool)])
    together = integrator(g, mask)
    for i in range(2):
        torch.testing.assert_close(together[i : i + 1], integrator(g[i : i + 1], mask[i : i + 1]), rtol=0, atol=1e-3)


def test_which_surfaces_tell_their_noise():
    g = random_field(2, 2, 11, 9).requires_grad_()
    mask = torch.cat([corridor(11, 9), torch.ones(1, 1, 11, 9, dtype=torch.bool)])
    level, told = noise_if_told(g, mask, None, (1.0, 1.0))
    assert told.tolist() == [False, True]
    assert level[0] == 0
    assert 0.5 < level[1] < 1.5
    level.sum().backward()
    assert g.grad.isfinite().all()
    assert (g.grad[0] == 0).all()
    for size in ((1, 5), (5, 1), (1, 1)):
        level, told = noise_if_told(random_field(3, 2, *size), None, None, (1.0, 1.0))
        assert level.tolist() == [0, 0, 0]
        assert not told.any()


@pytest.mark.parametrize("down", [False, True])
def test_lines_with_holes_and_weights(down):
    """One row of patches, of which some know nothing: what remains is the cumulative sum of the slopes, noise aside."""
    g, weight = (
        torch.full((1, 2, 1, 13), 0.5, dtype=torch.float64),
        0.5 + torch.arange(13.0).double().view(1, 1, 1, 13) % 3,
    )
    mask = torch.ones(1, 1, 1, 13, dtype=torch.bool)
    mask[..., [0, 1, 8]] = False
    given = (t.mT if down else t for t in (g, mask, weight))
    height = SlopeDLS()(*given)
    height = height.mT if down else height
    for part in (slice(2, 8), slice(9, 13)):
        torch.testing.assert_close(height[..., part].diff(), torch.full_like(height[..., part].diff(), 0.5))
