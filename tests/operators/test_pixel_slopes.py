"""Slopes at the pixels: NumPy's, their exact transpose, and surfaces that come back from every integrator."""

import numpy as np
import pytest
import torch

from tests.helpers import assert_adjoint, assert_gradients, random_field
from torchdls import DLS, INTEGRATORS, GradientOperator, LeastSquares


@pytest.mark.parametrize("shape", [(5, 6), (3, 4), (9, 3)])
def test_they_are_those_of_numpy(shape):
    dx, dy = 0.5, 2.0
    z = random_field(2, 1, *shape)
    down, right = np.gradient(z[:, 0].numpy(), dy, dx, axis=(1, 2), edge_order=2)
    np.testing.assert_allclose(GradientOperator("pixel", (dx, dy))(z), np.stack([right, down], 1), atol=1e-13)


@pytest.mark.parametrize("shape", [(5, 6), (3, 4), (2, 7), (1, 2), (4, 1), (1, 1)])
def test_adjoint_derivative_and_bound(shape):
    a = GradientOperator("pixel", (0.5, 2.0))
    z, g = random_field(2, 1, *shape), random_field(2, 2, *shape, seed=1)
    assert_adjoint(a, a.adjoint, z, g)
    assert_gradients(a.adjoint, g)
    n = shape[0] * shape[1]
    matrix = a(torch.eye(n, dtype=torch.float64).view(n, 1, *shape)).flatten(1)
    assert torch.linalg.matrix_norm(matrix, 2) <= a.norm_bound
    torch.testing.assert_close(torch.vmap(a.adjoint)(g[None]), a.adjoint(g)[None])


@pytest.mark.parametrize("name", ["least_squares", "harker_oleary", "huber", "weighted_least_squares", "slope_dls"])
def test_a_quadratic_comes_back(name):
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(18.0), indexing="ij")
    z = (0.1 * x.square() - 0.05 * x * y + 0.2 * y.square() - x)[None, None].double()
    z = z - z.mean()
    found = INTEGRATORS[name]()(GradientOperator("pixel")(z))
    torch.testing.assert_close(found, z, atol=1e-4, rtol=0)


def test_other_surfaces_come_back_up_to_third_derivatives():
    def error(n: int, stencil: str) -> float:
        t = 2 * torch.linspace(0, 1, n, dtype=torch.float64)
        z = torch.sin(t)[:, None] * torch.cos(t) * n
        found = LeastSquares()(GradientOperator(stencil)(z[None, None]))
        return float((found[0, 0] - z + z.mean()).square().mean().sqrt() / z.std())

    assert error(40, "pixel") < 1e-3 < 1e-2 < error(40, "forward")
    assert error(80, "pixel") < 0.3 * error(40, "pixel")


def test_on_a_torus_they_are_central_differences():
    z = random_field(1, 1, 6, 7)
    a, b = (GradientOperator(stencil, boundary="periodic") for stencil in ("pixel", "central"))
    torch.testing.assert_close(a(z), b(z), atol=0, rtol=0)
    torch.testing.assert_close(a.adjoint(a(z)), b.adjoint(b(z)), atol=0, rtol=0)
    assert DLS(boundary="periodic", patch_size=2, n_iter=1)(a(random_field(1, 1, 6, 8))).isfinite().all()
