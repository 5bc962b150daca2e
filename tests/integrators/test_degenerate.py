"""Input on which nothing, or next to nothing, is left to do: what rounding leaves must not be amplified."""

import pytest
import torch

from tests.helpers import random_field, seeded
from tests.helpers.methods import Options, method
from torchdls import INTEGRATORS, AnisotropicDiffusion, HornBrooks, LeastSquares, SlopeDLS, WeightedLeastSquares


def test_anisotropic_diffusion_stays_where_it_has_arrived():
    """All iterations on four pixels, whose minimum is found in a few: the rest of the steps is rounding."""
    slopes = [6.923938274321464, -5.644907491867698, 24.813959095266007, -16.696796718007793]
    slopes += [-2.7811793832804055, 1.733769096334652, -13.914012109121858, -2.896968321032303]
    once = torch.tensor(slopes, dtype=torch.float64).view(1, 2, 2, 2)  # conjugate steps gave NaN on this one
    for g in (once, torch.randint(-2, 3, (200, 2, 3, 3), generator=seeded(0)).double()):
        arrived = AnisotropicDiffusion(tol=1e-12, follow="field")(g)
        on = AnisotropicDiffusion(n_iter=200, tol=0, follow="field")(g)
        torch.testing.assert_close(on, arrived, rtol=0, atol=1e-6)


@pytest.mark.parametrize("component", [0, 1])
@pytest.mark.parametrize("line", [(..., slice(-1, None)), (..., slice(-1, None), slice(None))], ids=["column", "row"])
def test_weighted_least_squares_on_slopes_in_one_line(line, component):
    """The scale of the slopes, a flip and a transposition pass through, wherever the only slopes are."""
    full, g = random_field(1, 2, 9, 8), torch.zeros(1, 2, 9, 8, dtype=torch.float64)
    g[:, component : component + 1][line] = full[:, component : component + 1][line]
    method = WeightedLeastSquares(tol=1e-10)
    z = method(g)
    close = 1e-7 * float(z.abs().max())
    flipped = g.flip(-1) * torch.tensor([-1.0, 1.0], dtype=torch.float64).view(1, 2, 1, 1)
    torch.testing.assert_close(method(flipped).flip(-1), z, rtol=0, atol=close)
    torch.testing.assert_close(method(g.mT.flip(1)).mT, z, rtol=0, atol=close)
    torch.testing.assert_close(method(1e-3 * g) / 1e-3, z, rtol=0, atol=close)


@pytest.mark.parametrize("recipe", ["blend", "quick", "plain"])
def test_slope_dls_has_a_derivative_on_a_plane_without_noise(recipe):
    """Exact slopes are integrated by least squares, and so is their change."""
    for seed in range(4):
        slope = torch.randn(2, generator=seeded(seed))
        g = slope.view(1, 2, 1, 1).expand(-1, -1, 16, 16).clone().requires_grad_()
        z = SlopeDLS(sigma=0.0, pixel_size=(0.5, 0.25), recipe=recipe)(g)
        z[0, 0, 1, 2].backward()
        assert g.grad is not None
        assert bool(g.grad.isfinite().all())


@pytest.mark.parametrize("weight", [1e-9, 1.0, 1e6])
def test_horn_brooks_meets_anchors_far_from_zero(weight):
    y, x = torch.meshgrid(*(torch.arange(16, dtype=torch.float64),) * 2, indexing="ij")
    truth = (0.01 * (x - 8).square() - 0.02 * (y - 5).square() + 1e6)[None, None]
    g = torch.stack([0.02 * (x - 8), -0.04 * (y - 5)])[None]
    r = torch.zeros_like(truth)
    r[..., 0] = weight
    error = (HornBrooks()(g, anchor=truth, anchor_weight=r) - truth).abs().max()
    assert float(error) < 1e-4 * float(truth.max() - truth.min())


# ---- every method of the registry, in its forms


FORMS: list[tuple[str, Options]] = [(name, {}) for name in INTEGRATORS]
FORMS += [("slope_dls", {"recipe": "quick"}), ("slope_dls", {"recipe": "plain"}), ("slope_dls", {"sigma": 0.0})]
FORMS += [("dls", {"learner": "dino_kat"}), ("dls", {"learner": "fixed"}), ("dls", {"mu": "auto"})]
FORMS += [("l1", {"smoothing": 0.0}), ("total_variation", {"smoothing": 0.0}), ("mumford_shah", {"width": 0.0})]
FORMS += [("m_estimator", {"loss": "tukey"}), ("least_squares", {"boundary": "dirichlet"})]


def still(kind, dtype):
    """A field of zeros, of a plane, and of the paraboloid that every method takes for solved."""
    y, x = torch.meshgrid(torch.arange(13, dtype=dtype), torch.arange(12, dtype=dtype), indexing="ij")
    slopes = {"zero": (0 * x, 0 * x), "plane": (0 * x + 0.3, 0 * x - 0.7), "paraboloid": (0.02 * x, -0.03 * y)}
    return torch.stack(slopes[kind])[None]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["zero", "plane", "paraboloid"])
@pytest.mark.parametrize("name, options", FORMS)
def test_a_derivative_where_nothing_moves(name, options, kind, dtype):
    """It is there, finite, and of the size that a change of slopes can have."""
    integrator, g = method(name).build(name, **options), still(kind, dtype)
    mask = torch.ones(1, 1, 13, 12, dtype=torch.bool)
    mask[..., :3, :4] = mask[..., 7, 7] = False
    for given in ((), (mask,)) if "mask" in integrator.accepts else ((),):
        leaf = g.clone().requires_grad_()
        z = integrator(leaf, *given)
        assert z.requires_grad
        assert z.isfinite().all()
        (z * random_field(*z.shape, seed=2).to(z)).sum().backward()
        assert leaf.grad.isfinite().all()
        assert leaf.grad.abs().max() < 1e3


BORDERS = {
    "left": (..., slice(None), slice(0, 1)),
    "right": (..., slice(None), slice(-1, None)),
    "top": (..., slice(0, 1), slice(None)),
    "bottom": (..., slice(-1, None), slice(None)),
}


@pytest.mark.parametrize("side", BORDERS)
@pytest.mark.parametrize("name", INTEGRATORS)
def test_slopes_along_one_border(name, side):
    """Scale, flips and a transposition pass through, wherever the only slopes are."""
    full, g = random_field(1, 2, 10, 8), torch.zeros(1, 2, 10, 8, dtype=torch.float64)
    g[BORDERS[side]] = full[BORDERS[side]]
    integrator, promises = method(name).build(name), method(name).no
    z = integrator(g)
    close = max(1e-7, method(name).tol) * float(z.abs().max())

    def same(found, expected):
        torch.testing.assert_close(found, expected, rtol=0, atol=close)

    if "scales_with_the_slopes" not in promises:
        same(integrator(8 * g) / 8, z)
        same(integrator(-g), -z)
    if "follows_flips" not in promises:
        signs = torch.tensor([-1.0, 1.0], dtype=torch.float64).view(1, 2, 1, 1)
        same(integrator(g.flip(-1) * signs).flip(-1), z)
        same(integrator(-g.flip(-2) * signs).flip(-2), z)
    if "follows_a_transpose" not in promises:
        same(integrator(g.mT.flip(1)).mT, z)


@pytest.mark.parametrize("name", ["dls", "slope_dls"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_field_without_noise_is_integrated_by_least_squares(name, dtype):
    """What rounding leaves of the curl of a plane is no noise, and nothing is learned from it."""
    for g in (still("zero", dtype), still("plane", dtype)):
        z = LeastSquares()(g)
        torch.testing.assert_close(INTEGRATORS[name]()(g), z, rtol=0, atol=1e-5 * float(z.abs().max()))
