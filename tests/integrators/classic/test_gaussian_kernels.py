"""Gaussian bumps in Fourier space against the dense system of bumps and their mirror images."""

import numpy as np
import pytest
import torch

from tests.helpers.fields import random_field
from torchdls import SURFACES, GaussianKernels, LeastSquares, add_noise, mean_angular_error


def mirrored(n, sigma, step):
    """Bumps and their derivatives (pixel, bump) along a line whose border is a mirror, by summing the images."""
    at = np.arange(n) * step
    values = slopes = np.zeros((n, n))
    for turn in range(-6, 7):
        for centre in (np.arange(n) * step, (2 * n - 1 - np.arange(n)) * step):
            d = at[:, None] - centre - 2 * n * step * turn
            bump = np.exp(-(d**2) / (2 * sigma**2))
            values, slopes = values + bump, slopes - d / sigma**2 * bump
    return values, slopes


@pytest.mark.parametrize("sigma, lam, steps", [(1.0, 1e-2, (1.0, 1.0)), (1.7, 0.3, (0.5, 2.0))])
def test_equals_the_dense_system(sigma, lam, steps):
    g = random_field(1, 2, 6, 5)
    z = GaussianKernels(sigma, lam, pixel_size=steps)(g)[0, 0].numpy().ravel()
    (k_y, d_y), (k_x, d_x) = mirrored(6, sigma, steps[1]), mirrored(5, sigma, steps[0])
    K, D_x, D_y = np.kron(k_y, k_x), np.kron(k_y, d_x), np.kron(d_y, k_x)
    slope = g.mean((2, 3))[0].numpy()
    rest = [(g[0, c].numpy() - slope[c]).ravel() for c in (0, 1)]
    H = sigma**2 * (D_x.T @ D_x + D_y.T @ D_y) + lam * K
    a = np.linalg.lstsq(H, sigma**2 * (D_x.T @ rest[0] + D_y.T @ rest[1]), rcond=1e-15)[0]
    y, x = np.mgrid[:6, :5]
    expected = K @ a + (slope[0] * steps[0] * x + slope[1] * steps[1] * y).ravel()
    np.testing.assert_allclose(z, expected - expected.mean(), atol=1e-8)


def test_takes_noise_out_of_the_slopes():
    surface = SURFACES["peaks"](32, dtype=torch.float64)
    noisy = add_noise(surface.gradient, 0, torch.Generator().manual_seed(0))
    found, plain = (mean_angular_error(m(noisy), surface.height) for m in (GaussianKernels(2.0, 1.0), LeastSquares()))
    assert found < 0.85 * plain


@pytest.mark.parametrize("bad", [{"sigma": 0.0}, {"lam": -1.0}])
def test_bad_options(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        GaussianKernels(**bad)
