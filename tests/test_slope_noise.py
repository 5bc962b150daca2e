"""The covariance of slopes against the Jacobian that autograd finds of `normals_to_gradient`."""

import pytest
import torch

from tests.helpers.fields import random_field
from torchdls import normals_to_gradient, slope_noise

CAMERA = torch.tensor([[20.0, 0.5, 2], [0, 25, 1], [0, 0, 1]], dtype=torch.float64)
ENTRIES = [0, 1, 2, 1, 3, 4, 2, 4, 5]


def problem(h=3, w=4):
    normals = random_field(1, 3, h, w, seed=1) * 0.3
    normals[:, 2] += 1.0
    root = random_field(h, w, 3, 3, seed=2)
    C = root @ root.mT
    return normals, C, C.flatten(-2)[..., [0, 1, 2, 4, 5, 8]].movedim(-1, 0)[None].contiguous()


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_equals_the_jacobian(camera):
    normals, C, entries = problem()
    noise = slope_noise(normals, entries, camera=camera)
    J = torch.func.jacrev(lambda n: normals_to_gradient(n, camera=camera).gradient)(normals)
    for i in range(3):
        for j in range(4):
            at = J[0, :, i, j, 0, :, i, j]
            spread = at @ C[i, j] @ at.mT
            torch.testing.assert_close(noise.covariance[0, :, i, j], spread.flatten()[[0, 1, 3]])
    inverse = 1 / noise.covariance[:, [0, 2]]
    torch.testing.assert_close(noise.weight, inverse / inverse.mean())
    single = slope_noise(normals[0], entries[0], camera=camera)
    torch.testing.assert_close(single.covariance, noise.covariance[0])


def test_nothing_is_known_where_there_are_no_slopes_or_no_noise():
    normals, _, entries = problem()
    normals[..., 0, 0], normals[:, 2, 1, 1], entries[..., 2, 2] = float("nan"), -1, 0
    noise = slope_noise(normals, entries)
    for i in range(3):
        assert (noise.covariance[..., i, i] == 0).all()
        assert (noise.weight[..., i, i] == 0).all()
    assert noise.weight.isfinite().all()
    assert (noise.weight[..., 0, 1] > 0).all()


def test_derivative():
    normals, _, entries = problem(2, 2)
    inputs = [normals.requires_grad_(), entries.requires_grad_()]
    assert torch.autograd.gradcheck(lambda n, c: tuple(slope_noise(n, c, camera=CAMERA)), inputs)


def test_bad_arguments():
    with pytest.raises(ValueError, match=r"covariance \(1, 3, 4, 5\)"):
        slope_noise(torch.zeros(1, 3, 4, 5), torch.zeros(1, 3, 4, 5))
