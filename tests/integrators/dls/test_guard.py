"""The guard of DLS against its definition, and DLS as it comes against the truth and least squares."""

import numpy as np
import pytest
import torch
from scipy.fft import dctn, idctn

from tests.helpers import MASKS, assert_gradients, random_field
from tests.helpers.methods import bumps
from torchdls import DLS, SURFACES, Huber, LeastSquares, add_noise, noise_level
from torchdls.integrators.dls.guard import guard, relative_variance
from torchdls.integrators.fields import Fields, has_even_trust
from torchdls.metrics import rmse, ssim
from torchdls.selection import discrepancy_guard

H, W = 24, 20


def fields(gradient, mask=None, weight=None, steps=(1.0, 1.0)):
    return Fields(gradient, mask, weight, None, None, steps)


def spectrum(steps):
    """S and L of every mode, from the formulas of `height_noise` and the Laplacian."""
    y, x = np.sin(np.pi * np.arange(H) / 2 / H)[:, None] ** 2, np.sin(np.pi * np.arange(W) / 2 / W)[None] ** 2
    ay, ax = 4 * y / steps[1] ** 2, 4 * x / steps[0] ** 2
    total = ax + ay
    return np.divide(ax * (1 - x) + ay * (1 - y), total**2, out=np.zeros((H, W)), where=total > 0), total


def noise_height(seed, steps=(1.0, 1.0), sigma=1.0):
    """A least-squares height of pure noise: independent modes of variance S."""
    S, _ = spectrum(steps)
    modes = np.random.default_rng(seed).standard_normal((H, W)) * np.sqrt(S) * sigma
    return torch.from_numpy(idctn(modes, norm="ortho"))[None, None]


def ramp(x, low, high):
    return min(max((x - low) / (high - low), 0), 1)


def codes_with(kept, n=1):
    """Codes of 10 patches with 64 coefficients each, of which so many are not 0, and of 5 patches without any."""
    codes = torch.zeros(n, 64, 15, dtype=torch.float64)
    codes[:, :kept, :10] = -2.0
    return codes


SPARSE = codes_with(3)


def share_by_definition(D, within, kept, steps, sigma):
    """From the four figures of the docstring, mode by mode in NumPy."""
    S, _ = spectrum(steps)
    some = S > 0

    def removed(d, p):
        C = dctn(d[0, 0].numpy(), norm="ortho")
        return (C[some] ** 2 * S[some] ** -p).sum() / sigma**2 / (S[some] ** (1 - p)).sum()

    found = removed(within, 0.25)
    share = ramp(found, 0.18, 0.28) * (1 - ramp(removed(within, 0.75) / found, 1.85, 2.2))
    share *= 1 - ramp(kept / 64, 8 / 64, 12 / 64)
    return share * (1 - ramp(removed(D, 0.25) / found, 1.15, 1.35))


@pytest.mark.parametrize("steps", [(1.0, 1.0), (0.5, 2.0)])
@pytest.mark.parametrize("taken, tilt, kept, partly", [
    (0.1, 0, 3, False), (0.25, 0, 3, True), (0.5, 0, 3, True), (0.5, 0, 10, True), (0.5, 0, 12, False),
    (1.05, 0, 3, True), (1.5, 0, 3, False), (1.9, 0, 3, False), (0.4, 0.8, 3, True),
])  # fmt: skip
def test_shares_follow_their_definition(taken, tilt, kept, partly, steps):
    """The same part of the noise is taken from every mode, or more from fine ones."""
    (S, L), sigma, reference = spectrum(steps), 0.7, random_field(1, 1, H, W, seed=2)
    D = torch.from_numpy(idctn(np.sqrt(taken * S * (1 + L) ** tilt) * sigma, norm="ortho"))[None, None]
    noise = torch.tensor([sigma], dtype=torch.float64)
    within = discrepancy_guard(reference + D, reference, noise, steps, allowance=0.0) - reference
    share = share_by_definition(D, within, kept, steps, sigma)
    assert (share > 0) == partly or tilt > 0
    whole = fields(torch.zeros(1, 2, H, W, dtype=torch.float64), steps=steps)
    height, followed = guard(reference + D, reference, codes_with(kept), whole, noise)
    torch.testing.assert_close(height, reference + share * within)
    torch.testing.assert_close(followed, torch.tensor([share], dtype=torch.float64))


def least_squares(given, gradient):
    """Their heights for other gradients, one or many."""
    n = len(gradient)
    rest = [None if t is None else t.expand(n, -1, -1, -1) for t in given[1:5]]
    return LeastSquares()(gradient, *rest)


def damaged(kind):
    """Fields of pure noise of standard deviation 1 for trusts of mean 1, and what they are known by."""
    g = np.random.default_rng(8).standard_normal((1, 2, H, W))
    mask = weight = anchor = r = None
    if kind == "mask":
        mask = MASKS["disk"](H, W)
    elif kind == "weight":
        weight = torch.linspace(0.1, 4.0, W, dtype=torch.float64).expand(1, 1, H, W).contiguous()
        g = g * (weight.mean() / weight).sqrt().numpy()
    elif kind == "anchor":
        anchor, r = (torch.zeros(1, 1, H, W, dtype=torch.float64) for _ in range(2))
        r[..., :, 0] = 5.0
    return Fields(torch.from_numpy(g), mask, weight, anchor, r, (1.0, 1.0))


KINDS = ["whole", "mask", "weight", "anchor"]


@pytest.mark.parametrize("kind", KINDS)
def test_noise_is_followed_and_what_no_noise_explains_is_given_back(kind):
    given = damaged(kind)
    reference, sigma = random_field(1, 1, H, W, seed=2), torch.ones(1).double()
    D = 0.9 * least_squares(given, given.gradient)
    found, followed = guard(reference - D, reference, SPARSE, given, sigma)
    assert (found - reference + D).norm() < 0.25 * D.norm()
    assert followed > 0.7
    for harm in (3.5 * D, 0.2 * D):
        height, followed = guard(reference - harm, reference, SPARSE, given, sigma)
        assert torch.equal(height, reference)
        assert followed == 0


@pytest.mark.parametrize("kind", KINDS)
def test_the_variance_of_every_mode_is_that_of_the_solve(kind):
    """Against many more samples through the sum of squares itself, in bands of modes; four samples scatter."""
    given = damaged(kind)
    found = relative_variance(given, has_even_trust(given)).expand(1, 1, H, W)
    n = torch.randn(300, 2, H, W, generator=torch.Generator().manual_seed(77), dtype=torch.float64)
    if given.weight is not None:
        n = n * (given.weight.mean() / given.weight).sqrt()
    z = least_squares(given, n)
    truth = np.mean(dctn(z.numpy(), norm="ortho", axes=(-2, -1)) ** 2, 0)[0]
    y, x = np.ogrid[:H, :W]
    radius = np.hypot(y, x)
    for low, high in ((3, 6), (6, 10), (10, 16)):
        ring = (radius >= low) & (radius < high)
        ratio = found[0, 0].numpy()[ring].sum() / truth[ring].sum()
        assert 0.7 < ratio < 1.4, (low, ratio)


def test_anchors_are_met_whatever_is_given_back():
    """Off the whole rectangle a height is followed as it is, never band by band."""
    given = damaged("anchor")
    reference, D = random_field(1, 1, H, W, seed=2), 0.8 * least_squares(given, given.gradient)
    D[..., :, 0] = 0
    height, followed = guard(reference - D, reference, SPARSE, given, torch.ones(1).double())
    assert followed > 0
    torch.testing.assert_close(height, reference - followed * D)
    assert torch.equal(height[..., :, 0], reference[..., :, 0])


def test_each_surface_has_its_own_guard_and_unknown_noise_changes_nothing():
    reference, D = random_field(3, 1, H, W), torch.cat([0.8 * noise_height(k) for k in range(3)])
    weight = torch.ones(3, 1, H, W, dtype=torch.float64)
    weight[1, :, 3:9] = 2.0
    noise = torch.tensor([1.0, 1.0, torch.nan]).double()
    given = fields(torch.zeros(3, 2, H, W, dtype=torch.float64), None, weight)
    codes = torch.cat([codes_with(3), codes_with(9), codes_with(30)])
    together, followed = guard(reference + D, reference, codes, given, noise)
    for k in range(3):
        one = slice(k, k + 1)
        alone = fields(given.gradient[one], None, weight[one])
        found = guard((reference + D)[one], reference[one], codes[one], alone, noise[one])
        torch.testing.assert_close(found, (together[one], followed[one]))
    torch.testing.assert_close(together[2], (reference + D)[2])
    assert followed[2] == 1


def test_derivative_where_all_of_it_is_followed():
    reference, S = random_field(1, 1, H, W), spectrum((1.0, 1.0))[0]
    D = torch.from_numpy(idctn(np.sqrt(0.5 * S), norm="ortho"))[None, None]
    noise, whole = torch.ones(1).double(), fields(torch.zeros(1, 2, H, W, dtype=torch.float64))
    assert_gradients(lambda z, r: guard(z, r, SPARSE, whole, noise)[0], reference + D, reference)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["plane", "saddle", "sphere", "gaussians"])
def test_without_noise_it_is_least_squares(name, dtype):
    if name == "plane":
        gradient = torch.tensor([0.3, -0.7], dtype=dtype).view(1, 2, 1, 1).expand(1, 2, 24, 20)
    else:
        gradient = SURFACES[name]((24, 20), dtype=dtype).gradient
    plain = LeastSquares()(gradient)
    result = DLS(n_iter=3).solve(gradient)
    assert (result.height - plain).abs().max() <= 1e-5 * plain.abs().max()
    assert (result.followed == 0).all()
    assert (DLS(n_iter=3, select=False, mu=0.1).solve(gradient).followed == 1).all()


def test_one_argument_away_is_the_bare_iteration():
    g = bumps(2, 24, 20)
    options = {"patch_size": 4, "n_atoms": 16, "n_iter": 4, "tol": 0.0}
    bare = DLS(**options, select=False)(g)
    torch.testing.assert_close(DLS(**options, mu=noise_level(g))(g), bare)  # a threshold that was asked for
    torch.testing.assert_close(DLS(**options, mu=noise_level(g), select="guard")(g), DLS(**options)(g))
    torch.testing.assert_close(DLS(**options, data_term=Huber())(g), DLS(**options, data_term=Huber(), select=False)(g))
    with pytest.raises(ValueError, match="'auto', 'guard', False, True"):
        DLS(select="risk")
    with pytest.raises(ValueError, match="not to Huber"):
        DLS(select="guard", data_term=Huber())


@pytest.mark.slow
def test_no_harm_and_a_gain_on_surfaces():
    """Draws that chose no constant; rows as in benchmarks/quality/gains.py, smaller."""
    for name in ("tent", "peaks", "saddle", "fractal", "chirp"):
        surface = SURFACES[name](64)
        for snr in (5, 20, 40, 60):
            g = torch.cat([add_noise(surface.gradient, snr, torch.Generator().manual_seed(k)) for k in range(2)])
            truth = surface.height.expand(2, -1, -1, -1)
            errors = [
                (rmse(z, truth).mean(), (1 - ssim(z, truth, surface.data_range)).mean())
                for z in (LeastSquares()(g), DLS()(g))
            ]
            for plain, guarded in zip(*errors, strict=True):
                assert guarded < 1.03 * plain + 1e-6, (name, snr)
            if snr == 5 and name in ("tent", "peaks", "saddle"):
                assert errors[1][0] < 0.95 * errors[0][0], name
