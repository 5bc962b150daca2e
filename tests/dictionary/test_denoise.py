"""Denoising of heights: against a plain twin with scikit-learn's pursuit, and what it takes out."""

import numpy as np
import pytest
import torch

import torchdls
from tests.helpers import assert_gradients, random_field
from torchdls import SURFACES, dct_dictionary, denoise_height


def plain(y, sigma, size, n_atoms, lam, gain):
    """Patch by patch, over cosines."""
    from sklearn.linear_model import orthogonal_mp

    D = dct_dictionary(size, n_atoms + 1, dtype=torch.float64).numpy()[:, 1:]
    total, count = lam * y, np.full_like(y, lam)
    for i in range(y.shape[0] - size + 1):
        for j in range(y.shape[1] - size + 1):
            here = slice(i, i + size), slice(j, j + size)
            p = y[here].ravel()
            target, rest = size**2 * (gain * sigma) ** 2, p - p.mean()
            b = orthogonal_mp(D, rest, tol=target) if rest @ rest > target else np.zeros(n_atoms)
            total[here] += (D @ b + p.mean()).reshape(size, size)
            count[here] += 1
    return total / count


def test_over_cosines_it_is_the_plain_loop():
    y = SURFACES["tent"](14, dtype=torch.float64).height + 0.3 * random_field(1, 1, 14, 14)
    found = denoise_height(y, 0.3, patch_size=4, n_atoms=20, n_passes=0, lam=0.7, gain=1.1)
    np.testing.assert_allclose(found[0, 0], plain(y[0, 0].numpy().copy(), 0.3, 4, 20, 0.7, 1.1), atol=1e-9)


@pytest.mark.parametrize("name", ["tent", "peaks"])
def test_it_takes_out_most_of_the_noise_and_learning_helps(name):
    clean = SURFACES[name](40, dtype=torch.float64).height
    sigma = 0.1 * float(clean.std())
    noisy = clean + sigma * random_field(1, 1, 40, 40, seed=3)
    options = {"patch_size": 6, "n_atoms": 72}
    fixed, learned = (torchdls.rmse(denoise_height(noisy, sigma, n_passes=n, **options), clean) / sigma for n in (0, 4))
    assert fixed < 0.6
    assert learned < fixed


def test_offsets_scales_and_batches():
    y = random_field(2, 1, 12, 13).cumsum(-1)
    options = {"patch_size": 4, "n_atoms": 20, "n_passes": 2}
    z = denoise_height(y, 0.5, **options)
    torch.testing.assert_close(denoise_height(y + 100, 0.5, **options), z + 100, rtol=0, atol=1e-8)
    torch.testing.assert_close(denoise_height(4 * y, 2.0, **options), 4 * z)
    torch.testing.assert_close(denoise_height(y[1], 0.5, **options), z[1], rtol=0, atol=1e-9)
    flat = torch.full((1, 1, 12, 12), 3.0)
    torch.testing.assert_close(denoise_height(flat, 0.5, **options), flat)


def test_derivatives():
    y = random_field(1, 1, 5, 5)
    assert_gradients(lambda x: denoise_height(x, 0.3, patch_size=3, n_atoms=9, n_passes=0), y)


@pytest.mark.parametrize("options", [{"sigma": 0.0}, {"n_passes": -1}, {"lam": -1.0}, {"gain": 0.0}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}="):
        denoise_height(torch.zeros(1, 1, 9, 9), **{"sigma": 1.0} | options)
