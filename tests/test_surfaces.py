import builtins
import math

import pytest
import torch

from torchdls.metrics import ssim
from torchdls.noise import add_noise, noise_sigma
from torchdls.operators import GradientOperator, dct2, edge_slopes, idct2, neumann_eigenvalues
from torchdls.surfaces import SURFACES, tent, terrain, vase

CREASED = {"tent", "vase", "pyramid", "cone", "ridge", "plateau"}
SMOOTH = sorted(set(SURFACES) - CREASED)


def least_squares(gradient):
    """Plain least squares by the cosine transform, on its own here: the surfaces must not depend on the solvers."""
    v, _ = edge_slopes(gradient)
    eigenvalues = neumann_eigenvalues(tuple(gradient.shape[-2:]), like=gradient).clone()
    eigenvalues[0, 0] = 1
    spectrum = dct2(GradientOperator().adjoint(v)) / eigenvalues
    spectrum[..., 0, 0] = 0
    return idct2(spectrum)


def one_sided_slopes(surface, n, step):
    """Differences of the formula itself over a step ahead, in float64."""
    c = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) / (n - 1)
    x, y = c.expand(n, n), c[:, None].expand(n, n)
    f = surface.formula
    return torch.stack([f(x + step, y) - f(x, y), f(x, y + step) - f(x, y)]) / step


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("n", [40, 43])
def test_slopes_are_the_derivatives_of_the_formula(name, n):
    slopes = SURFACES[name](n, dtype=torch.float64).gradient[0]
    ahead, behind = (one_sided_slopes(SURFACES[name], n, step) for step in (1e-6, -1e-6))
    crease = ((ahead - behind).abs() > 1e-2).any(0)  # a pixel on it has no derivative
    difference = (slopes - (ahead + behind) / 2).abs()
    assert difference[:, ~crease].max() < 1e-7
    assert crease.double().mean() <= (8 / n if name in CREASED else 0)


@pytest.mark.parametrize("name", SMOOTH)
def test_slopes_integrate_to_the_height(name):
    """Simpson's rule along rows and columns: orientation, sign and unit of the slopes, with public names only."""
    s = SURFACES[name](400, dtype=torch.float64)
    z, (p, q) = s.height[0, 0], s.gradient[0]
    along = (p[:, :-2] + 4 * p[:, 1:-1] + p[:, 2:]) / 3
    down = (q[:-2] + 4 * q[1:-1] + q[2:]) / 3
    torch.testing.assert_close(z[:, 2:] - z[:, :-2], along, atol=2e-3, rtol=0)
    torch.testing.assert_close(z[2:] - z[:-2], down, atol=2e-3, rtol=0)


def test_a_surface_rising_to_the_right_and_downward_has_positive_slopes():
    s = SURFACES["plateau"](20)
    torch.testing.assert_close(s.gradient[0, 0], torch.full((20, 20), 0.2))
    torch.testing.assert_close(s.gradient[0, 1], torch.full((20, 20), 0.1))
    assert s.height[0, 0, 0, -1] > s.height[0, 0, 0, 0]
    assert s.height[0, 0, -1, 0] > s.height[0, 0, 0, 0]


def test_tent_is_the_published_formula_in_pixels():
    x = (torch.arange(200, dtype=torch.float64) - 99.5).expand(200, 200)
    y = x.T
    side, front = 100 - x.abs(), (90 - y.abs()) * 100 / 36
    s = tent(200, dtype=torch.float64)
    torch.testing.assert_close(s.height[0, 0], torch.minimum(side, front).clamp_min(0))
    hip = (side - front).abs() < 1e-9
    assert hip.sum() == 16
    share = torch.where(hip, 0.5, (side < front).double())
    slopes_x = torch.where(side > 0, -x.sign() * share, 0)
    slopes_y = torch.where(front > 0, -y.sign() * 100 / 36 * (1 - share), 0)
    torch.testing.assert_close(s.gradient[0], torch.stack([slopes_x, slopes_y]))
    assert s.data_range == pytest.approx(5)


def test_vase_is_the_published_formula_in_pixels():
    h = 1 / 199
    y = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None]
    x = torch.linspace(-0.5, 0.5, 200, dtype=torch.float64)[None]
    f = 0.83 / 0.3 * (0.15 - 0.1 * y * (6 * y + 1) ** 2 * (y - 1) ** 2 * (3 * y - 2))
    slope = torch.autograd.functional.jvp(
        lambda t: 0.83 / 0.3 * (0.15 - 0.1 * t * (6 * t + 1) ** 2 * (t - 1) ** 2 * (3 * t - 2)), y, torch.ones_like(y)
    )[1]
    s, inside = vase(200, dtype=torch.float64), x.abs() < f
    torch.testing.assert_close(s.height[0, 0], f * (1 - (x / f) ** 2).clamp_min(0) / h)
    torch.testing.assert_close(s.gradient[0, 0], torch.where(inside, -2 * x / f, 0))
    torch.testing.assert_close(s.gradient[0, 1], torch.where(inside, slope * (1 + (x / f) ** 2), 0))
    assert s.data_range == pytest.approx(20)


PAPER_DCTLS = {
    "tent": ([0.924, 0.944, 0.962, 0.983, 0.992, 0.996, 0.998, 0.998], 0.007),
    "vase": ([0.894, 0.915, 0.936, 0.966, 0.981, 0.989, 0.992, 0.993], 0.015),
}


@pytest.mark.parametrize("name", PAPER_DCTLS)
def test_least_squares_gives_the_dctls_column_of_the_paper(name):
    column, tolerance = PAPER_DCTLS[name]
    s = SURFACES[name](200, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    for snr, published in zip((1, 5, 10, 20, 30, 40, 50, 60), column, strict=True):
        noisy = add_noise(s.gradient.expand(3, -1, -1, -1), snr, generator)
        measured = ssim(least_squares(noisy), s.height, s.data_range).mean()
        assert abs(measured - published) < tolerance, (snr, float(measured), published)


@pytest.mark.parametrize("name", SURFACES)
def test_rectangles_are_windows_of_the_square(name):
    square, window = SURFACES[name](31, dtype=torch.float64), SURFACES[name]((17, 31), dtype=torch.float64)
    assert window.height.shape == (1, 1, 17, 31)
    assert window.gradient.shape == (1, 2, 17, 31)
    torch.testing.assert_close(window.height, square.height[:, :, 7:24])
    torch.testing.assert_close(window.gradient, square.gradient[:, :, 7:24])


@pytest.mark.parametrize("name", SURFACES)
def test_slopes_keep_their_size_at_every_resolution(name):
    coarse, fine = SURFACES[name](26, dtype=torch.float64), SURFACES[name](101, dtype=torch.float64)
    torch.testing.assert_close(fine.gradient[..., ::4, ::4], coarse.gradient)
    torch.testing.assert_close(fine.height[..., ::4, ::4], 4 * coarse.height)


@pytest.mark.parametrize("make", [*SURFACES.values(), terrain], ids=lambda f: getattr(f, "name", "terrain"))
def test_dtype_range_and_finiteness(make):
    single, double = make(24), make(24, dtype=torch.float64)
    assert single.height.dtype == single.gradient.dtype == torch.float32
    assert not single.height.requires_grad
    assert not single.gradient.requires_grad
    assert single.gradient.isfinite().all()
    assert single.data_range == double.data_range > 0
    torch.testing.assert_close(single.height.double(), double.height, atol=1e-5, rtol=1e-6)


def test_surfaces_are_made_under_inference_mode_and_with_a_device():
    with torch.inference_mode():
        assert tent(8).gradient.abs().max() > 0.9
    with torch.device("meta"):
        assert tent(8, device="cpu").height.device.type == "cpu"
        assert terrain(8, device="cpu").height.device.type == "cpu"


@pytest.mark.parametrize("make", [tent, terrain], ids=["tent", "terrain"])
@pytest.mark.parametrize("n, error", [(1, ValueError), ((4, 1), ValueError), (2.5, TypeError), ((3, 4, 5), TypeError)])
def test_bad_sizes(make, n, error):
    with pytest.raises(error, match=r"^n: "):
        make(n)


def test_bad_dtype():
    with pytest.raises(TypeError, match="float16"):
        tent(8, dtype=torch.float16)


def test_terrain_slopes_belong_to_its_heights():
    s = terrain(128, dtype=torch.float64)
    z, (p, q) = s.height[0, 0], s.gradient[0]
    along = (p[:, :-2] + 4 * p[:, 1:-1] + p[:, 2:]) / 3
    down = (q[:-2] + 4 * q[1:-1] + q[2:]) / 3
    assert (z[:, 2:] - z[:, :-2] - along).square().mean().sqrt() < 0.05 * along.square().mean().sqrt()
    assert (z[2:] - z[:-2] - down).square().mean().sqrt() < 0.05 * down.square().mean().sqrt()


def test_terrain_is_in_true_units():
    """The relief of the map, in metres, and slopes that do not depend on the sampling."""
    coarse, fine = terrain(160, dtype=torch.float64), terrain(319, smoothing=2, dtype=torch.float64)
    metres = 29_800 / 159 * float(coarse.height.max() - coarse.height.min())
    assert 650 < metres < 840
    torch.testing.assert_close(coarse.gradient, fine.gradient[..., ::2, ::2], atol=1e-3, rtol=1e-3)


def test_terrain_rejects_a_negative_smoothing():
    with pytest.raises(ValueError, match="smoothing: -1"):
        terrain(16, smoothing=-1)


def test_terrain_names_the_extra_that_is_missing(monkeypatch):
    real = builtins.__import__

    def without_matplotlib(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_matplotlib)
    with pytest.raises(ImportError, match=r"torchdls\[plots\]"):
        terrain(16)


def test_noise_has_the_ratio_and_is_white():
    g = torch.cat([tent(200).gradient, 3 * vase(200).gradient]).double()
    noise = add_noise(g, 7.0, torch.Generator().manual_seed(1)) - g
    ratio = 10 * torch.log10(g.square().sum((1, 2, 3)) / noise.square().sum((1, 2, 3)))
    torch.testing.assert_close(ratio, torch.full((2,), 7.0, dtype=torch.float64), atol=0.05, rtol=0)
    sigma = noise_sigma(g, 7.0)
    torch.testing.assert_close(noise.std((2, 3)), sigma[:, None].expand(2, 2), rtol=0.02, atol=0)
    for other in (noise.roll(1, 2), noise.roll(1, 3), noise.flip(1), noise.flip(0)):
        correlation = (noise * other).mean((1, 2, 3)) / sigma.square()
        assert correlation.abs().max() < (0.05 if other.shape[0] == 1 else 3 * 0.02)


def test_noise_follows_its_seed_in_both_precisions_and_leaves_the_input():
    g = vase(16).gradient
    kept = g.clone()
    first, again = (add_noise(g, 0, torch.Generator().manual_seed(5)) for _ in range(2))
    double = add_noise(g.double(), 0, torch.Generator().manual_seed(5))
    assert first.dtype == torch.float32
    assert torch.equal(first, again)
    torch.testing.assert_close(first.double(), double, atol=1e-5, rtol=1e-5)
    assert torch.equal(g, kept)


def test_unbatched_noise_and_masks():
    g = vase(16).gradient[0]
    mask = torch.zeros(1, 16, 16, dtype=torch.bool)
    mask[:, 4:9] = True
    inside = g[:, 4:9]
    holed = torch.where(mask, g, torch.nan)
    assert noise_sigma(g, 0).shape == ()
    expected = inside.norm() / math.sqrt(inside.numel()) / 10
    torch.testing.assert_close(noise_sigma(holed, 20, mask), expected)
    assert add_noise(g, 20, torch.Generator().manual_seed(0), mask).shape == g.shape


def test_bad_noise_arguments():
    g = tent(8).gradient
    with pytest.raises(ValueError, match="snr_db=nan"):
        add_noise(g, math.nan)
    with pytest.raises(ValueError, match=r"gradient \(1, 3, 8, 8\)"):
        noise_sigma(torch.zeros(1, 3, 8, 8), 1)
    with pytest.raises(ValueError, match=r"gradient \(1, 2, 8, 8\) and mask \(1, 1, 8, 7\) differ in width"):
        noise_sigma(g, 1, torch.ones(1, 1, 8, 7, dtype=torch.bool))
