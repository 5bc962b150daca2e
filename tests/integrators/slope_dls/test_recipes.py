"""The runs, their blend and the slow waves: against brute force, independent optimisers and simulated noise."""

import numpy as np
import pytest
import torch
from scipy.fft import dctn, idctn
from scipy.optimize import minimize

from tests.helpers import DISK, random_field, seeded
from torchdls import SURFACES, LeastSquares, SlopeDLS, add_noise, rmse, ssim
from torchdls.integrators.slope_dls.bases import PatchNoise, Places
from torchdls.integrators.slope_dls.blend import blend_by_waves, least_in_simplex, signs, sure_weights
from torchdls.integrators.slope_dls.holed import _around
from torchdls.integrators.slope_dls.known import Known
from torchdls.integrators.slope_dls.lines import atoms
from torchdls.integrators.slope_dls.runs import FOUR, HOLED, Grid, Run, smooth
from torchdls.integrators.slope_dls.waves import cautious, shrink_slow_waves
from torchdls.noise import height_noise
from torchdls.operators import GradientOperator, dct2, idct2
from torchdls.operators.edges import extend_edges
from torchdls.surfaces import terrain

STEPS = (0.8, 1.25)
PLACES = [Places((13, 18), 8, 2), Places((21, 17), 17), Places((21, 18), 16, 3), Places((9, 6), 3), Places((1, 5), 1)]
LONG = [Places((140, 29), 8, 3), Places((5, 131), 5, 1), Places((131, 150), 17, 0), Places((9, 300), 2)]


def coefficients_of(places, x):
    return places.across(places.down(x))


def heights_of(places, c):
    return places.back_down(places.back_across(c))


@pytest.mark.parametrize("places", PLACES + LONG, ids=str)
def test_patches_are_orthonormal_and_cover_all(places):
    """Short axes go through dense matrices, long ones block by block; odd sides have three blocks."""
    x, size = random_field(2, 2, *places.shape), places.size
    c = coefficients_of(places, x)
    rows, columns = (line.positions for line in places.lines)
    basis = atoms(size, places.smooth, like=x)
    torch.testing.assert_close(basis @ basis.mT, torch.eye(size, dtype=torch.float64))
    count = torch.zeros(places.shape, dtype=torch.float64)
    for j, top in enumerate(rows):
        for i, left in enumerate(columns):
            patch = x[..., top : top + size, left : left + size]
            torch.testing.assert_close(c[:, :, :, j, i], (basis @ patch @ basis.mT).movedim(-2, 0))
            count[top : top + size, left : left + size] += 1
    assert count.min() > 0
    torch.testing.assert_close(heights_of(places, c), x * count)
    torch.testing.assert_close(places.spread(torch.ones_like(c[0, ..., 0])), count.expand_as(x))
    torch.testing.assert_close(places.coverage(x)[0, 0], count)


@pytest.mark.parametrize("places", [PLACES[0], *LONG], ids=str)
def test_sums_of_patches_are_the_transpose_of_cutting_them(places):
    x = random_field(1, 2, *places.shape, seed=1)
    c = random_field(*coefficients_of(places, x).shape, seed=2)
    inner = (coefficients_of(places, x) * c).sum(), (x * heights_of(places, c)).sum()
    torch.testing.assert_close(*inner)
    weight = random_field(*c.shape[1:-1], seed=3)
    ones = coefficients_of(places, torch.ones_like(x))
    torch.testing.assert_close(places.spread(weight), heights_of(places, ones * weight[..., None]))


def test_strips_are_parts_of_the_whole():
    places, x = Places((140, 150), 8, 3), random_field(1, 2, 140, 150)
    whole, noise, strips = coefficients_of(places, x), places.noise(x, STEPS), places.down(x)
    slices = [slice(k, k + 5) for k in range(0, len(places.lines[0].positions), 5)]
    parts = [places.across(strips[..., rows, :]) for rows in slices]
    torch.testing.assert_close(torch.cat(parts, 3), whole)
    torch.testing.assert_close(torch.cat([places.noise(x, STEPS, strips=rows) for rows in slices], 3), noise)
    counted = [k for rows in Places((500, 600), 4).strips(3) for k in range(rows.start, rows.stop)]
    assert counted == [*range(249)]


def test_large_patches_hold_a_polynomial_in_few_coefficients():
    t = torch.linspace(-1, 1, 20, dtype=torch.float64)
    x = (1 - t[:, None] ** 2 + t**3 * t[:, None])[None, None].expand(1, 2, -1, -1)
    found = coefficients_of(Places((20, 20), 20), x)
    assert (found.abs() > 1e-10).sum() == 2 * 4  # 1, y^2, x y, x^3 y (as Legendre-like products) in each component


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("places", PLACES[:4], ids=str)
def test_noise_of_every_coefficient_is_exact(places, turned):
    """Least squares is linear: its answers to all unit gradients tell the variance of everything."""
    h, w = places.shape
    g = torch.eye(2 * h * w, dtype=torch.float64).view(-1, 2, h, w)
    slopes = extend_edges(GradientOperator("forward", STEPS)(LeastSquares(pixel_size=STEPS)(g)))
    if turned:
        p, q = slopes.split(1, 1)
        slopes = torch.cat([p + q, p - q], 1) / 2**0.5
    spread = coefficients_of(places, slopes).square().sum(1, keepdim=True).sqrt()
    torch.testing.assert_close(places.noise(g, STEPS, turned), spread, atol=1e-10, rtol=0)


@pytest.mark.parametrize("size", [8, 64])
def test_in_large_images_patches_in_the_middle_share_their_noise(size):
    """Against the influence of every sample on one coefficient, by reverse differentiation of least squares."""
    places = Places((64, 330), size, 2)
    noise = places.noise(torch.empty(0, dtype=torch.float64), STEPS)
    rows, columns = (line.positions for line in places.lines)
    for i in (0, 1, len(columns) // 2, len(columns) - 1):
        g = torch.zeros(1, 2, 64, 330, dtype=torch.float64)
        c = torch.zeros(size, 1, 2, len(rows), len(columns), size, dtype=torch.float64)
        c[0, 0, 0, 0, i, 1] = 1
        atom = heights_of(places, c)  # (1, 2, H, W): atom (0, 1) of a patch in the slopes in x
        assert atom[..., rows[0] : rows[0] + size, columns[i] : columns[i] + size].square().sum() > 0.99
        a = GradientOperator("forward", STEPS)
        with torch.enable_grad():
            g.requires_grad_()
            seen = (extend_edges(a(LeastSquares(pixel_size=STEPS)(g)))[:, :1] * atom[:, :1]).sum()
            (influence,) = torch.autograd.grad(seen, g)  # linear: the variance is the energy of this
        assert abs(float(noise[0, 0, 0, 0, i, 1] / influence.norm()) - 1) < 0.03


@pytest.mark.parametrize("run", [*FOUR, Run(sizes=(3, 5), turned=True)], ids=range(5))
def test_without_threshold_a_run_codes_everything(run):
    slopes = random_field(2, 2, 23, 31)
    coded = run.code(slopes, torch.zeros(2, dtype=torch.float64), STEPS, 3)
    torch.testing.assert_close(coded, slopes)


def test_least_in_simplex_against_an_independent_optimiser():
    roots, b = random_field(12, 4, 4, seed=1), random_field(12, 4, seed=2)
    G = roots @ roots.mT
    found = least_in_simplex(G, b)
    assert (found >= 0).all()
    assert (found.sum(1) <= 1 + 1e-6).all()

    def cost(w, k):
        return 0.5 * w @ G[k].numpy() @ w + b[k].numpy() @ w

    for k in range(12):
        limits = {"type": "ineq", "fun": lambda w: 1 - w.sum()}
        best = min(
            minimize(cost, start, (k,), bounds=[(0, 1)] * 4, constraints=[limits], options={"ftol": 1e-12}).fun
            for start in ([0.0] * 4, [0.25] * 4)
        )
        assert cost(found[k].numpy(), k) < best + 1e-6
    assert (found > 1e-6).sum(1).unique().numel() > 1  # several kinds of corners were met


def test_blend_finds_the_factor_of_a_linear_filter():
    """With one candidate the weight is near the one that the truth would choose."""
    surface = SURFACES["peaks"](64, dtype=torch.float64)
    gradient = add_noise(surface.gradient, 3, seeded(1))
    sigma = (gradient - surface.gradient).std()[None]
    k = torch.arange(64, dtype=torch.float64)
    f = 1 / (1 + ((k[:, None] ** 2 + k**2) / 60) ** 2)

    def smoothed(g):
        return idct2(f * dct2(LeastSquares()(g)))

    n = torch.where(random_field(1, 2, 64, 64, seed=5) > 0, 1.0, -1.0).double()
    plain = LeastSquares()(gradient)
    w = sure_weights(smoothed(gradient)[None], smoothed(n)[None], plain, LeastSquares()(n), sigma, norm=0.5)
    D, error = dct2(smoothed(gradient) - plain), dct2(plain - surface.height)
    S = height_noise((64, 64), plain)
    weight = torch.where(S > 0, S.clamp(min=1e-30).rsqrt(), 0)
    best = -float((weight * D * error).sum() / (weight * D * D).sum())
    assert 0.1 < best < 0.9
    assert abs(float(w) - best) < 0.05


def test_slow_waves_and_the_others_have_weights_of_their_own():
    """By the definition, quadratic programs solved by SciPy: relative risk of a part, and a tenth of the other's."""
    h, w, sigma = 40, 56, 0.7
    frequency = np.hypot(np.arange(h)[:, None] / (2 * h), np.arange(w) / (2 * w))
    slow = (frequency > 0) & (frequency < 1 / 16)
    reference, moved = (random_field(1, 1, h, w, seed=k) for k in (1, 2))
    heights, changes = random_field(3, 1, h, w, seed=3)[:, None], 0.3 * random_field(3, 1, h, w, seed=4)[:, None]
    heights, changes = reference + 0.3 * (heights - reference) - 0.5 * moved, changes + 0.5 * moved
    level = torch.tensor([sigma], dtype=torch.float64)
    D, push, change = (
        dctn(t.numpy(), norm="ortho", axes=(-2, -1)) for t in (heights - reference, moved, changes - moved)
    )
    S = height_noise((h, w), reference).numpy()
    W = np.divide(1, np.sqrt(S), out=np.zeros_like(S), where=S > 0)
    found = np.zeros((h, w))
    for part in (slow, ~slow):
        scale = W * (part + 0.1 * ~part * (W * S)[part].sum() / (W * S)[~part].sum())
        G = np.einsum("hw,mnchw,knchw->mk", scale, D, D)
        b = sigma**2 * np.einsum("hw,nchw,mnchw->m", scale, push, change)
        best = minimize(
            lambda x, G=G, b=b: 0.5 * x @ G @ x + b @ x, np.full(3, 0.2), method="SLSQP", tol=1e-14,
            bounds=[(0, 1)] * 3, constraints={"type": "ineq", "fun": lambda x: 1 - x.sum()},
        ).x  # fmt: skip
        found += part * np.einsum("m,mhw->hw", best, D[:, 0, 0])
    truth = reference + torch.from_numpy(idctn(found, norm="ortho"))
    blend = blend_by_waves(heights, changes, reference, moved, level)
    assert (blend - reference).norm() > 0.05 * reference.norm()
    torch.testing.assert_close(blend, truth, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("left, followed", [(0.1, 1.0), (0.8, 0.0)])
def test_fine_waves_return_to_least_squares_where_little_was_found(left, followed):
    """A candidate that leaves a tenth of the noise in every mode, or most of it."""
    gradient = 0.7 * torch.randn(1, 2, 64, 48, generator=seeded(3), dtype=torch.float64)
    n, sigma = signs(gradient), torch.tensor([0.7], dtype=torch.float64)
    plain, moved = LeastSquares()(gradient), LeastSquares()(n)
    found = blend_by_waves(left * plain[None], left * moved[None], plain, moved, sigma)
    frequency = torch.hypot(torch.arange(64).double()[:, None] / 128, torch.arange(48).double() / 96)
    taken = 1 - dct2(found) / dct2(plain)
    slow = (frequency > 0) & (frequency < 1 / 16)
    torch.testing.assert_close(taken[..., slow], torch.full_like(taken[..., slow], 1 - left))
    fine = taken[..., frequency >= 1 / 16]
    torch.testing.assert_close(fine, torch.full_like(fine, followed * (1 - left)), atol=1e-6, rtol=1e-6)


def test_signs_are_balanced_and_uncorrelated():
    n = signs(torch.empty(1, 2, 64, 96, dtype=torch.float64))
    assert n.unique().tolist() == [-1, 1]
    count = n.numel() ** 0.5
    for lag in (0, 1, 2, 96, 97, 64 * 96):
        product = n.flatten().mean() if lag == 0 else (n.flatten() * n.flatten().roll(lag)).mean()
        assert abs(float(product)) < 3.5 / count


def test_slow_waves_against_brute_force_and_beyond_their_band():
    """Monomials by Gram and Schmidt in the white modes; Stein's divergence as the trace of a Jacobian."""
    h, w, sigma = 40, 56, 0.7
    y, x = (torch.arange(n).double() / n - 0.3 for n in (h, w))
    gradient = 0.5 * random_field(1, 2, h, w, seed=3) + torch.stack(torch.broadcast_tensors(2 * x, y[:, None]))
    plain, other = LeastSquares()(gradient), random_field(1, 1, h, w, seed=4)
    level = torch.tensor([sigma], dtype=torch.float64)
    before, after = dct2(other)[0, 0], dct2(shrink_slow_waves(other, plain, level, period=20.0))[0, 0]
    frequency = torch.hypot(torch.arange(h).double()[:, None] / (2 * h), torch.arange(w).double() / (2 * w))
    slow = (frequency > 0) & (frequency < 1 / 20)
    scale = sigma * height_noise((h, w), plain)[slow].sqrt()
    white, held = dct2(plain)[0, 0][slow] / scale, before[slow] / scale
    assert len(white) == 20  # half as many hold the polynomials up to degree 2
    monomials = [y[:, None] ** i * x ** (d - i) for d in (1, 2) for i in range(d + 1)]
    found = [torch.linalg.qr(torch.stack([dct2(m)[slow] / scale for m in monomials], 1))[0]]
    nothing = torch.zeros(len(white), 0, dtype=torch.float64)

    def shrunk(U, threshold, c, z):
        """z with the factors of c."""
        rest, variance = c - U @ (U.mT @ c), 1 - U.square().sum(1)
        f = (1 - threshold**2 / (U.mT @ c).square()).clamp(min=0)
        g = (1 - threshold**2 * variance / rest.square()).clamp(min=0)
        left = g * (z - U @ (U.mT @ z))
        return U @ (f * (U.mT @ z)) + left - U @ (U.mT @ left)

    risks, results = [], []
    for U in (nothing, *found, *found):  # degrees 4 and 8 have become 2
        for threshold in (0, 0.5, 1, 1.5, 2, 2.5):
            slopes = torch.autograd.functional.jacobian(lambda c, U=U, t=threshold: shrunk(U, t, c, c), white)
            change = shrunk(U, threshold, white, white) - white
            risks.append(change.square().sum() + 2 * slopes.trace() - len(white))
            results.append(shrunk(U, threshold, white, held))
    share = torch.softmax(-torch.stack(risks) / 8, 0)
    assert share[:6].sum() < 0.9  # the polynomials count
    torch.testing.assert_close(after[slow], scale * (share @ torch.stack(results)))
    torch.testing.assert_close(after[~slow], before[~slow])


def test_slow_waves_without_noise_or_without_modes_stay():
    height, plain = random_field(2, 1, 40, 40, seed=1), random_field(2, 1, 40, 40, seed=2)
    kept = shrink_slow_waves(height, plain, torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(kept, height)
    for shape in ((1, 1), (1, 3), (5, 5), (1, 90), (90, 2)):
        height, plain = random_field(1, 1, *shape, seed=1), random_field(1, 1, *shape, seed=2)
        found = shrink_slow_waves(height, plain, 0.1 * torch.ones(1, dtype=torch.float64))
        assert found.isfinite().all()
        if max(shape) < 9:  # no wave of period 16 fits
            torch.testing.assert_close(found, height)


def test_caution_keeps_least_squares_of_texture_and_the_rest_of_noise():
    noise = LeastSquares()(random_field(1, 2, 48, 48, seed=1))
    sigma, flat = torch.ones(1, dtype=torch.float64), torch.zeros_like(noise)
    torch.testing.assert_close(cautious(flat, noise, flat, sigma), flat)  # all noise was found
    torch.testing.assert_close(cautious(flat, noise, 0.9 * noise, sigma), noise)  # a hundredth of its energy
    torch.testing.assert_close(cautious(flat, noise, flat, 0 * sigma), noise)


# The whole


@pytest.mark.slow
@pytest.mark.parametrize("recipe, least", [("blend", (1.3, 1.9)), ("quick", (1.15, 1.4))])
def test_gain_over_least_squares(recipe, least):
    gains = []
    for name in ("tent", "peaks", "ridge"):
        surface = SURFACES[name](64)
        gradient = torch.cat([add_noise(surface.gradient, 5, seeded(k)) for k in (0, 1)])
        truth = surface.height.expand(2, -1, -1, -1)
        plain, found = LeastSquares()(gradient), SlopeDLS(recipe=recipe)(gradient)
        errors = [(rmse(z, truth).mean(), (1 - ssim(z, truth, surface.data_range)).mean()) for z in (plain, found)]
        gains.append(torch.tensor([a / b for a, b in zip(*errors, strict=True)]).log())
    rms, similarity = torch.stack(gains).mean(0).exp().tolist()
    assert rms > least[0]
    assert similarity > least[1]


def test_terrain_is_left_to_least_squares():
    surface = terrain(64)
    gradient = add_noise(surface.gradient, 20, seeded(3))
    plain, found = LeastSquares()(gradient), SlopeDLS()(gradient)
    assert rmse(found, surface.height) < 1.005 * rmse(plain, surface.height)


def test_a_batch_of_whole_and_holed_surfaces():
    gradient = add_noise(SURFACES["tent"](32, dtype=torch.float64).gradient, 5, seeded(1)).expand(2, -1, -1, -1)
    mask = torch.cat([torch.ones(1, 1, 32, 32, dtype=torch.bool), DISK(32, 32)])
    result = SlopeDLS(n_iter=4, z_tol=1e-10).solve(gradient, mask)
    torch.testing.assert_close(result.height[:1], SlopeDLS(n_iter=4, z_tol=1e-10)(gradient[:1]))
    holed = SlopeDLS(n_iter=4, z_tol=1e-10).solve(gradient[1:], mask[1:])
    torch.testing.assert_close(result.height[1:], holed.height, atol=1e-7, rtol=0)
    assert result.misfit.shape == (2, 5)
    assert SlopeDLS.fast().solve(gradient, mask).misfit.shape == (2, 7)


# Holes, weights, anchors


def test_patches_know_what_lies_in_them():
    places = Places((20, 31), 8, 3)
    valid = (random_field(1, 2, 20, 31) > 0).double()
    trust = random_field(1, 2, 20, 31, seed=1).exp()
    known = Known(valid, trust)
    weight, level = known.weight(places), known.level(places)
    rows, columns = (line.positions for line in places.lines)
    for j, top in enumerate(rows):
        for i, left in enumerate(columns):
            part = (..., slice(top, top + 8), slice(left, left + 8))
            torch.testing.assert_close(weight[..., j, i], valid[part].mean((-2, -1)).square())
            mean = (valid * trust)[part].sum((-2, -1)) / valid[part].sum((-2, -1))
            torch.testing.assert_close(level[..., j, i], mean.rsqrt())
    assert (Known(0 * valid, trust).level(places) == 1).all()


def test_far_noise_is_that_of_the_middle_of_a_large_image():
    for size, with_polynomials in ((8, False), (16, True)):
        places, like = Places((160, 160), size, 0, with_polynomials), torch.empty(0, dtype=torch.float64)
        middle = len(places.lines[0].positions) // 2
        exact = places.noise(like, STEPS)[:, :, :, middle, middle]
        torch.testing.assert_close(places.far_noise(like, STEPS)[:, :, :, 0, 0], exact, rtol=0.03, atol=0.05)


def test_without_threshold_patches_of_holed_surfaces_code_everything():
    slopes, valid = random_field(2, 2, 23, 31), torch.zeros(1, 2, 23, 31, dtype=torch.float64)
    valid[..., 12:] = 1
    coded = HOLED[0].code(slopes, torch.zeros(2, dtype=torch.float64), STEPS, 3, Known(valid, None))
    torch.testing.assert_close(coded, slopes)  # measured, seen by a patch that knows, or left as they were


@pytest.mark.parametrize("size, offset", [(8, 0), (8, 3), (17, 5), (64, 20)])
def test_patches_of_a_window_are_those_of_the_whole(size, offset):
    """Those that know nothing weigh nothing, so that a window around the others gives the same."""
    slopes, valid = random_field(2, 2, 70, 160), torch.zeros(1, 2, 70, 160, dtype=torch.float64)
    valid[..., 12:30, 60:131] = 1
    places, known = Places((70, 160), size, offset), Known(valid, None)
    noise = torch.full((2, 1, 1, 1), 0.8, dtype=torch.float64)
    found = HOLED[0]._code(places, slopes, noise, STEPS, known)
    far = PatchNoise(places, STEPS, where="far")
    whole = HOLED[0]._code_patches(places, slopes, noise, far, known.weight(places))
    torch.testing.assert_close(found.total, whole.total)
    torch.testing.assert_close(found.weight, whole.weight)
    assert (found.weight == 0).any() or size == 64


@pytest.mark.parametrize("recipe", ["blend", "quick"])
def test_without_noise_holed_surfaces_are_least_squares(recipe):
    surface = SURFACES["peaks"](32, dtype=torch.float64)
    mask, method = DISK(32, 32), SlopeDLS(recipe=recipe, sigma=0.0)
    plain = LeastSquares()(surface.gradient, mask)
    torch.testing.assert_close(method(surface.gradient, mask), plain, atol=1e-4 * float(plain.abs().max()), rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("recipe, least", [("blend", 1.1), ("quick", 1.05)])
def test_gain_over_least_squares_on_a_disk(recipe, least):
    gains = []
    for name in ("tent", "cone", "terrain"):
        surface = terrain(64) if name == "terrain" else SURFACES[name](64)
        gradient = torch.cat([add_noise(surface.gradient, 5, seeded(k)) for k in (10, 11)])
        mask = DISK(64, 64)
        truth = surface.height.expand(2, -1, -1, -1)
        plain, found = LeastSquares()(gradient, mask), SlopeDLS(recipe=recipe)(gradient, mask)
        gains.append(rmse(plain, truth, mask).mean() / rmse(found, truth, mask).mean())
    assert min(gains) > 0.99
    assert torch.stack(gains).log().mean().exp() > least


def test_blend_by_a_probe_of_unequal_noise_takes_the_smooth_height():
    """Half of the surface is four times as noisy; a plane under it is found better than by least squares."""
    sigma = torch.full((1, 1, 40, 40), 0.1, dtype=torch.float64)
    sigma[..., 20:] = 0.4
    errors = []
    for seed in range(3):
        gradient = 0.3 + sigma * random_field(1, 2, 40, 40, seed=seed)
        weight = 1 / sigma.square()
        truth = LeastSquares()(torch.full_like(gradient, 0.3))
        errors.append([rmse(m(gradient, weight=weight), truth) for m in (LeastSquares(), SlopeDLS())])
    plain, found = torch.tensor(errors).mean(0)
    assert found < 0.8 * plain


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1)])
def test_a_single_row_is_integrated_as_it_is(shape):
    gradient = random_field(2, 2, *shape)
    torch.testing.assert_close(SlopeDLS()(gradient), LeastSquares()(gradient))


@pytest.mark.parametrize("boundary", ["neumann", "periodic"])
def test_derivative_of_the_blend_is_that_of_its_parts(boundary):
    """By finite differences of the same blend with its weights held: scaling data and noise scales the surface."""
    gradient = add_noise(SURFACES["tent"](24, dtype=torch.float64).gradient, 5, seeded(1))
    sigma = torch.tensor([0.2], dtype=torch.float64)
    runs = [Run(n_iter=2), Run(sizes=(4, 8), weights="equal", n_iter=2)]
    grid = Grid((1.0, 1.0), boundary)
    _, slope = torch.autograd.functional.jvp(lambda g: smooth(runs, g, sigma, grid), gradient, gradient)
    step = 1e-6
    ends = [smooth(runs, gradient * (1 + s), sigma * (1 + s), grid) for s in (step, -step)]
    _, of_noise = torch.autograd.functional.jvp(lambda s: smooth(runs, gradient, s, grid), sigma, sigma)
    torch.testing.assert_close(slope + of_noise, (ends[0] - ends[1]) / (2 * step), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("mapped", [False, True])
def test_blend_under_function_transforms(mapped):
    draws = [add_noise(SURFACES["tent"](20, dtype=torch.float64).gradient[0], snr, seeded(snr)) for snr in (1, 30)]
    gradient, method = torch.stack(draws), SlopeDLS(n_iter=2, z_tol=1e-12)
    mask = None
    if mapped:
        mask = torch.ones(2, 1, 20, 20, dtype=torch.bool)
        mask[1, :, 3:6, 3:6] = False
    expected = method(gradient, mask)
    found = torch.vmap(method)(gradient) if mask is None else torch.vmap(method)(gradient, mask)
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=0)
    g = gradient.clone().requires_grad_()
    method(g).square().sum().backward()
    each = torch.vmap(torch.func.grad(lambda x: method(x).square().sum()))(gradient)
    torch.testing.assert_close(each, g.grad, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("reach", [0, 2, 100])
def test_the_fill_goes_as_far_as_patches_see(reach):
    held = torch.zeros(3, 1, 9, 12, dtype=torch.bool)
    held[0, 0, 3, 4] = held[0, 0, 5, 6] = held[1, 0, 8, 0] = True
    expected = torch.zeros(3, 9, 12, dtype=torch.bool)
    expected[0, max(0, 3 - reach) : 5 + reach + 1, max(0, 4 - reach) : 6 + reach + 1] = True
    expected[1, max(0, 8 - reach) :, : reach + 1] = True  # each surface has its own window, the last one none
    assert torch.equal(_around(held, reach)[:2, 0], expected[:2])
