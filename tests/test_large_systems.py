"""Out of core as in memory: DLS, and least squares with weights and anchors."""

import numpy as np
import pytest
import torch

from tests.helpers.large import BLOCK, disk_ring_and_specks, field, whole
from torchdls import DLS, Exact, LeastSquares, SlopeDLS, SoupDIL, large

PLAIN = {"n_iter": 3, "mu": 0.3, "tol": 0, "select": False, "height_step": Exact(tol=1e-13)}


@pytest.mark.parametrize(
    "options, tile",
    [
        ({}, 24),
        ({}, 200),
        ({"learn": "fixed", "learner": "fixed"}, 17),
        ({"learner": SoupDIL(order="block", threshold="soft", n_sweeps=2), "mu": [0.3, 0.2, 0.1]}, 31),
        ({"patch_size": (5, 6), "stride": (2, 3), "n_atoms": 40, "lam": 0.2}, 16),
        ({"n_iter": 12, "tol": 0.1}, 40),
        ({"mu": 0.0}, 24),
    ],
)
def test_dls_by_tiles_is_that_of_the_whole(options, tile):
    h, w, step = 45, 52, (0.8, 1.25)
    options = {"learner": BLOCK} | PLAIN | options
    g, found = field(h, w), np.empty((h, w))
    result = large.integrate(g, found, integrator=DLS(**options), pixel_size=step, tile=tile, memory=2**17)
    expected = DLS(**options, pixel_size=step).solve(torch.from_numpy(g))
    np.testing.assert_allclose(found, expected.height[0, 0].numpy(), rtol=0, atol=1e-8)
    if options["mu"] != 0:
        assert result.iterations == int(expected.iterations)
        assert result.converged == bool(expected.converged) == (options["tol"] > 0)
        assert np.abs(found - whole(g, pixel_size=step)).max() > 0.05
    assert result.passes[0] > 1


def test_dls_by_tiles_with_the_noise_of_its_tiles():
    g, found = field(45, 52, np.float32), np.empty((45, 52), np.float32)
    method = DLS(**PLAIN | {"learner": BLOCK, "mu": "auto", "height_step": "exact"})
    result = large.integrate(g, found, integrator=method, tile=30, halo=4)
    assert result.noise == pytest.approx(0.3, rel=0.2)
    given = DLS(**PLAIN | {"learner": BLOCK, "mu": result.noise, "height_step": "exact"})
    np.testing.assert_allclose(found, given(torch.from_numpy(g))[0].numpy(), rtol=0, atol=1e-3)
    flat, plane = np.ones((2, 40, 40)), np.empty((40, 40))
    assert large.integrate(flat, plane, integrator=method, tile=20).noise == 0
    np.testing.assert_allclose(plane, whole(flat), rtol=0, atol=1e-9)


def test_dls_where_no_patch_fits_is_least_squares():
    g, found = field(6, 90), np.empty((6, 90))
    large.integrate(g, found, integrator=DLS(**PLAIN, learner=BLOCK))
    np.testing.assert_allclose(found, whole(g), rtol=0, atol=1e-9)


def trusts(h, w, planes=1):
    """From next to nothing to a hundred, none in a corner."""
    rng = np.random.default_rng(h + w)
    found = 10.0 ** rng.uniform(-2, 1, (planes, h, w)) * (1 + np.linspace(0, 9, w))
    found[:, : h // 5, : w // 4] = 0
    return found


BESIDE = {
    "weight": lambda h, w: {"weight": trusts(h, w)},
    "weights of both slopes, mask": lambda h, w: {"weight": trusts(h, w, 2), "mask": disk_ring_and_specks(h, w)},
    "anchor": lambda h, w: {"anchor": np.full((h, w), 1e3), "anchor_weight": 0.1},
    "a few anchors": lambda h, w: {
        "anchor": np.where(trusts(h, w)[0] > 90, 7.0, np.nan),
        "anchor_weight": np.where(trusts(h, w)[0] > 90, 3.0, 0),
    },
    "all": lambda h, w: {
        "mask": disk_ring_and_specks(h, w),
        "weight": trusts(h, w),
        "anchor": np.random.default_rng(1).normal(50, 1, (h, w)),
        "anchor_weight": trusts(h, w)[0] * (np.arange(w) > w // 3),
    },
    "firm": lambda h, w: {"anchor": np.random.default_rng(1).normal(50, 1, (h, w)), "anchor_weight": 9.0},
}


@pytest.mark.parametrize(
    "tile, kind", [*((25, kind) for kind in BESIDE), (9, "firm"), (100, "weight"), (17, "a few anchors")]
)
def test_weights_and_anchors_equal_those_in_memory(tile, kind):
    h, w, step = 34, 41, (0.8, 1.25)
    beside, g, found = BESIDE[kind](h, w), field(h, w), np.empty((h, w))
    exact = LeastSquares(tol=1e-12, max_iter=3000, pixel_size=step)
    result = large.integrate(g, found, **beside, integrator=exact, tile=tile)
    assert result.converged
    tensors = {
        name: torch.from_numpy(np.broadcast_to(part, (1, h, w)).copy() if np.ndim(part) < 3 else part)
        for name, part in beside.items()
    }
    expected = exact(torch.from_numpy(g), **tensors)[0].numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * np.ptp(expected))


def test_anchors_far_away_in_single_precision(tmp_path):
    h, w = 64, 48
    g, mask = field(h, w, np.float32), disk_ring_and_specks(h, w)
    r = np.where(np.random.default_rng(0).random((h, w)) < 0.05, 1, 0).astype(np.float32)
    a = (1e5 + whole(g)).astype(np.float32)
    for name, array in {"g": g, "m": mask, "a": a, "r": r}.items():
        np.save(tmp_path / f"{name}.npy", array)
    files = {"mask": tmp_path / "m.npy", "anchor": tmp_path / "a.npy", "anchor_weight": tmp_path / "r.npy"}
    large.integrate(tmp_path / "g.npy", tmp_path / "z.npy", **files, tile=20)
    slopes, heights, trust = (torch.from_numpy(x).double() for x in (g, a[None], r[None]))
    inside = torch.from_numpy(mask)[None]
    expected = LeastSquares(tol=1e-10)(slopes, inside, anchor=heights, anchor_weight=trust)[0].numpy()
    np.testing.assert_allclose(np.load(tmp_path / "z.npy"), expected, rtol=0, atol=0.05)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npy", "g.npy", "m.npy", "r.npy", "z.npy"]


@pytest.mark.parametrize(
    "beside, match",
    [
        ({"weight": np.ones((8, 9))}, r"weight \(8, 9\)"),
        ({"weight": np.ones((3, 8, 8))}, r"weight \(3, 8, 8\)"),
        ({"weight": np.full((8, 8), -1.0)}, "weight is negative or not finite in rows 0 to"),
        ({"weight": np.full((8, 8), np.nan)}, "weight is negative or not finite"),
        ({"weight": np.zeros((8, 8))}, "no pixel has a neighbour that is trusted"),
        ({"anchor": np.ones((8, 8))}, "anchor is given without anchor_weight"),
        ({"anchor_weight": 1.0}, "anchor_weight is given without anchor"),
        ({"anchor": np.ones((8, 7)), "anchor_weight": 1.0}, r"anchor \(8, 7\)"),
        ({"anchor": np.ones((8, 8)), "anchor_weight": np.inf}, "anchor_weight is negative or not finite"),
        ({"anchor": np.full((8, 8), np.nan), "anchor_weight": 1.0}, "anchor is not finite in rows 0 to"),
        ({"weight": np.ones((8, 8)), "integrator": SlopeDLS()}, "weight is given, which least squares alone"),
    ],
)
def test_what_weights_and_anchors_may_not_be(beside, match):
    with pytest.raises(ValueError, match=match):
        large.integrate(np.zeros((2, 8, 8)), np.zeros((8, 8)), **beside)
