import math

import pytest
import torch
from scipy.fft import dstn

from torchdls.noise import add_noise, averaging_error, noise_level, noise_sigma
from torchdls.noise.level import _CUT, _TRIMMED_VARIANCE
from torchdls.operators import GradientOperator, dct2, edge_slopes, idct2, neumann_eigenvalues
from torchdls.surfaces import SURFACES, terrain


def white(n, shape, seed=0, dtype=torch.float64):
    return torch.randn(n, 2, *shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def curl_by_hand(g, dx=1.0, dy=1.0):
    """(h - 1, w - 1) circulation around each cell, its four edges walked one by one."""
    p, q = g
    top, bottom = (p[:-1, :-1] + p[:-1, 1:]) / 2, (p[1:, :-1] + p[1:, 1:]) / 2
    left, right = (q[:-1, :-1] + q[1:, :-1]) / 2, (q[:-1, 1:] + q[1:, 1:]) / 2
    return dx * top + dy * right - dx * bottom - dy * left


# The formulas of the docstring


@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 2.0)])
def test_the_curl_of_white_noise_has_the_documented_covariance(pixel_size):
    """Exactly, from the matrix of the curl: variance dx^2 + dy^2, and independent sine modes of known variance."""
    h, w, (dx, dy) = 5, 7, pixel_size
    units = torch.eye(2 * h * w, dtype=torch.float64).view(-1, 2, h, w)
    matrix = torch.stack([curl_by_hand(u, dx, dy).flatten() for u in units], 1)
    covariance = matrix @ matrix.T
    torch.testing.assert_close(covariance.diagonal(), torch.full_like(covariance[0], dx**2 + dy**2))
    modes = torch.from_numpy(dstn(matrix.view(h - 1, w - 1, -1).numpy(), type=1, norm="ortho", axes=(0, 1)))
    modes = modes.reshape(-1, 2 * h * w)
    sy = torch.sin(torch.arange(1, h) * math.pi / (2 * h)).square().double()[:, None]
    sx = torch.sin(torch.arange(1, w) * math.pi / (2 * w)).square().double()
    expected = 4 * (dx**2 * sy * (1 - sx) + dy**2 * sx * (1 - sy))
    torch.testing.assert_close(modes @ modes.T, expected.flatten().diag(), atol=1e-6, rtol=1e-6)


def test_the_sine_modes_are_the_residual_of_least_squares():
    h, w = 9, 12
    v, _ = edge_slopes(white(1, (h, w)))
    eigenvalues = neumann_eigenvalues((h, w), like=v).clone()
    eigenvalues[0, 0] = 1
    forward = GradientOperator()
    residual = forward(idct2(dct2(forward.adjoint(v)) / eigenvalues)) - v
    curl = v[0, 0, :-1, :-1] - v[0, 0, 1:, :-1] + v[0, 1, :-1, 1:] - v[0, 1, :-1, :-1]
    modes = torch.from_numpy(dstn(curl.numpy(), type=1, norm="ortho"))
    torch.testing.assert_close((modes.square() / eigenvalues[1:, 1:]).sum(), residual.square().sum())


def test_trimmed_variance_is_that_of_a_cut_normal():
    x = torch.linspace(-_CUT, _CUT, 20_001, dtype=torch.float64)
    density = torch.exp(-x * x / 2)
    assert float((x * x * density).sum() / density.sum()) == pytest.approx(_TRIMMED_VARIANCE, rel=1e-3)


# Accuracy


@pytest.mark.parametrize("shape, spread", [((96, 96), 0.03), ((32, 48), 0.1), ((200, 130), 0.02)])
def test_white_noise(shape, spread):
    sigma = noise_level(3 * white(20, shape)) / 3
    assert (sigma - 1).abs().max() < spread
    assert abs(sigma.mean() - 1) < spread / 3


SMOOTH = ["peaks", "sphere", "gaussians", "saddle", "chirp", "ripples"]
CREASED = ["tent", "vase", "pyramid", "cone", "ridge", "plateau"]


@pytest.mark.parametrize("n", [96, 200])
@pytest.mark.parametrize("name", SMOOTH + CREASED)
def test_within_three_percent_of_the_truth_and_five_with_creases(name, n):
    gradient = SURFACES[name](n).gradient.expand(3, -1, -1, -1)
    for snr in (1, 10, 20, 30, 40):
        noisy = add_noise(gradient, snr, torch.Generator().manual_seed(snr))
        ratio = noise_level(noisy) / noise_sigma(gradient, snr)
        assert (ratio - 1).abs().max() < (0.03 if name in SMOOTH else 0.05), (snr, ratio)


@pytest.mark.parametrize("make", [SURFACES["steps"], SURFACES["fractal"], terrain])
def test_rough_surfaces_up_to_twenty_decibels(make):
    gradient = make(128).gradient
    for snr in (1, 10, 20):
        noisy = add_noise(gradient, snr, torch.Generator().manual_seed(snr))
        assert float(noise_level(noisy) / noise_sigma(gradient, snr)) == pytest.approx(1, abs=0.03)


def test_a_field_of_a_surface_without_noise():
    saddle = SURFACES["saddle"](50, dtype=torch.float64)
    assert noise_level(saddle.gradient) < 1e-14
    assert noise_level(torch.zeros(1, 2, 8, 9)) == 0


def test_outliers_do_not_count():
    g = white(1, (100, 100))
    g[:, :, 20, 30:60] += 100
    assert float(noise_level(g)) == pytest.approx(1, abs=0.03)


# Masks, weights, pixel size


def disk(h, w):
    y, x = torch.arange(h)[:, None] - h / 2, torch.arange(w) - w / 2
    r = (y * y + x * x).sqrt()
    return ((r < 0.48 * min(h, w)) & (r > 0.1 * min(h, w)))[None, None]


def test_cells_inside_a_mask():
    g, mask = white(4, (120, 130)), disk(120, 130)
    sigma = noise_level(torch.where(mask, g, torch.nan), mask)
    assert (sigma - 1).abs().max() < 0.04
    torch.testing.assert_close(noise_level(torch.where(mask, g, 1e6), mask), sigma)


def test_few_cells_by_hand():
    """An L of three complete cells: none is beyond the cut, so the estimate is their calibrated root mean square."""
    mask = torch.zeros(1, 1, 6, 6, dtype=torch.bool)
    mask[..., 1:4, 1:3] = True
    mask[..., 2:4, 3] = True
    g = white(1, (6, 6))
    curl = curl_by_hand(g[0])[[1, 2, 2], [1, 1, 2]]
    assert curl.abs().max() < _CUT * curl.abs().median() / 0.6745
    expected = (curl.square().mean() / 2 / _TRIMMED_VARIANCE).sqrt()
    torch.testing.assert_close(noise_level(g, mask)[0], expected)


def test_a_full_mask_and_equal_weights_change_nothing():
    g = white(3, (40, 50))
    full = torch.ones(3, 1, 40, 50, dtype=torch.bool)
    plain = noise_level(g)
    torch.testing.assert_close(noise_level(g, full), plain)
    torch.testing.assert_close(noise_level(g, weight=torch.ones(1, 2, 40, 50).double()), plain)
    torch.testing.assert_close(noise_level(g, full, torch.full((3, 1, 40, 50), 4.0).double()), 2 * plain)
    mixed = full.clone()
    mixed[1] = disk(40, 50)
    torch.testing.assert_close(noise_level(g, mixed)[[0, 2]], plain[[0, 2]])


def test_weights_are_inverse_variances():
    generator = torch.Generator().manual_seed(3)
    weight = torch.rand(2, 2, 150, 150, generator=generator, dtype=torch.float64) * 4
    weight[:, :, 10:20, 30:60] = 0
    g = 0.7 * white(2, (150, 150)) / weight.clamp_min(1e-9).sqrt()
    assert (noise_level(g, weight=weight) / 0.7 - 1).abs().max() < 0.03


def test_pixel_size():
    g = white(1, (90, 110))
    torch.testing.assert_close(noise_level(g, pixel_size=3.0), noise_level(g))
    for size in ((1.0, 3.0), (2.0, 0.5)):
        assert float(noise_level(g, pixel_size=size)) == pytest.approx(1, abs=0.03)
        assert float(noise_level(g, disk(90, 110), pixel_size=size)) == pytest.approx(1, abs=0.06)


def test_symmetries_and_scale():
    g = white(1, (40, 51))
    sigma = noise_level(g)
    torch.testing.assert_close(noise_level(-5 * g), 5 * sigma)
    torch.testing.assert_close(noise_level(g.flip(1).mT), sigma)
    mirrored = g.flip(3) * torch.tensor([-1.0, 1.0]).view(2, 1, 1)
    torch.testing.assert_close(noise_level(mirrored), sigma)


# Batches, precision, derivatives, errors


@pytest.mark.parametrize("masked", [False, True])
def test_batches_singles_and_precision(masked):
    g = white(3, (70, 40), dtype=torch.float32)
    mask = disk(70, 40) if masked else None
    kept = g.clone()
    together = noise_level(g, mask)
    assert together.shape == (3,)
    assert together.dtype == torch.float32
    for i in range(3):
        single = noise_level(g[i], None if mask is None else mask[0])
        assert single.shape == ()
        torch.testing.assert_close(single, together[i])
    torch.testing.assert_close(noise_level(g.double(), mask).float(), together)
    assert torch.equal(g, kept)
    with torch.device("meta"):
        torch.testing.assert_close(noise_level(g, mask), together)


@pytest.mark.parametrize("masked", [False, True])
def test_derivatives(masked):
    g, mask = white(1, (9, 11), seed=1).requires_grad_(), disk(9, 11) if masked else None
    assert torch.autograd.gradcheck(lambda t: noise_level(t, mask), g)
    flat = torch.zeros(1, 2, 9, 11).requires_grad_()
    (gradient,) = torch.autograd.grad(noise_level(flat, mask).sum(), flat)
    assert (gradient == 0).all()


@pytest.mark.parametrize("shape", [(2, 2), (2, 9), (3, 3)])
def test_tiny_fields(shape):
    sigma = noise_level(white(400, shape))
    assert sigma.isfinite().all()
    assert (sigma > 0).all()


def test_bad_input():
    g = white(2, (8, 9))
    mask = torch.ones(2, 1, 8, 9, dtype=torch.bool)
    with pytest.raises(TypeError, match="float16"):
        noise_level(g.half())
    with pytest.raises(ValueError, match=r"gradient \(2, 1, 8, 9\)"):
        noise_level(g[:, :1])
    with pytest.raises(ValueError, match=r"gradient \(2, 2, 8, 1\)"):
        noise_level(g[..., :1])
    with pytest.raises(ValueError, match=r"gradient \(2, 2, 8, 9\) and mask \(2, 1, 8, 8\)"):
        noise_level(g, mask[..., :8])
    with pytest.raises(TypeError, match=r"mask has dtype torch.float32"):
        noise_level(g, mask.float())
    with pytest.raises(ValueError, match=r"weight \(2, 3, 8, 9\)"):
        noise_level(g, weight=torch.ones(2, 3, 8, 9).to(g))
    with pytest.raises(ValueError, match="weight holds negative"):
        noise_level(g, weight=-mask.double())
    with pytest.raises(ValueError, match="gradient holds NaN"):
        noise_level(torch.where(mask, torch.nan, g))
    with pytest.raises(ValueError, match="inside the mask"):
        noise_level(torch.where(mask, torch.nan, g), mask)
    mask[1, :, ::2] = False
    with pytest.raises(ValueError, match="no complete cell"):
        noise_level(g, mask)
    with pytest.raises(ValueError, match="pixel_size"):
        noise_level(g, pixel_size=-1)


# What averaging errs by


def averaging_error_by_loops(g, t, sigma):
    """From the definition, along the rows of one component and then along the columns of the other."""
    total = noise = weight = 0.0
    for c in (0, 1):
        for slopes, trust in zip(g[c] if c == 0 else g[c].T, t[c] if c == 0 else t[c].T, strict=True):
            for i in range(len(slopes) - 3):
                if (trust[i : i + 4] > 0).all():
                    r = slopes[i] - 3 * slopes[i + 1] + 3 * slopes[i + 2] - slopes[i + 3]
                    u = 1 / trust[i] + 9 / trust[i + 1] + 9 / trust[i + 2] + 1 / trust[i + 3]
                    total, noise, weight = total + r * r / (u + 6e3), noise + u / (u + 6e3), weight + 1 / (u + 6e3)
    return (total / sigma**2 - noise) / weight / 48


@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 2.0)])
def test_averaging_error_follows_its_definition(pixel_size):
    relief = torch.randn(12, generator=torch.Generator().manual_seed(2)).double()  # the same in every row: without curl
    g = 0.3 * white(1, (9, 12))
    g[:, 0] += relief
    t = torch.rand(1, 2, 9, 12, generator=torch.Generator().manual_seed(1)).double()
    t[0, 0, 4, 5] = 0
    t = t / t[t > 0].mean()
    sigma = noise_level(g, weight=t, pixel_size=pixel_size)
    expected = averaging_error_by_loops(g[0], t[0], sigma)
    assert 0 < float(expected) < 1e4
    for scale in (1.0, 1e-20):
        found = averaging_error(g, None, scale * t, pixel_size)
        torch.testing.assert_close(found.flatten(), expected.view(1))
    torch.testing.assert_close(averaging_error(5 * g, None, t, pixel_size), found)


def test_averaging_error_finds_the_error_of_creases_under_noise():
    """Folds at random places between the pixels, each by 1: the error of the mean is known edge by edge."""
    generator = torch.Generator().manual_seed(4)
    place = 4 * torch.arange(30) + 2 + torch.rand(30, generator=generator).double()  # one fold in four edges
    x = torch.arange(124).double()

    def f(x):  # zigzag: slope 0 and 1 in turn
        sign = torch.tensor([1.0, -1.0]).double().repeat(15)
        return (sign * (x[..., None] - place).clamp(min=0)).sum(-1)

    slope = (f(x + 1e-6) - f(x - 1e-6)) / 2e-6
    true = ((slope[1:] + slope[:-1]) / 2 - (f(x[1:]) - f(x[:-1]))).square().mean() / 2  # none along y
    g = torch.stack([slope.expand(80, 124), torch.zeros(80, 124).double()])[None]
    sd = 0.1 * (0.5 + torch.rand(1, 1, 80, 124, generator=generator).double())
    noisy = g + sd * white(1, (80, 124))
    weight = sd.square().reciprocal()
    found = averaging_error(noisy, None, weight) / weight.mean()
    assert 0.5 * true < float(found) < 2 * true
    assert float(averaging_error(sd * white(1, (80, 124)), None, weight)) < 0.1


def test_averaging_error_of_what_cannot_tell():
    for shape in ((1, 9), (3, 3), (2, 3)):
        assert (averaging_error(white(1, shape), None, torch.ones(1, 1, *shape).double()) == 0).all()
    assert (averaging_error(white(1, (8, 8)), None, torch.zeros(1, 1, 8, 8).double()) == 0).all()
    saddle = SURFACES["saddle"](20).gradient
    assert averaging_error(saddle, None, torch.ones(1, 1, 20, 20)).isfinite().all()
