"""Photometric stereo by dictionary learning: limits in closed form, an objective that falls, and what it gains."""

from itertools import pairwise

import pytest
import torch

from tests.helpers import DISK, random_field, seeded
from torchdls import (
    SURFACES,
    Patches,
    SoupDIL,
    dlnv_normals,
    dlpi_normals,
    gradient_to_normals,
    render,
    ring_of_lights,
    woodham,
)
from torchdls.photometric import dictionary

METHODS = [dlpi_normals, dlnv_normals]
LIGHTS = ring_of_lights(8, dtype=torch.float64)


def scene(name="tent", snr=10, seed=1, n=48):
    normals = gradient_to_normals(SURFACES[name](n, dtype=torch.float64).gradient)
    return normals, render(normals, LIGHTS, 0.8, snr_db=snr, generator=seeded(seed))


def degrees(a, b):
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b, dim=1).norm(dim=1), (a * b).sum(1))).mean().item()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name, seed", [("tent", 7), ("peaks", 8), ("gaussians", 9)])
def test_noise_is_halved_on_surfaces_that_were_not_looked_at(method, name, seed):
    normals, images = scene(name, 15, seed)
    found = method(images, LIGHTS)
    assert degrees(found.normals, normals) < 0.6 * degrees(woodham(images, LIGHTS, shadow=None).normals, normals)


@pytest.mark.parametrize("method", METHODS)
def test_limits_are_woodham(method):
    """No weight on the patches, no iteration, or codes that are all kept."""
    _, images = scene(n=24)
    plain = woodham(images, LIGHTS, shadow=None).normals
    torch.testing.assert_close(method(images, LIGHTS, lam=0.0).normals, plain)
    torch.testing.assert_close(method(images, LIGHTS, n_iter=0).normals, plain)
    if method is dlnv_normals:  # its dictionary is square
        torch.testing.assert_close(method(images, LIGHTS, mu=0.0, n_iter=1).normals, plain)


def test_the_map_step_is_the_dense_solve(monkeypatch):
    """Of one iteration of DLNV, pixel by pixel, with some samples not lit."""
    _, images = scene(n=16)
    lit = torch.rand(images.shape, generator=seeded(2)) < 0.8
    seen = {}

    def spy(x, update, patches, depth, mu, n_iter):
        seen["folded"] = random_field(*x.shape, seed=5)
        return update(seen["folded"])

    monkeypatch.setattr(dictionary, "_denoise", spy)
    found = dlnv_normals(images, LIGHTS, lit=lit, lam=0.3)
    b = found.albedo * found.normals
    weight = 2 * 0.3 * float(LIGHTS.square().sum()) / 3
    c = Patches(8, 2).coverage((16, 16), dtype=torch.float64)
    for i, j in ((0, 0), (5, 9), (15, 3)):
        L = LIGHTS[lit[0, :, i, j]]
        A = L.T @ L + weight * c[0, 0, i, j] * torch.eye(3).double()
        rhs = L.T @ images[0, lit[0, :, i, j], i, j] + weight * seen["folded"][0, :, i, j]
        torch.testing.assert_close(b[0, :, i, j], torch.linalg.solve(A, rhs))


def test_the_objective_falls(monkeypatch):
    _, images = scene(n=24)
    patches, lam, mu = Patches(8, 2), 0.5, 0.2
    costs = []
    for n_iter in range(1, 6):
        parts: dict[str, torch.Tensor] = {}

        def learner(R, D, B, level, parts=parts):
            parts["R"], parts["D"], parts["B"] = SoupDIL("block")(R, D, B, level)
            return parts["R"], parts["D"], parts["B"]

        monkeypatch.setattr(dictionary, "_LEARNER", learner)
        c = 2 * lam * patches.coverage(images.shape, dtype=images.dtype)

        def update(folded, c=c):
            return (images + 2 * lam * folded) / (1 + c)

        X = dictionary._denoise(
            images, update, patches, dictionary._matte(LIGHTS[None]), images.new_full((1,), mu), n_iter
        )
        R = dictionary._extract(X, patches) - parts["D"] @ parts["B"]
        cost = 0.5 * (images - X).square().sum() + lam * (R.square().sum() + mu**2 * (parts["B"] != 0).sum())
        costs.append(float(cost))
    assert all(b <= a + 1e-9 for a, b in pairwise(costs))


def test_the_order_of_the_images_does_not_matter():
    """And many images help: the first atoms span what matte images can be, whatever the lights."""
    lights = torch.cat([ring_of_lights(8, tilt, dtype=torch.float64) for tilt in (25.0, 45.0)])
    normals = gradient_to_normals(SURFACES["gaussians"](32, dtype=torch.float64).gradient)
    exact = render(normals, lights)
    assert degrees(dlpi_normals(exact, lights).normals, normals) < 0.05
    noisy = render(normals, lights, snr_db=15, generator=seeded(2))
    order = torch.randperm(16, generator=seeded(3))
    found, other = (dlpi_normals(i, k).normals for i, k in ((noisy, lights), (noisy[:, order], lights[order])))
    torch.testing.assert_close(other, found, rtol=0, atol=1e-8)
    assert degrees(found, normals) < 0.6 * degrees(woodham(noisy, lights, shadow=None).normals, normals)


def test_patches_of_channels_are_adjoint():
    patches, x = Patches(4, 3), random_field(2, 3, 11, 9)
    P = dictionary._extract(x, patches)
    y = random_field(*P.shape, seed=4)
    torch.testing.assert_close((P * y).sum(), (x * dictionary._fold(y, patches, x.shape)).sum())
    block = x[1, :, 3:7, 3:7].reshape(-1)
    _, columns = patches.grid(x.shape)
    assert torch.equal(P[1, :, columns + 1], block)


@pytest.mark.parametrize("method", METHODS)
def test_masks_batches_and_derivatives(method):
    _, images = scene(n=32)
    mask = DISK(32, 32)
    hidden = torch.where(mask, images, torch.nan)
    found = method(hidden, LIGHTS, mask=mask, n_iter=3)
    assert found.normals.isfinite().all()
    assert (torch.where(mask, 0, found.normals) == 0).all()
    both = method(torch.cat([images, 2 * images.flip(-1)]), LIGHTS, n_iter=3)
    torch.testing.assert_close(both.normals[:1], method(images, LIGHTS, n_iter=3).normals)
    torch.testing.assert_close(both.normals[1], method(2 * images[0].flip(-1), LIGHTS, n_iter=3).normals)
    point = images.clone().requires_grad_()
    method(point, LIGHTS, n_iter=2).normals.square().mean().backward()
    assert point.grad.isfinite().all()


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_by_finite_differences(method):
    """In the images and in the lights, with some codes kept and some not."""
    images = torch.rand(1, 4, 5, 6, dtype=torch.float64, generator=seeded(3)) + 0.3
    lights = LIGHTS[::2] + 0.1 * random_field(4, 3, seed=4)
    options = {"patch_size": 3, "stride": 2, "mu": 0.1, "n_iter": 2}
    inputs = images.requires_grad_(), lights.requires_grad_()
    assert torch.autograd.gradcheck(lambda i, k: torch.cat(method(i, k, **options)[:2], 1), inputs, fast_mode=True)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("options, message", [
    ({"lam": -1.0}, "lam=-1.0"), ({"mu": "some"}, "mu='some'"), ({"mu": -1.0}, "mu=-1.0"), ({"n_iter": -1}, "n_iter"),
    ({"patch_size": 30}, "smaller than a patch"),
])  # fmt: skip
def test_bad_options_are_named(method, options, message):
    with pytest.raises(ValueError, match=message):
        method(torch.ones(1, 8, 24, 24).double(), LIGHTS, **options)
