"""SlopeDLS: what it promises on surfaces, and its parts against closed forms and simulated noise."""

from typing import Any

import pytest
import torch

from tests.helpers import DISK, assert_unchanged, random_field, seeded
from torchdls import SURFACES, LeastSquares, SlopeDLS, SlopeDLSResult, add_noise, rmse, ssim
from torchdls.integrators.slope_dls.coding import SlopeScale
from torchdls.integrators.slope_dls.outliers import replace_outliers
from torchdls.noise import cosine_noise, height_noise, slope_covariance
from torchdls.operators import GradientOperator, dct2
from torchdls.selection import discrepancy_guard

QUICK: dict[str, Any] = {"recipe": "plain", "tau": 1.2, "n_iter": 6}  # one threshold, fewer iterations
PLAIN: dict[str, Any] = {"recipe": "plain"}
RECIPES = pytest.mark.parametrize("recipe", ["blend", "quick", "plain"])


def noisy(name="tent", n=64, snr=10, seed=0, dtype=torch.float64):
    surface = SURFACES[name](n, dtype=dtype)
    return surface, add_noise(surface.gradient, snr, seeded(seed))


def gain(surface, gradient, method, mask=None):
    """RMSE of least squares over that of the method."""
    truth = surface.height.expand(len(gradient), -1, -1, -1)
    errors = [rmse(m(gradient, mask), truth, mask) for m in (LeastSquares(), method)]
    return (errors[0] / errors[1]).log().mean().exp()


@pytest.mark.parametrize("snr, least_rmse, least_ssim", [(1, 1.2, 1.5), (10, 1.05, 1.2)])
def test_better_than_least_squares(snr, least_rmse, least_ssim):
    for name in ("tent", "sphere"):
        surface, _ = noisy(name, 80, dtype=torch.float32)
        gradient = torch.cat([add_noise(surface.gradient, snr, seeded(k)) for k in (0, 1)])
        height, plain = SlopeDLS(**QUICK)(gradient), LeastSquares()(gradient)
        truth = surface.height.expand_as(height)
        assert (rmse(plain, truth) / rmse(height, truth)).mean() > (least_rmse if name != "sphere" else 1.0)
        lost = [(1 - ssim(z, truth, surface.data_range)).mean() for z in (plain, height)]
        assert lost[0] / lost[1] > least_ssim


def test_fast_variant_and_texture():
    surface, gradient = noisy("ridge", 96, dtype=torch.float32)
    assert gain(surface, gradient, SlopeDLS.fast()) > 1.1
    assert SlopeDLS.fast(tau=2.0).tau == 2.0
    surface, gradient = noisy("fractal", 96, 1, dtype=torch.float32)  # nothing to be gained: no harm
    assert gain(surface, gradient, SlopeDLS(**QUICK)) > 1 / 1.03


@pytest.mark.parametrize("shape", [(2, 2), (5, 9), (31, 50), (64, 3)])
@pytest.mark.parametrize("options", [PLAIN, PLAIN | {"learn": False}, {}, {"recipe": "quick"}])
def test_any_size(shape, options):
    gradient = random_field(2, 2, *shape)
    height = SlopeDLS(n_iter=3, **options)(gradient)
    assert height.shape == (2, 1, *shape)
    assert height.isfinite().all()
    assert height.mean((1, 2, 3)).abs().max() < 1e-9


@RECIPES
def test_plane_is_exact_and_scale_is_followed(recipe):
    method = SlopeDLS(n_iter=4, recipe=recipe)
    plane = torch.tensor([0.3, -0.2], dtype=torch.float64)[None, :, None, None].expand(1, 2, 40, 30)
    torch.testing.assert_close(method(plane), LeastSquares()(plane), atol=1e-9, rtol=0)
    _, gradient = noisy(n=32)
    height = method(gradient)
    torch.testing.assert_close(method(1e-3 * gradient), 1e-3 * height)
    torch.testing.assert_close(SlopeDLS(n_iter=4, recipe=recipe, pixel_size=2.5)(gradient), 2.5 * height)


@RECIPES
def test_zero_threshold_and_zero_iterations_are_least_squares(recipe):
    _, gradient = noisy(n=40)
    plain = LeastSquares()(gradient)
    torch.testing.assert_close(SlopeDLS(n_iter=0, recipe=recipe)(gradient), plain)
    kept = SlopeDLS(tau=0.0, learn=False, n_iter=2, recipe=recipe)(gradient)
    torch.testing.assert_close(kept, plain, atol=1e-8, rtol=0)


def test_result_and_callback():
    _, gradient = noisy(n=32)
    seen: list[Any] = []
    for recipe in ("blend", "quick", "plain"):
        seen.clear()
        method = SlopeDLS(n_iter=3, recipe=recipe)
        result = method.solve(gradient[0], callback=lambda k, m: seen.append((k, float(m))))
        assert isinstance(result, SlopeDLSResult)
        torch.testing.assert_close(result.height[0], method(gradient[0]))
        assert result.misfit.shape == (1, 4)
        assert seen == [(k, float(result.misfit[0, k])) for k in (1, 2, 3)]
    assert result.dictionary.shape == (1, 128, 128)
    torch.testing.assert_close(result.dictionary.norm(dim=1), torch.ones(1, 128, dtype=torch.float64))
    assert result.codes.shape[:2] == (1, 128)
    assert (result.confidence == 1).all()
    assert SlopeDLS(learn=False, n_iter=1).solve(gradient).dictionary is None


@pytest.mark.parametrize(
    "options",
    [{}, {"recipe": "plain"}, PLAIN | {"learn": False}, PLAIN | {"guard": "sure"}, {"recipe": "quick", "robust": True}],
)
def test_batch_equals_single_and_calls_repeat(options):
    gradient = torch.cat([noisy(n=32, seed=k, snr=s)[1] for k, s in ((0, 1), (1, 20))])
    mask = torch.cat([torch.ones(1, 1, 32, 32, dtype=torch.bool), DISK(32, 32)])
    method = SlopeDLS(n_iter=2, z_tol=1e-10, **options)
    for m in (None, mask):
        with assert_unchanged(gradient, m):
            together = method(gradient, m)
        assert torch.equal(together, method(gradient, m))
        for i in (0, 1):
            single = method(gradient[i], None if m is None else m[i])
            torch.testing.assert_close(together[i], single, atol=1e-7, rtol=0)


def test_float32_follows_float64():
    surface, gradient = noisy(n=64)
    span = surface.height.max() - surface.height.min()
    difference = SlopeDLS()(gradient.float()).double() - SlopeDLS()(gradient)
    assert difference.square().mean().sqrt() < 1e-3 * span


# Masks, weights, anchors


def test_full_mask_and_equal_weights_change_nothing():
    _, gradient = noisy(n=40)
    mask, weight = torch.ones(1, 1, 40, 40, dtype=torch.bool), torch.full((1, 1, 40, 40), 4.0, dtype=torch.float64)
    method = SlopeDLS(n_iter=4, z_tol=1e-12)
    torch.testing.assert_close(method(gradient, mask), method(gradient))
    torch.testing.assert_close(method(gradient, weight=weight), method(gradient))
    torch.testing.assert_close(method.solve(gradient, weight=weight).noise, 2 * method.solve(gradient).noise)


def test_mask_with_nan_outside_gains_too():
    surface, gradient = noisy("tent", 96, 5, dtype=torch.float32)
    mask = DISK(96, 96)
    mask[..., 30:45, 50:60] = False
    height = SlopeDLS(**QUICK)(torch.where(mask, gradient, torch.nan), mask)
    assert (height[~mask] == 0).all()
    assert gain(surface, torch.where(mask, gradient, torch.nan), SlopeDLS(**QUICK), mask) > 1.05


def test_weights_and_noise_map_tell_where_the_noise_is():
    surface = SURFACES["tent"](80, dtype=torch.float64)
    sigma = torch.full((1, 1, 80, 80), 0.1, dtype=torch.float64)
    sigma[..., 40:] = 1.0
    gradient = surface.gradient + sigma * random_field(1, 2, 80, 80, seed=3)
    weight = 1 / sigma.square()
    found = SlopeDLS(**QUICK).solve(gradient, weight=weight)
    assert abs(float(found.noise) - 1) < 0.1
    blind = rmse(LeastSquares()(gradient, weight=weight), surface.height)
    assert rmse(found.height, surface.height) < 0.9 * blind
    given = SlopeDLS(sigma=sigma, **QUICK)(gradient, weight=weight)
    assert rmse(given, surface.height) < 0.9 * blind


def test_anchor_is_held():
    surface, gradient = noisy(n=40)
    z = SlopeDLS(**QUICK)(gradient, anchor=surface.height + 7, anchor_weight=10.0)
    assert (z - surface.height - 7).abs().mean() < 0.1


# Outliers


@pytest.mark.parametrize("name, share", [("sphere", 0.05), ("tent", 0.03), ("gaussians", 0.05)])
def test_outliers_are_found_and_replaced(name, share):
    surface, gradient = noisy(name, 96, 20)
    wrong = torch.rand(1, 1, 96, 96, generator=seeded(5)) < share
    damaged = torch.where(wrong, gradient + 4 * random_field(1, 2, 96, 96, seed=6), gradient)
    clean = rmse(LeastSquares()(gradient), surface.height)
    fields = LeastSquares()._check_fields(damaged)
    repaired, flagged = replace_outliers(fields)
    assert (flagged & wrong).sum() > 0.85 * wrong.sum()
    assert (flagged & ~wrong).sum() < 0.02 * (~wrong).sum()
    assert rmse(LeastSquares()(repaired), surface.height) < 1.25 * clean
    result = SlopeDLS(robust=True, learn=False, **QUICK).solve(damaged)
    assert rmse(result.height, surface.height) < 1.1 * clean
    assert torch.equal(result.confidence == 0, flagged)


@pytest.mark.parametrize("name", ["pyramid", "cone", "tent"])
def test_creases_are_not_outliers(name):
    _, gradient = noisy(name, 96, 30)
    _, flagged = replace_outliers(LeastSquares()._check_fields(gradient))
    assert flagged.double().mean() < 0.02


@pytest.mark.parametrize("snr", [20, 40])
def test_steep_steps_are_not_outliers(snr):
    """Narrow cliffs bend more within a pixel than any noise; taken for wrong, they would bring the stairs down."""
    surface, gradient = noisy("steps", 96, snr)
    repaired, flagged = replace_outliers(LeastSquares()._check_fields(gradient))
    assert flagged.double().mean() < 0.01
    plain, kept = (rmse(LeastSquares()(g), surface.height) for g in (gradient, repaired))
    assert kept < 1.3 * plain
    wrong = torch.rand(1, 1, 96, 96, generator=seeded(5)) < 0.03
    damaged = torch.where(wrong, gradient + 4 * random_field(1, 2, 96, 96, seed=6), gradient)
    repaired, flagged = replace_outliers(LeastSquares()._check_fields(damaged))
    assert (flagged & wrong).sum() > 0.9 * wrong.sum()
    assert rmse(LeastSquares()(repaired), surface.height) < 0.3 * rmse(LeastSquares()(damaged), surface.height)


# Parts


def test_height_noise_is_exact():
    g = torch.eye(2 * 6 * 9, dtype=torch.float64).view(-1, 2, 6, 9)
    coefficients = dct2(LeastSquares(pixel_size=(1.0, 1.0))(g))
    torch.testing.assert_close(coefficients.square().sum(0)[0], height_noise((6, 9), g))


def test_projected_noise_has_the_predicted_levels():
    steps = (0.8, 1.25)
    noise = random_field(60, 2, 64, 64, seed=1)
    slopes = GradientOperator("forward", steps)(LeastSquares(pixel_size=steps)(noise))[..., 16:48, 16:48]
    scale = SlopeScale((8, 8), steps)
    P = scale.extract(slopes)
    spread = dct2(P.permute(0, 1, 3, 2).unflatten(-1, (8, 8))).square().mean((0, 2)).sqrt()
    predicted = cosine_noise((8, 8), slopes, steps)
    torch.testing.assert_close(spread, predicted, rtol=0.1, atol=0.02)
    stacked = P.flatten(1, 2)
    covariance = torch.einsum("nil,njl->ij", stacked, stacked) / (stacked.shape[0] * stacked.shape[2])
    torch.testing.assert_close(covariance, slope_covariance((8, 8), slopes, steps), rtol=0, atol=0.03)
    cosines = scale.initial_dictionary(slopes)[0]
    both = ((slope_covariance((8, 8), slopes, steps) @ cosines) * cosines).sum(0).sqrt()
    torch.testing.assert_close(both.view(2, 8, 8), predicted, rtol=1e-3, atol=1e-3)


def test_guard_returns_what_is_not_noise():
    _, gradient = noisy("ripples", 64, 20)
    plain, sigma = LeastSquares()(gradient), torch.tensor([1e-3], dtype=torch.float64)
    flat = torch.zeros_like(plain)  # everything was removed
    assert rmse(discrepancy_guard(flat, plain, sigma), plain) < 0.5 * rmse(flat, plain)
    torch.testing.assert_close(discrepancy_guard(plain, plain, sigma), plain)
    noise = LeastSquares()(random_field(1, 2, 64, 64))
    kept = discrepancy_guard(torch.zeros_like(noise), noise, torch.ones(1, dtype=torch.float64))
    assert rmse(kept, torch.zeros_like(noise)) < 0.2 * rmse(noise, torch.zeros_like(noise))


def test_stein_guard_does_no_harm():
    surface, gradient = noisy("ripples", 48, 5)
    over = {"recipe": "plain", "tau": 4.0, "n_iter": 6, "guard": None}  # smooths far too much
    bad, saved = SlopeDLS(**over), SlopeDLS(**(over | {"guard": "sure"}))
    assert gain(surface, gradient, saved) > 0.97
    assert gain(surface, gradient, saved) > gain(surface, gradient, bad)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"patch_sizes": ()}, "patch_sizes"),
        ({"patch_sizes": (1,)}, "patch_sizes"),
        ({"tau": -1.0}, "tau"),
        ({"n_iter": -1}, "n_iter"),
        ({"guard": "luck"}, "guard"),
        ({"aggregate": "median"}, "aggregate"),
        ({"recipe": "secret"}, "recipe"),
        ({"sigma": -1.0}, "sigma"),
        ({"sigma": torch.ones(3)}, "sigma"),
        ({"sigma": torch.ones(1, 1, 3, 3)}, "sigma"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        SlopeDLS(**options)(random_field(2, 2, 16, 16))
