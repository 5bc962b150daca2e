"""Heights from scattered slopes, against dense normal equations in NumPy and against surfaces that are known."""

import numpy as np
import pytest
import torch

from tests.helpers import assert_gradients, random_field, uniform_field
from torchdls import integrate_scattered


def test_it_is_the_minimum_of_its_objective():
    """Kernels narrow enough for plain normal equations."""
    x, g, y = 5 * uniform_field(30, 2), random_field(30, 2, seed=1), 5 * uniform_field(7, 2, seed=2)
    points, sigma, lam = x.numpy(), 0.5, 0.1
    gap = points[:, None] - points
    K = np.exp(-(gap**2).sum(-1) / (2 * sigma**2))
    D = np.concatenate([-gap[..., i] / sigma**2 * K for i in (0, 1)])
    mean = g.numpy().mean(0)
    right = D.T @ (g.numpy() - mean).T.ravel()
    a = np.linalg.solve(sigma**2 * D.T @ D + lam * K, sigma**2 * right)
    far = np.exp(-((y.numpy()[:, None] - points) ** 2).sum(-1) / (2 * sigma**2))
    expected = far @ a + y.numpy() @ mean
    expected -= (K @ a + points @ mean).mean()
    np.testing.assert_allclose(integrate_scattered(x, g, y, sigma=sigma, lam=lam), expected, atol=1e-8)


def test_a_plane_is_exact_wherever_the_points_lie():
    x, y = uniform_field(20, 2), 9 * uniform_field(5, 2, seed=1)
    slope = torch.tensor([0.3, -0.7]).double()
    expected = (y - x.mean(0)) @ slope
    torch.testing.assert_close(integrate_scattered(x, slope.expand(20, 2), y), expected, rtol=0, atol=1e-10)


def test_a_smooth_surface_is_found_between_the_points():
    """sin(x) cos(y / 2) from 400 points on a square of side 6, within 2e-3 of a relief of 2."""
    x = 6 * uniform_field(400, 2)
    g = torch.stack([x[:, 0].cos() * (x[:, 1] / 2).cos(), -0.5 * x[:, 0].sin() * (x[:, 1] / 2).sin()], -1)
    y = 0.5 + 5 * uniform_field(50, 2, seed=1)

    def surface(p):
        return p[:, 0].sin() * (p[:, 1] / 2).cos()

    expected = surface(y) - surface(x).mean()
    torch.testing.assert_close(integrate_scattered(x, g, y), expected, rtol=0, atol=2e-3)
    batch = integrate_scattered(x, torch.stack([g, -2 * g]), y)
    torch.testing.assert_close(batch, torch.stack([expected, -2 * expected]), rtol=0, atol=4e-3)
    single = integrate_scattered(x.float(), g.float(), y.float())
    torch.testing.assert_close(single.double(), expected, rtol=0, atol=3e-3)


def test_the_unit_of_the_points_is_that_of_the_heights():
    x, g, y = uniform_field(40, 2), random_field(40, 2, seed=1), uniform_field(5, 2, seed=2)
    small = integrate_scattered(x, g, y, lam=1e-2)
    torch.testing.assert_close(integrate_scattered(1e3 * x, g, 1e3 * y, lam=1e-2), 1e3 * small, rtol=1e-8, atol=1e-8)


def test_lam_is_chosen_by_the_noise():
    """Near the best of a sweep under noise, and far better than next to none; each field of a batch by itself."""
    x = 6 * uniform_field(100, 2)
    g = torch.stack([x[:, 0].cos() * (x[:, 1] / 2).cos(), -0.5 * x[:, 0].sin() * (x[:, 1] / 2).sin()], -1)
    y = 0.5 + 5 * uniform_field(60, 2, seed=1)
    truth = y[:, 0].sin() * (y[:, 1] / 2).cos()

    def errors(g, **options):
        return (integrate_scattered(x, g, y, **options) - truth).std(-1)

    noisy = g + 0.1 * random_field(4, 100, 2, seed=5)
    sweep = torch.stack([errors(noisy, lam=10.0**k) for k in range(-6, 2)])
    assert (errors(noisy) < 0.75 * sweep[0]).all()
    assert errors(noisy).mean() < 1.2 * sweep.amin(0).mean()
    assert errors(g) < 1.1 * errors(g, lam=1e-6)
    torch.testing.assert_close(errors(torch.stack([g, noisy[0]])), torch.stack([errors(g), errors(noisy[0])]))


@pytest.mark.parametrize("lam", [1e-2, "auto"])
def test_derivatives(lam):
    x, y = uniform_field(8, 2), uniform_field(3, 2, seed=2)
    assert_gradients(lambda g: integrate_scattered(x, g, y, lam=lam), random_field(2, 8, 2, seed=1))


def test_what_does_not_fit_is_named():
    x, g = uniform_field(8, 2), random_field(8, 2)
    with pytest.raises(ValueError, match=r"slopes \(7, 2\)"):
        integrate_scattered(x, g[:7], x)
    with pytest.raises(ValueError, match=r"slopes \(8, 2\) is not finite"):
        integrate_scattered(x, g * torch.nan, x)
    with pytest.raises(ValueError, match="sigma is needed"):
        integrate_scattered(x * torch.tensor([1.0, 0.0]).double(), g, x)
    for options in ({"sigma": 0.0}, {"lam": 0.0}, {"lam": "some"}):
        with pytest.raises(ValueError, match="=".join(map(str, *options.items())).replace("some", "'some'")):
            integrate_scattered(x, g, x, **options)
