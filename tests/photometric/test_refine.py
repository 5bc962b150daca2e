"""Heights straight from images: exact where the model is, and better than what they start from under noise."""

import numpy as np
import pytest
import torch

from tests.helpers import assert_unchanged, random_field, seeded
from torchdls import (
    SURFACES,
    LeastSquares,
    gradient_to_normals,
    normals_to_gradient,
    refine,
    render,
    ring_of_lights,
    rmse,
    woodham,
)
from torchdls.photometric.model import check
from torchdls.photometric.refine import _misfit, _reflect, _scene, _step

LIGHTS = ring_of_lights(4, 35.0, dtype=torch.float64) * torch.tensor([1.0, 0.8, 1.2, 1.0]).double()[:, None]


def scene_of(images, albedo=None, mask=None, lights=LIGHTS):
    return _scene(check("refine", images, lights, mask, None, least=2), albedo, mask, (1.0, 1.0))


def exact(height, albedo, lights=LIGHTS):
    """Images that both triangles of a pixel give; at pixels where they differ, the sum is least at their mean."""
    scene = scene_of(torch.zeros(1, len(lights), *height.shape[-2:], dtype=torch.float64), lights=lights)
    value, _ = _reflect(scene, scene.slopes(height))
    weight = scene.trust
    return albedo * (weight * value).sum(1) / weight.sum(1).clamp(min=1e-9)


def test_slopes_are_those_of_the_triangles_by_hand():
    z = random_field(1, 1, 5, 6)
    s = scene_of(torch.zeros(1, 4, 5, 6, dtype=torch.float64)).slopes(z)[0]
    a = z[0, 0]
    assert torch.equal(s[0, :, 2, 3], torch.stack([a[2, 4] - a[2, 3], a[3, 3] - a[2, 3]]))
    assert torch.equal(s[1, :, 2, 3], torch.stack([a[2, 3] - a[2, 2], a[2, 3] - a[1, 3]]))


@pytest.mark.parametrize("given", [True, False])
def test_the_step_is_that_of_gauss_newton_on_the_dense_jacobian(given):
    """Variable projection: the Jacobian of the residual with the best albedo, its derivative in the albedo left out."""
    z, images = random_field(1, 1, 5, 6, seed=1), random_field(1, 4, 5, 6, seed=2).abs() + 0.2
    albedo = torch.full((1, 1, 5, 6), 0.7, dtype=torch.float64) if given else None
    scene = scene_of(images, albedo)

    def residual(z, albedo):
        value, _ = _reflect(scene, scene.slopes(z.view(1, 1, 5, 6)))
        return (scene.trust.sqrt() * (images[:, None] - albedo[:, None] * value)).flatten()

    best = _misfit(scene, z)[1]
    J = torch.func.jacrev(lambda x: residual(x, best))(z.flatten()).view(-1, 30)
    r = residual(z, best)
    if not given:
        A = torch.func.jacrev(lambda a: residual(z, a))(best).view(-1, 30)
        A = A[:, A.square().sum(0) > 0]
        Q = torch.linalg.qr(A)[0]
        J, r = J - Q @ (Q.T @ J), r - Q @ (Q.T @ r)
    step = _step(scene, z).flatten()
    expected = torch.from_numpy(np.linalg.lstsq(J.numpy(), -r.numpy(), rcond=1e-9)[0])
    expected, step = expected - expected.mean(), step - step.mean()
    assert float((step - expected).norm() / expected.norm()) < 0.02  # conjugate gradients stop at 1e-3


def test_exact_images_give_the_height_back():
    """A plane, whose triangles agree at every pixel; the albedo is found with it."""
    y, x = torch.meshgrid(*(torch.arange(24, dtype=torch.float64),) * 2, indexing="ij")
    height = (0.3 * x - 0.2 * y)[None, None] + 2
    albedo = 0.5 + 0.3 * torch.rand(1, 1, 24, 24, dtype=torch.float64, generator=seeded(0))
    images = exact(height, albedo)
    start = height + 0.5 * torch.sin(x / 4) * torch.cos(y / 5)
    found = refine(start, images, LIGHTS, n_iter=40, tol=0.0)
    torch.testing.assert_close(found.height - found.height.mean(), height - height.mean(), rtol=0, atol=1e-5)
    inside = torch.ones_like(albedo, dtype=torch.bool)
    inside[..., 0, -1] = inside[..., -1, 0] = False  # no triangle has its right angle in these corners
    torch.testing.assert_close(found.albedo[inside], albedo[inside], rtol=0, atol=1e-5)


def test_two_images_are_enough_where_the_albedo_is_known():
    """Also where no normal could be told from them; both lights see the pixel from different sides."""
    y, x = torch.meshgrid(*(torch.arange(24, dtype=torch.float64),) * 2, indexing="ij")
    height, albedo = (0.3 * x - 0.2 * y)[None, None], 0.5 + 0.3 * torch.rand(1, 1, 24, 24, generator=seeded(0)).double()
    lights = LIGHTS[:2]
    images = exact(height, albedo, lights)
    start = height + 0.5 * torch.sin(x / 4) * torch.cos(y / 5)
    found = refine(start, images, lights, albedo=albedo, n_iter=40, tol=0.0)
    torch.testing.assert_close(found.height, height - height.mean() + start.mean(), rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="at least K = 3"):
        refine(start, images, lights)


@pytest.mark.parametrize("name, seed", [("tent", 3), ("peaks", 4), ("gaussians", 5)])
def test_it_is_likelier_than_the_truth_and_better_on_tent(name, seed):
    surface = SURFACES[name](48, dtype=torch.float64)
    lights = ring_of_lights(8, dtype=torch.float64)
    images = render(gradient_to_normals(surface.gradient), lights, 0.8, snr_db=20, generator=seeded(seed))
    start = LeastSquares()(normals_to_gradient(woodham(images, lights, shadow=None).normals).gradient)
    with assert_unchanged(start, images, lights):
        found = refine(start, images, lights)
    assert (found.objective.diff(dim=1) <= 0).all()
    truth = refine(surface.height, images, lights, n_iter=0).objective[0, 0]
    assert found.objective[0, -1] < truth  # as the likeliest surface must be
    if name == "tent":
        assert rmse(found.height, surface.height) < rmse(start, surface.height)


def test_each_surface_by_itself_in_its_own_units():
    surface = SURFACES["peaks"](24, dtype=torch.float64)
    other = SURFACES["tent"](24, dtype=torch.float64)
    images = torch.cat([render(gradient_to_normals(s.gradient), LIGHTS) for s in (surface, other)])
    start = torch.cat([0.8 * surface.height, 0.8 * other.height])
    both = refine(start, images, LIGHTS, n_iter=25, tol=0.0)
    for i in range(2):
        alone = refine(start[i], images[i], LIGHTS, n_iter=25, tol=0.0)
        torch.testing.assert_close(alone.height, both.height[i], rtol=0, atol=1e-5)
    scaled = refine(3 * start, images, LIGHTS, n_iter=25, tol=0.0, pixel_size=3.0)
    torch.testing.assert_close(scaled.height, 3 * both.height, rtol=0, atol=1e-5)


def test_nothing_outside_the_mask_is_read():
    surface = SURFACES["peaks"](24, dtype=torch.float64)
    mask = torch.zeros(1, 1, 24, 24, dtype=torch.bool)
    mask[..., 3:20, 4:22] = True
    images = render(gradient_to_normals(surface.gradient), LIGHTS)
    spoilt = torch.where(mask, images, torch.nan)
    clean, found = (refine(0.9 * surface.height, i, LIGHTS, mask=mask, n_iter=5).height for i in (images, spoilt))
    assert torch.equal(torch.where(mask, clean, 0), torch.where(mask, found, 0))


@pytest.mark.parametrize("options, message", [
    ({"n_iter": -1}, "n_iter=-1"), ({"tol": -1.0}, "tol=-1.0"),
    ({"albedo": torch.ones(1, 2, 24, 24).double()}, "albedo"),
])  # fmt: skip
def test_bad_options_are_named(options, message):
    z = torch.zeros(1, 1, 24, 24, dtype=torch.float64)
    with pytest.raises(ValueError, match=message):
        refine(z, z.expand(1, 4, -1, -1), LIGHTS, **options)
    with pytest.raises(ValueError, match="height"):
        refine(z[..., 1:], z.expand(1, 4, -1, -1), LIGHTS)
