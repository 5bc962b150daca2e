"""Surfaces that repeat: against a dense solve, turned around the torus, laid side by side, and brute force."""

import itertools
import math
from functools import partial

import numpy as np
import pytest
import torch

from tests.helpers import assert_adjoint, assert_gradients, random_field
from torchdls import DLS, Exact, GradientOperator, LeastSquares, Patches, Proximal, SlopeDLS, dls_objective
from torchdls.cli import main
from torchdls.integrators.dls.guard import guard
from torchdls.integrators.fields import Fields
from torchdls.integrators.slope_dls.bases import Places
from torchdls.noise import height_noise, noise_if_told
from torchdls.operators.modes import hartley2

SMALL = {"patch_size": 4, "n_atoms": 16, "n_iter": 3, "tol": 0.0, "boundary": "periodic"}
METHODS = {
    "least_squares": (LeastSquares(boundary="periodic"), (3, -5)),
    "dls": (DLS(**SMALL), (6, -10)),
    "dls_thresholds": (DLS(mu=0.2, height_step=Proximal(3, accelerated=True), **SMALL), (6, -10)),
    "slope_dls": (SlopeDLS.fast(patch_sizes=(4, 8), boundary="periodic"), (4, -8)),
}


def waves(h: int = 32, w: int = 24, noise: float = 0.1) -> torch.Tensor:
    """Noisy slopes of a surface that repeats, (1, 2, h, w)."""
    y, x = torch.meshgrid(*(2 * math.pi * torch.arange(n, dtype=torch.float64) / n for n in (h, w)), indexing="ij")
    z = 3 * torch.sin(x) + 2 * torch.cos(2 * y + x) + (torch.sin(y) * torch.cos(x)).abs()
    slopes = GradientOperator("central", boundary="periodic")(z[None, None])
    return slopes + noise * random_field(1, 2, h, w, seed=3)


def turned(n: int) -> np.ndarray:
    """(n, n) differences around a circle."""
    return np.roll(np.eye(n), 1, 1) - np.eye(n)


@pytest.mark.parametrize("h, w, r", [(5, 6, None), (4, 7, 0.3), (1, 6, None), (3, 1, 2.0)])
def test_least_squares_is_the_dense_solution(h, w, r):
    dx, dy = 0.5, 2.0
    g, anchor = random_field(2, h, w, seed=1), random_field(1, h, w, seed=2) + 5
    A = np.vstack([np.kron(np.eye(h), turned(w)) / dx, np.kron(turned(h), np.eye(w)) / dy])
    ends = np.abs(np.vstack([np.kron(np.eye(h), turned(w) + 2 * np.eye(w)), np.zeros((h * w, h * w))]))
    below = np.abs(np.vstack([np.zeros((h * w, h * w)), np.kron(turned(h) + 2 * np.eye(h), np.eye(w))]))
    p, q = g.numpy().reshape(2, -1)
    v = (ends @ p + below @ q) / 2
    rows, known = (A, v) if r is None else (np.vstack([A, math.sqrt(r) * np.eye(h * w)]), None)
    known = v if r is None else np.concatenate([v, math.sqrt(r) * anchor.numpy().ravel()])
    expected = np.linalg.lstsq(rows, known, rcond=None)[0].reshape(1, h, w)
    given = {} if r is None else {"anchor": anchor, "anchor_weight": r}
    z = LeastSquares(boundary="periodic", pixel_size=(dx, dy))(g, **given)
    np.testing.assert_allclose(z, expected, atol=1e-11)


@pytest.mark.parametrize("name", METHODS)
def test_a_turn_of_the_slopes_turns_the_height(name):
    method, shift = METHODS[name]
    g = waves()
    torch.testing.assert_close(method(g.roll(shift, (-2, -1))), method(g).roll(shift, (-2, -1)))


@pytest.mark.parametrize("method", [METHODS["least_squares"][0], DLS(mu=0.2, **SMALL)], ids=["least_squares", "dls"])
def test_tiles_side_by_side_are_one_surface(method):
    g = waves()
    torch.testing.assert_close(method(g.repeat(1, 1, 2, 2)), method(g).repeat(1, 1, 2, 2))


@pytest.mark.parametrize("build", [LeastSquares, partial(DLS, n_iter=8), SlopeDLS.fast, partial(SlopeDLS, n_iter=4)])
def test_there_is_no_seam_and_less_noise_is_left(build):
    clean, noisy = waves(64, 48, noise=0.0), waves(64, 48, noise=0.3)
    truth = LeastSquares(boundary="periodic")(clean)
    z, free = build(boundary="periodic")(noisy), build()(noisy)

    def seam(z):
        return (z[..., 0] - z[..., -1] - truth[..., 0] + truth[..., -1]).norm()

    assert seam(z) < 0.5 * seam(free)
    plain = LeastSquares(boundary="periodic")(noisy)
    assert build is LeastSquares or (z - truth).norm() < 0.9 * (plain - truth).norm()


def test_the_objective_of_dls_never_rises_and_is_that_of_the_function():
    g = waves()
    result = DLS(mu=0.2, select=False, **(SMALL | {"n_iter": 6})).solve(g)
    assert (result.objective.diff() <= 0).all()
    found = dls_objective(
        result.height, g, result.dictionary, result.codes, result.lam, result.mu, patches=Patches(4, 2, wrap=True)
    )
    torch.testing.assert_close(found, result.objective[:, -1], rtol=1e-4, atol=0)  # but for the mean of the height


@pytest.mark.parametrize("size, stride, shape", [(4, 2, (6, 8)), ((2, 6), (1, 3), (5, 9)), (3, 3, (3, 6))], ids=str)
def test_patches_wrap(size, stride, shape):
    patches = Patches(size, stride, wrap=True)
    (p, q), (s, t) = patches.size, patches.stride
    z, corners = random_field(2, 1, *shape), itertools.product(range(0, shape[0], s), range(0, shape[1], t))
    expected = [z.roll((-r, -c), (-2, -1))[:, 0, :p, :q].flatten(1) for r, c in corners]
    X = patches.extract(z)
    torch.testing.assert_close(X, torch.stack(expected, -1), atol=0, rtol=0)
    assert_adjoint(patches.extract, lambda x: patches.adjoint(x, shape), z, random_field(*X.shape, seed=1))
    ones = torch.ones_like(z[:1])
    torch.testing.assert_close(patches.coverage(shape, dtype=z.dtype), patches.adjoint(patches.extract(ones), shape))
    assert patches.even(shape)


@pytest.mark.parametrize("stencil", ["forward", "central", (((0, 1, 2), (3, 4, 5), (6, 7, 8)), ((1,), (0,), (-2,)))])
def test_gradient_operator_wraps(stencil):
    a, inner = (GradientOperator(stencil, (0.5, 2.0), boundary) for boundary in ("periodic", "neumann"))
    z = random_field(2, 1, 6, 7)
    torch.testing.assert_close(a(z), inner(z.repeat(1, 1, 3, 3))[..., 6:12, 7:14])
    assert_adjoint(a, a.adjoint, z, random_field(2, 2, 6, 7, seed=1))


@pytest.mark.parametrize("h, w", [(5, 6), (4, 1)])
def test_hartley_transform(h, w):
    def cas(n):
        angle = 2 * math.pi * torch.arange(n, dtype=torch.float64)[:, None] * torch.arange(n) / n
        return (angle.cos() + angle.sin()) / math.sqrt(n)

    x = random_field(2, h, w)
    torch.testing.assert_close(hartley2(x), cas(h) @ x @ cas(w))
    torch.testing.assert_close(hartley2(hartley2(x)), x)


def unit_slopes(h: int, w: int) -> torch.Tensor:
    """Every sample alone, (2 h w, 2, h, w): sums of squares over them are what white noise of level 1 leaves."""
    return torch.eye(2 * h * w, dtype=torch.float64).view(-1, 2, h, w)


def test_noise_of_modes_and_of_coefficients_by_brute_force():
    steps, each = (0.8, 1.25), unit_slopes(8, 12)
    z = LeastSquares(boundary="periodic", pixel_size=steps)(each)
    torch.testing.assert_close(hartley2(z).square().sum(0)[0], height_noise((8, 12), z, steps, "periodic"))
    v = GradientOperator("forward", steps, "periodic")(z)
    p, q = v.split(1, 1)
    for turn, slopes in ((False, v), (True, torch.cat([p + q, p - q], 1) / math.sqrt(2))):
        places = Places((8, 12), 4, 1)
        flat, rows, columns = places.around()
        codes = flat.across(flat.down(slopes[..., rows, :][..., columns]))  # (size, samples, 2, 4, 6, size)
        level = codes.square().sum(1, keepdim=True).sqrt()
        torch.testing.assert_close(places.torus_noise(z, steps, turn).expand_as(level), level)


def test_the_noise_level_is_read_around_the_torus():
    g = waves(96, 80, noise=0.3)
    for steps in ((1.0, 1.0), (0.8, 1.25)):
        level = noise_if_told(g, None, None, steps, "periodic")[0]
        assert abs(float(level) - 0.3) < 0.01
    shifted = noise_if_told(g.roll((7, 11), (-2, -1)), None, None, steps, "periodic")[0]
    torch.testing.assert_close(shifted, level)


def test_the_guard_follows_a_height_without_noise_wholly():
    """What least squares leaves of pure noise, taken away at one go."""
    g = 0.3 * random_field(1, 2, 64, 64)
    reference = LeastSquares(boundary="periodic")(g)
    noise = torch.tensor([0.36], dtype=torch.float64)
    codes = torch.zeros(1, 64, 9, dtype=torch.float64)
    codes[:, 0] = 1  # sparse
    fields = Fields(g, None, None, None, None, (1.0, 1.0), boundary="periodic")
    _, followed = guard(0 * reference, reference, codes, fields, noise)
    assert followed == 1
    _, followed = guard(0 * reference, reference, codes, fields, 0.5 * noise)
    assert followed == 0


DLS_EXACT = {
    **SMALL, "patch_size": 2, "stride": 1, "n_atoms": 4, "n_iter": 2, "mu": 0.35, "lam": 0.4,
    "height_step": Exact(1e-13), "select": False,
}  # fmt: skip


@pytest.mark.parametrize(
    "method",
    [
        LeastSquares(boundary="periodic", pixel_size=(0.5, 2.0)),
        pytest.param(DLS(**DLS_EXACT), marks=pytest.mark.slow),
        DLS(**{**DLS_EXACT, "learn": "fixed"}),
        SlopeDLS.fast(patch_sizes=(2, 3), n_iter=2, guard=None, sigma=0.2, boundary="periodic"),
    ],
    ids=["least_squares", "dls", "dls_fixed", "slope_dls"],
)
def test_derivatives(method):
    anchored = "anchor" in method.accepts
    trust = torch.tensor([[[[0.3]]]], dtype=torch.float64)

    def f(g, anchor):
        return method(g, **({"anchor": anchor, "anchor_weight": trust} if anchored else {}))

    g, anchor = random_field(1, 2, 4, 5), random_field(1, 1, 4, 5, seed=1)
    assert_gradients(f if anchored else lambda g: method(g), *((g, anchor) if anchored else (g,)))


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda g, one: LeastSquares(boundary="periodic")(g, mask=one > 0),
            "LeastSquares: takes no mask with",
        ),
        (lambda g, one: DLS(boundary="periodic")(g, weight=one), "DLS: takes no weight with boundary='periodic'"),
        (lambda g, one: DLS(boundary="periodic")(g, anchor=one, anchor_weight=one), "one anchor_weight per surface"),
        (lambda g, one: SlopeDLS(boundary="periodic")(g, anchor=one, anchor_weight=1.0), "SlopeDLS: takes no anchor"),
        (lambda g, _: DLS(boundary="periodic")(g[..., :-1]), "the stride"),
        (lambda g, _: DLS(patch_size=5, boundary="periodic"), "does not divide the patch size"),
        (lambda g, _: DLS(boundary="even"), "boundary='even' is unknown"),
        (lambda g, _: SlopeDLS(boundary="even"), "boundary='even' is unknown"),
        (lambda g, _: GradientOperator(boundary="even"), "'even' is unknown"),
        (lambda g, _: DLS(data_term=LeastSquares(boundary="periodic")), "whose boundary is 'periodic'"),
        (lambda g, _: DLS(select=True, boundary="periodic"), "select=True"),
        (lambda g, _: DLS(learn="fixed", derivative="implicit", boundary="periodic"), "free borders"),
        (lambda g, _: SlopeDLS(recipe="plain", boundary="periodic"), "does not go with"),
        (lambda g, _: SlopeDLS(robust=True, boundary="periodic"), "does not go with"),
    ],
)
def test_what_a_torus_cannot_have_is_said(call, message):
    with pytest.raises(ValueError, match=message):
        call(random_field(1, 2, 16, 16), torch.ones(1, 1, 16, 16, dtype=torch.float64))


@pytest.mark.parametrize("method", ["least_squares", "dls", "slope_dls"])
def test_from_the_command_line(method, tmp_path):
    g = waves().float()
    np.savez(tmp_path / "g.npz", gradient=g[0].numpy())
    arguments = ["integrate", str(tmp_path / "g.npz"), "--method", method, "--set", "boundary=periodic"]
    assert main([*arguments, "-o", str(tmp_path / "z.npy")]) == 0
    z = np.load(tmp_path / "z.npy").squeeze()
    beside = np.abs(np.diff(z, axis=1)).max()
    assert np.abs(z[:, 0] - z[:, -1]).max() < 1.2 * beside
