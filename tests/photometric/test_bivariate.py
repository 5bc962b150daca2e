"""Constrained bivariate regression: exact on matte surfaces, a quadratic programme of SciPy, and what it repairs."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from torchdls import SURFACES, bivariate_normals, gradient_to_normals, render, ring_of_lights, sparse_normals, woodham
from torchdls.photometric.bivariate import _bernstein, _roughness, _split

LIGHTS = torch.cat([ring_of_lights(30, tilt, dtype=torch.float64) for tilt in (25.0, 50.0)])


def normals(n=12):
    return gradient_to_normals(SURFACES["gaussians"](n, dtype=torch.float64).gradient)


def degrees(a, b):
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b, dim=1).norm(dim=1), (a * b).sum(1))).mean().item()


def test_matte_surfaces_are_exact():
    n = normals()
    found = bivariate_normals(render(n, 2.5 * LIGHTS, 0.4), 2.5 * LIGHTS)
    torch.testing.assert_close(found.normals, n, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.albedo, torch.full_like(found.albedo, 0.4), rtol=0, atol=1e-6)


def test_broad_highlights_and_rough_surfaces_are_repaired():
    n = normals()
    for images in (render(n, LIGHTS, highlight=0.5, shininess=10), render(n, LIGHTS) ** 0.7):
        ours, sparse, plain = (
            degrees(m(images, LIGHTS).normals, n) for m in (bivariate_normals, sparse_normals, woodham)
        )
        assert ours < 0.55 * min(sparse, plain)


def test_the_splitting_solves_the_quadratic_programme():
    """Against SLSQP on pixels where bounds are active."""
    generator = torch.Generator().manual_seed(3)
    A = torch.randn(4, 40, 15, dtype=torch.float64, generator=generator)
    Q = A.mT @ A
    a = torch.cat([torch.zeros(3), torch.full((12,), 0.25)]).double()
    free = torch.arange(15) < 3
    found = _split(Q, a, free, 3000)
    for i in range(4):
        q = Q[i].numpy()
        best = minimize(
            lambda x, q=q: 0.5 * x @ q @ x, np.full(15, 1 / 3), jac=lambda x, q=q: q @ x, method="SLSQP",
            bounds=[(None, None)] * 3 + [(0, None)] * 12, options={"ftol": 1e-14, "maxiter": 1000},
            constraints={"type": "eq", "fun": lambda x: a.numpy() @ x - 1, "jac": lambda x: a.numpy()},
        )  # fmt: skip
        assert (best.x[3:] < 1e-7).any()
        np.testing.assert_allclose(found[i].numpy(), best.x, atol=1e-4)


def test_bernstein_polynomials_and_their_bends_by_hand():
    x = torch.tensor([0.0, 0.25, 1.0], dtype=torch.float64)
    assert torch.allclose(_bernstein(x, 3).sum(-1), torch.ones(3).double())
    assert torch.allclose(_bernstein(x, 3)[1], torch.tensor([27, 27, 9, 1]).double() / 64)
    d = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    C = torch.cat([torch.zeros(1, 4).double(), d.cumsum(0)])
    bends = sum(C.diff(n=2, dim=i).square().sum() for i in (0, 1))
    full = torch.cat([torch.ones(3).double(), d.flatten()])
    torch.testing.assert_close(full @ _roughness(3) @ full, bends)


def test_derivatives():
    """In images and lights, by finite differences; no bound of the fit may come in or go out on the way."""
    lights = LIGHTS[::4]
    images = (render(normals(), lights) ** 0.8)[..., 3:5, 6:7]

    def run(i, k):
        return torch.cat(bivariate_normals(i, k, degree=2, n_iter=40)[:2], 1)

    inputs = images.requires_grad_(), lights.clone().requires_grad_()
    assert torch.autograd.gradcheck(run, inputs, fast_mode=True, atol=1e-5)


def test_pixels_with_fewer_than_three_lit_samples_are_unknown():
    images = render(normals(), LIGHTS)
    images[:, 2:, 0, 0] = 0
    found = bivariate_normals(images, LIGHTS)
    assert (found.normals[0, :, 0, 0] == 0).all()
    assert found.confidence[0, 0, 0, 0] == 0


@pytest.mark.parametrize("options", [{"degree": 0}, {"n_iter": 0}, {"smoothness": -1.0}, {"shadow": 1.0}])
def test_bad_options_are_named(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        bivariate_normals(torch.ones(1, 60, 4, 4).double(), LIGHTS, **options)
