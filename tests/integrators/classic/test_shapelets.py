"""Shapelets against correlation with sampled bumps, and its filter at single waves."""

import math

import pytest
import torch

from tests.helpers import random_field
from torchdls import FrankotChellappa, Shapelets


def periodic_bump_slopes(n, sigma):
    """(2, n, n) slopes of a Gaussian bump at pixel (0, 0) of a grid that repeats, dx and dy."""
    offsets = torch.arange(-6 * n, 7 * n, dtype=torch.float64)
    bell = torch.exp(-offsets.square() / (2 * sigma**2))
    value, slope = (t.view(13, n).sum(0) for t in (bell, -offsets / sigma**2 * bell))
    return torch.stack([value[:, None] * slope, slope[:, None] * value])


def test_it_is_the_correlation_with_the_slopes_of_bumps():
    """Pixel by pixel, for bumps wide enough (sigma 2 and 3) that their samples hold them to 1e-7."""
    n, g = 15, random_field(1, 2, 15, 15)
    expected = torch.zeros(n, n, dtype=torch.float64)
    for sigma in (2.0, 3.0):
        f = periodic_bump_slopes(n, sigma)
        for i in range(n):
            for j in range(n):
                expected[i, j] += (f.roll((i, j), (1, 2)) * g[0]).sum()
    expected *= math.log(1.5) / (2 * math.pi)
    torch.testing.assert_close(Shapelets(2, 2.0, 1.5)(g)[0, 0], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("period", [4, 8, 64])
def test_a_wave_is_scaled_by_the_filter(period):
    w = 2 * math.pi / period
    x = torch.arange(64, dtype=torch.float64)
    g = torch.stack([torch.cos(w * x).expand(64, 64), torch.zeros(64, 64, dtype=torch.float64)])[None]
    scale = math.log(2) * sum((2**s * w) ** 2 * math.exp(-((2**s * w) ** 2) / 2) for s in range(6))
    torch.testing.assert_close(Shapelets()(g), scale * FrankotChellappa()(g), rtol=0, atol=1e-10)


@pytest.mark.parametrize("options", [{"n_scales": 0}, {"sigma": 0.0}, {"mult": 1.0}, {"n_scales": 2.5}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        Shapelets(**options)
