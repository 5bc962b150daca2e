"""Photometric stereo on rendered images: exact where the model is exact, robust where the method claims to be."""

import inspect

import numpy as np
import pytest
import torch

import torchdls
from tests.helpers import assert_gradients, assert_unchanged, random_field, seeded
from torchdls import (
    PHOTOMETRIC,
    SURFACES,
    cast_shadows,
    gradient_to_normals,
    low_rank_normals,
    render,
    ring_of_lights,
    sparse_normals,
    woodham,
)
from torchdls.photometric.low_rank import robust_pca, shrink_singular_values

METHODS = [PHOTOMETRIC.find(name) for name in PHOTOMETRIC]


def two_rings(dtype=torch.float64):
    return torch.cat([ring_of_lights(12, tilt, dtype=dtype) for tilt in (30.0, 60.0)])


def scene(n=40, name="gaussians", dtype=torch.float64, **options):
    """Normals, lights, images."""
    surface = SURFACES[name](n, dtype=dtype)
    normals, lights = gradient_to_normals(surface.gradient), two_rings(dtype)
    shadow = cast_shadows(surface.height, lights)
    return normals, lights, render(normals, lights, 0.8, shadow=shadow, **options)


def degrees(a, b):
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b, dim=1).norm(dim=1), (a * b).sum(1)))


# ---- rendering


def test_rendering_is_lambert_and_blinn_pixel_by_pixel():
    surface, lights = SURFACES["cone"](9, dtype=torch.float64), 2 * ring_of_lights(4, 50.0, dtype=torch.float64)
    normals = gradient_to_normals(surface.gradient)
    images = render(normals, lights, 0.5, highlight=0.3, shininess=7)
    for k, light in enumerate(lights.numpy()):
        half = light / np.linalg.norm(light) + [0, 0, 1]
        half /= np.linalg.norm(half)
        for i, j in ((0, 0), (4, 2), (8, 5)):
            n = normals[0, :, i, j].numpy()
            expected = 0.5 * max(0, light @ n) + 0.3 * 2 * (max(0, half @ n) ** 7 if light @ n > 0 else 0)
            assert images[0, k, i, j].item() == pytest.approx(expected, abs=1e-12)


def test_a_wall_casts_a_shadow_of_its_length():
    height = torch.zeros(1, 1, 5, 30, dtype=torch.float64)
    height[..., 10] = 5
    right = torch.tensor([[1.0, 0.0, 0.5]], dtype=torch.float64)  # falls by 1/2 a pixel: 10 pixels of shadow
    dark = cast_shadows(height, right)[0, 0]
    assert dark.any(0).nonzero().flatten().tolist() == list(range(1, 10))  # at the 10th the ray just passes
    assert torch.equal(dark, dark[:1].expand_as(dark))
    assert torch.equal(cast_shadows(height.mT, torch.tensor([[0.0, -1.0, 0.5]])), dark.mT[None, None])  # y is up
    assert torch.equal(cast_shadows(2 * height, right, pixel_size=2), dark[None, None])
    assert not cast_shadows(height, torch.tensor([[0.0, 0.0, 1.0]])).any()


def test_noise_has_the_ratio_asked_for():
    normals, lights, images = scene()
    noisy = render(normals, lights, 0.8, snr_db=20, generator=seeded(1))
    clean = render(normals, lights, 0.8)
    assert (noisy - clean).norm().item() == pytest.approx(0.1 * clean.norm().item(), rel=0.02)
    assert torch.equal(noisy, render(normals, lights, 0.8, snr_db=20, generator=seeded(1)))
    assert (images == 0).any()


# ---- normals


@pytest.mark.parametrize("method, limit", [(woodham, 1e-6), (low_rank_normals, 0.05), (sparse_normals, 0.05)])
def test_matte_surface_with_shadows_is_found(method, limit):
    normals, lights, images = scene()
    found = method(images, lights)
    assert degrees(found.normals, normals).mean() < limit
    assert (found.albedo - 0.8).abs().mean() < 2e-3
    assert found.normals.norm(dim=1).allclose(torch.ones(1, 40, 40, dtype=torch.float64))


def test_woodham_equals_numpy_lstsq_on_the_lit_samples():
    _, lights, images = scene(12, snr_db=20, generator=seeded(0))
    found = woodham(images, lights, shadow=0.2)
    for i, j in ((0, 0), (3, 7), (11, 5)):
        samples = images[0, :, i, j].numpy()
        lit = samples > 0.2 * samples.max()
        b = np.linalg.lstsq(lights.numpy()[lit], samples[lit], rcond=None)[0]
        np.testing.assert_allclose((found.albedo * found.normals)[0, :, i, j], b, atol=1e-10)


@pytest.mark.parametrize(
    "method, factor", [(low_rank_normals, 8), (sparse_normals, 8), (lambda i, k: sparse_normals(i, k, prior="l1"), 4)]
)
def test_highlights_are_taken_for_outliers(method, factor):
    normals, lights, images = scene(48, highlight=0.6, shininess=100.0)
    plain = degrees(woodham(images, lights).normals, normals).mean()
    assert plain > 2  # degrees: highlights mislead least squares
    assert degrees(method(images, lights).normals, normals).mean() < plain / factor


def test_sparse_regression_survives_arbitrary_outliers():
    normals, lights, images = scene(20)
    spoilt = torch.rand(images.shape, generator=seeded(2)) < 0.15
    images = torch.where(spoilt, 3 * torch.rand(images.shape, generator=seeded(3), dtype=torch.float64), images)
    assert degrees(sparse_normals(images, lights).normals, normals).median() < 0.05
    assert degrees(woodham(images, lights).normals, normals).median() > 5


def test_covariance_is_that_of_the_normals_and_of_their_slopes():
    """Of 2000 draws of the noise, entry by entry, in units of the whole spread of a pixel."""
    surface, lights = SURFACES["peaks"](6, dtype=torch.float64), two_rings()[:12]
    normals = gradient_to_normals(surface.gradient).expand(2000, -1, -1, -1)
    images = render(normals, lights, 0.7, snr_db=40, generator=seeded(4))
    found = woodham(images, lights, shadow=None)
    slopes = torchdls.normals_to_gradient(found.normals).gradient
    noise = torchdls.slope_noise(found.normals, found.covariance)
    for given, errors in ((found.covariance, found.normals - normals), (noise.covariance, slopes - surface.gradient)):
        pairs = [(i, j) for i in range(errors.shape[1]) for j in range(i, errors.shape[1])]
        spread = torch.stack([(errors[:, i] * errors[:, j]).mean(0) for i, j in pairs])
        total = sum(spread[k] for k, (i, j) in enumerate(pairs) if i == j)
        assert ((given.mean(0) - spread) / total).abs().max() < 0.06
    inverse = 1 / noise.covariance[:, ::2]
    torch.testing.assert_close(noise.weight, inverse / inverse.mean((1, 2, 3), keepdim=True))
    assert (noise.weight[:, 0] / noise.weight[:, 1]).std(0).max() < 0.3


def test_confidence_is_the_inverse_variance_of_the_slopes():
    surface, lights = SURFACES["peaks"](24, dtype=torch.float64), two_rings()[:12]
    normals = gradient_to_normals(surface.gradient).expand(400, -1, -1, -1)
    images = render(normals, lights, 1.0, snr_db=45, generator=seeded(4))
    found = woodham(images, lights, shadow=None)
    slopes = torchdls.normals_to_gradient(found.normals).gradient
    inverse = 1 / (slopes - surface.gradient).square().mean((0, 1))
    confidence = found.confidence.mean((0, 1))
    ratio = (confidence / confidence.mean()) / (inverse / inverse.mean())
    assert 0.8 < ratio.quantile(0.02) < ratio.quantile(0.98) < 1.25
    assert torch.allclose(found.confidence.mean((1, 2, 3)), torch.ones(400, dtype=torch.float64))


def test_weights_help_the_integration():
    surface, lights = SURFACES["gaussians"](40, dtype=torch.float64), ring_of_lights(10, dtype=torch.float64)
    albedo = torch.full_like(surface.height, 0.9)
    albedo[..., 10:16, 5:30] = 0.03  # a dark stripe, where the noise is as bright as the surface
    normals = gradient_to_normals(surface.gradient)
    found = woodham(render(normals, lights, albedo, snr_db=30, generator=seeded(5)), lights)
    gradient, _, _ = torchdls.normals_to_gradient(found.normals)
    plain = torchdls.LeastSquares()(gradient)
    weighted = torchdls.LeastSquares()(gradient, weight=found.confidence)
    assert torchdls.rmse(weighted, surface.height) < 0.5 * torchdls.rmse(plain, surface.height)


@pytest.mark.parametrize("method", METHODS)
def test_batches_masks_and_unknown_pixels(method):
    _, lights, images = scene(16, snr_db=35, generator=seeded(6))
    images = torch.cat([images, 3 * images.flip(1)])
    each = torch.stack([lights, lights.flip(0)])
    mask = torch.rand(2, 1, 16, 16, generator=seeded(7)) < 0.7
    lit = torch.ones_like(images, dtype=torch.bool)
    lit[0, 2:, 3, 3] = False  # two lights are not enough
    spoilt = torch.where(mask & lit, images, torch.nan)
    with assert_unchanged(spoilt, each):
        found = method(spoilt, each, mask=mask, lit=lit)
    known = mask.clone()
    known[0, :, 3, 3] = False
    assert torch.equal(found.normals.norm(dim=1, keepdim=True) > 0.5, known)
    assert torch.equal(found.albedo > 0, known)
    assert (found.confidence[~known] == 0).all()
    assert torch.equal(found.normals, method(torch.where(mask & lit, images, 7), each, mask=mask, lit=lit).normals)
    for i in range(2):
        alone = method(spoilt[i], each[i], mask=mask[i], lit=lit[i])
        assert alone.normals.shape == (3, 16, 16)
        for one, whole in zip(alone, found, strict=True):
            torch.testing.assert_close(one, whole[i], atol=1e-9, rtol=1e-9)
    single = method(images[:1].float(), lights.float())
    assert single.normals.dtype == torch.float32
    assert (single.normals - method(images[:1], lights).normals).abs().mean() < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_black_images_and_constant_scale(method):
    _, lights, images = scene(12, snr_db=40, generator=seeded(8))
    black = method(torch.zeros_like(images), lights)
    assert all((t == 0).all() for t in black)
    scaled = method(5 * images, lights)
    torch.testing.assert_close(scaled.normals, method(images, lights).normals, atol=1e-8, rtol=1e-6)


def test_sparse_normals_find_the_noise():
    """Under noise they are nearly as good as least squares; in a clean scene they take as little for it as they can."""
    normals, lights, images = scene(20, snr_db=20, generator=seeded(4))
    found, least, plain = (
        degrees(m(images, lights).normals, normals).mean()
        for m in (sparse_normals, lambda i, k: sparse_normals(i, k, noise=0.01), woodham)
    )
    assert found < 1.15 * plain < 0.85 * least
    _, _, clean = scene(20)
    torch.testing.assert_close(sparse_normals(clean, lights)[0], sparse_normals(clean, lights, noise=0.01)[0])
    both = torch.cat([images, 9 * clean])  # each surface by its own noise
    torch.testing.assert_close(sparse_normals(both, lights)[0][:1], sparse_normals(images, lights)[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["terrain", "peaks"])
def test_from_ten_noisy_images_no_default_loses_to_least_squares(name):
    """The paper's third experiment, small, means of four draws; on texture it remains."""
    surface, factor = (torchdls.terrain(64), 3.0) if name == "terrain" else (SURFACES[name](64), 1.0)
    lights, truth = ring_of_lights(10), surface.height * factor
    clean = gradient_to_normals(surface.gradient * factor).expand(4, -1, -1, -1)
    images = render(clean, lights, snr_db=17, generator=seeded(8))
    slopes = torchdls.normals_to_gradient(woodham(images, lights, shadow=None).normals).gradient

    def errors(method):
        z = method(slopes)
        h = truth.expand_as(z)
        values = torchdls.rmse(z, h), torchdls.mean_angular_error(z, h)
        return torch.stack([*values, 1 - torchdls.ssim(z, h, surface.data_range * factor)]).mean(1)

    plain = errors(torchdls.LeastSquares())
    for method in (torchdls.DLS(), torchdls.SlopeDLS(), torchdls.SlopeDLS.fast()):
        assert (errors(method) <= 1.001 * plain).all(), method
    if name == "terrain":  # the iteration without its guard does lose there
        assert errors(torchdls.DLS(select=False))[1] > 1.1 * plain[1]


# ---- parts and derivatives


def test_robust_pca_recovers_a_planted_matrix():
    left, right = random_field(80, 3, seed=1), random_field(3, 120, seed=2)
    error = 8 * random_field(80, 120, seed=3) * (torch.rand(80, 120, generator=seeded(4)) < 0.05)
    data = (left @ right + error)[None]
    known = torch.rand(1, 80, 120, generator=seeded(5)) < 0.9
    lam = torch.tensor([120.0], dtype=torch.float64).rsqrt()
    found = robust_pca(torch.where(known, data, 1e3), known, lam, 2000, 1e-7)
    assert (found[0] - left @ right).norm() < 1e-4 * (left @ right).norm()


def test_singular_values_are_shrunk():
    x, level = random_field(2, 4, 9), torch.tensor([0.5, 2.0], dtype=torch.float64)[:, None, None]
    u, s, v = torch.linalg.svd(x, full_matrices=False)
    torch.testing.assert_close(shrink_singular_values(x, level), u @ torch.diag_embed((s - level[..., 0]).clamp(0)) @ v)
    assert_gradients(lambda t: shrink_singular_values(t, level), x, forward=True)
    same = torch.eye(3, 5, dtype=torch.float64)[None].requires_grad_()  # equal singular values
    shrink_singular_values(same, level[:1]).square().sum().backward()
    assert same.grad is not None
    assert same.grad.isfinite().all()


@pytest.mark.parametrize(
    "method",
    [
        woodham,
        lambda i, k: sparse_normals(i, k, noise=0.01, n_iter=4),
        lambda i, k: sparse_normals(i, k, prior="l1", noise=0.01, n_iter=4),
    ],
)
def test_derivatives(method):
    _, lights, images = scene(12, highlight=0.4, snr_db=30, generator=seeded(9))
    images, lights = images[:, ::5, 3:4, ::11], lights[::5]
    assert_gradients(lambda i, k: torch.cat(method(i, k), 1), images, lights, forward=True)


def test_derivative_of_robust_pca_tends_to_that_of_its_solution():
    data = (random_field(6, 3, seed=1) @ random_field(3, 12, seed=2) + 0.05 * random_field(6, 12, seed=3))[None]
    known, lam = torch.ones_like(data, dtype=torch.bool), torch.tensor([0.3], dtype=torch.float64)
    change, weights = random_field(1, 6, 12, seed=4), random_field(1, 6, 12, seed=5)

    def cost(x):
        return (weights * robust_pca(x, known, lam, 300, 1e-12)).sum()

    x = data.clone().requires_grad_()
    (slope,) = torch.autograd.grad(cost(x), x)
    value = (slope * change).sum()
    finite = (cost(data + 1e-5 * change) - cost(data - 1e-5 * change)) / 2e-5
    assert value.item() == pytest.approx(finite.item(), rel=2e-2)


@pytest.mark.parametrize("method", METHODS)
def test_wrong_arguments_are_named(method):
    _, lights, images = scene(8)
    with pytest.raises(ValueError, match=r"images \(1, 2, 8, 8\) given"):
        method(images[:, :2], lights[:2])
    with pytest.raises(ValueError, match=r"lights \(23, 3\) given, \(24, 3\) or \(1, 24, 3\) is needed"):
        method(images, lights[:-1])
    with pytest.raises(TypeError, match=r"images has dtype torch.float16"):
        method(images.half(), lights)
    with pytest.raises(TypeError, match=r"mask has dtype torch.float64, torch.bool is needed"):
        method(images, lights, mask=images[:, :1])
    with pytest.raises(ValueError, match="NaN"):
        method(images / 0, lights)
    if "shadow" in inspect.signature(method).parameters:
        with pytest.raises(ValueError, match="shadow=1"):
            method(images, lights, shadow=1)


def test_wrong_options_are_named():
    normals, lights, images = scene(8)
    for call, message in (
        (lambda: sparse_normals(images, lights, prior="l0"), "prior='l0'"),
        (lambda: sparse_normals(images, lights, noise=0), "noise=0"),
        (lambda: low_rank_normals(images, lights, sparsity=0), "sparsity=0"),
        (lambda: render(normals, lights, highlight=-1), "highlight=-1"),
        (lambda: render(normals[:, :2], lights), "normals"),
        (lambda: cast_shadows(normals, lights), "height"),
        (lambda: cast_shadows(normals[:, :1], -lights), "horizon"),
        (lambda: ring_of_lights(2), "count=2"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
