"""The coder of normal maps against known noise, and its derivative against finite differences."""

import math

import pytest
import torch
from torch import Tensor

from tests.helpers import random_field
from torchdls import SURFACES, convert_normals, denoise_normals, gradient_to_normals, normal_noise
from torchdls.dictionary.normals import blur, code_normals

CAMERA = torch.tensor([[60.0, 0, 20], [0, 60, 30], [0, 0, 1]]).double()  # a wide view, off its axis


def true_normals(n: int = 64, camera: Tensor | None = None) -> Tensor:
    slopes = SURFACES["peaks"](n, dtype=torch.float64).gradient
    return gradient_to_normals(slopes if camera is None else slopes / 60, camera=camera)


def noisy(true: Tensor, degrees: float, seed: int = 0) -> Tensor:
    noise = math.radians(degrees) / 2**0.5 * random_field(*true.shape, seed=seed)
    return torch.nn.functional.normalize(true + noise - (noise * true).sum(1, keepdim=True) * true, dim=1)


def angle(a: Tensor, b: Tensor) -> Tensor:
    """(N,) root mean square, in degrees."""
    cosine = (a * b).sum(1).clamp(-1, 1)
    return torch.rad2deg(torch.acos(cosine)).square().mean((-2, -1)).sqrt()


@pytest.mark.parametrize("camera", [None, CAMERA])
@pytest.mark.parametrize("degrees", [2.0, 5.0, 10.0])
def test_noise_is_read_within_a_tenth(camera, degrees):
    found = math.degrees(float(normal_noise(noisy(true_normals(camera=camera), degrees), camera=camera))) * 2**0.5
    assert found == pytest.approx(degrees, rel=0.1)


@pytest.mark.parametrize("degrees", [2.0, 5.0, 10.0, 20.0])
def test_half_of_the_noise_goes(degrees):
    true = true_normals()
    assert angle(denoise_normals(noisy(true, degrees)).normals, true) < 0.5 * degrees


def test_without_noise_normals_stay():
    true = true_normals()
    torch.testing.assert_close(denoise_normals(true, sigma=0.0).normals, true)


def test_each_of_a_batch_is_its_own():
    true = true_normals(32)
    both = torch.cat([noisy(true, 3), noisy(true, 12, seed=1)])
    coded = denoise_normals(both)
    for i in range(2):
        alone = denoise_normals(both[i])
        torch.testing.assert_close(coded.normals[i], alone.normals)
        torch.testing.assert_close(coded.sigma[i], alone.sigma)


def test_outside_is_never_read_and_comes_out_as_zero():
    spoilt = noisy(true_normals(32), 5)
    mask = torch.ones(1, 1, 32, 32, dtype=torch.bool)
    mask[..., :, 20:] = False
    expected = denoise_normals(spoilt, mask)
    spoilt[..., 20:] = torch.nan
    found = denoise_normals(spoilt, mask)
    assert torch.equal(found.normals, expected.normals)
    assert (found.normals[..., 20:] == 0).all()
    torch.testing.assert_close(found.normals[..., :20].norm(dim=1), torch.ones(1, 32, 20).double())


def test_normals_that_face_away_take_part():
    """Without them the mean of a steep face would come out less steep than it is."""
    steep = math.cos(1.5)
    true = torch.tensor([math.sin(1.5), 0, steep]).double().view(1, 3, 1, 1).expand(1, 3, 32, 32)
    spoilt = noisy(true, 10)
    facing = spoilt[:, 2][spoilt[:, 2] > 0]
    assert facing.mean() > 1.3 * steep
    coded = denoise_normals(spoilt, sigma=math.radians(10) / 2**0.5).normals
    assert float(coded[:, 2].mean()) == pytest.approx(steep, rel=0.1)
    assert angle(coded, true) < 5


def test_conventions_agree():
    spoilt = noisy(true_normals(32), 5)
    other = denoise_normals(convert_normals(spoilt, target="opencv"), convention="opencv")
    expected = denoise_normals(spoilt)
    torch.testing.assert_close(convert_normals(other.normals, source="opencv"), expected.normals)
    torch.testing.assert_close(other.sigma, expected.sigma)


def test_derivative_equals_finite_differences():
    n = noisy(true_normals(16), 8)
    mask = torch.ones(1, 1, 16, 16, dtype=torch.bool)
    mask[..., 4:7, 4:7] = False
    sigma = torch.tensor([0.1]).double()
    assert torch.autograd.gradcheck(
        lambda x, s: denoise_normals(x, mask, s, patch_sizes=(4, 8)).normals,
        (n.requires_grad_(), sigma.requires_grad_()),
        fast_mode=True,
    )


def test_vmap_is_a_loop():
    n = torch.stack([noisy(true_normals(16), 8, seed=s) for s in range(2)])
    together = torch.vmap(
        lambda x: code_normals(x, torch.ones_like(x[:, :1], dtype=torch.bool), torch.full((1,), 0.1))
    )(n)
    for found, one in zip(together, n, strict=True):
        torch.testing.assert_close(found, code_normals(one, one[:, :1] < 2, torch.full((1,), 0.1)))


def test_blur_is_a_gaussian():
    x = torch.zeros(1, 1, 41, 41).double()
    x[..., 20, 20] = 1
    y = blur(x, 2.0)[0, 0]
    at = torch.arange(41.0).double() - 20
    assert float(y.sum()) == pytest.approx(1)
    assert float((y.sum(0) * at.square()).sum()) == pytest.approx(4, rel=1e-3)


@pytest.mark.parametrize("options, match", [({"sigma": -1.0}, "sigma"), ({"patch_sizes": (1,)}, "patch_sizes")])
def test_bad_options_are_named(options, match):
    with pytest.raises(ValueError, match=match):
        denoise_normals(true_normals(8), **options)
