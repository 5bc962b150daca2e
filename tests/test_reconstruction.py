"""`reconstruct`: from normals to points in one call, against closed forms and the steps that it is made of."""

import pytest
import torch

import torchdls
from torchdls import LeastSquares, gradient_to_normals, reconstruct
from torchdls.geometry import NORMAL_CONVENTIONS
from torchdls.surfaces import SURFACES


def surface(n=32):
    return SURFACES["peaks"](n, dtype=torch.float64)


@pytest.mark.parametrize("convention", NORMAL_CONVENTIONS)
def test_a_surface_comes_back_in_every_convention(convention):
    s = surface()
    found = reconstruct(gradient_to_normals(s.gradient, convention), convention=convention, method="least_squares")
    torch.testing.assert_close(found.height, LeastSquares()(s.gradient))
    torch.testing.assert_close(found.points[:, 2:], found.height)
    assert found.depth is None
    assert found.mask.all()
    assert found.noise is None
    assert found.assumed[0].startswith(f"convention {convention}: ")
    assert "no perspective, pixels of 1 x 1" in found.assumed


def test_a_plane_through_a_camera():
    k = torch.tensor([[60.0, 0, 15], [0, 60, 15], [0, 0, 1]], dtype=torch.float64)
    n = torch.tensor([0.2, -0.3, -1.0], dtype=torch.float64)[None, :, None, None].expand(1, 3, 32, 32)
    found = reconstruct(n, camera=k, convention="opencv", method="least_squares")
    assert found.height is None
    v, u = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")
    exact = 1 / (1 - (0.2 * (u - 15) - 0.3 * (v - 15)) / 60)
    ratio = found.depth[0, 0] / exact
    assert float((ratio / ratio.mean() - 1).abs().max()) < 2e-4
    along = (found.points * torch.tensor([0.2, 0.3, 1.0], dtype=torch.float64)[:, None, None]).sum(1)  # n in OpenGL
    assert float((along / along.mean() - 1).abs().max()) < 5e-4  # they lie in the plane n.X = d
    assert found.depth.log().mean().abs() < 1e-9


def test_outside_the_mask_is_nothing_and_touches_nothing():
    s = surface()
    n = gradient_to_normals(s.gradient)
    mask = torch.ones(1, 1, 32, 32, dtype=torch.bool)
    mask[..., :6, :7] = False
    n[..., :6, :7] = torch.nan
    n[..., 20, 20] = -n[..., 20, 20]
    found = reconstruct(n, mask, method="least_squares")
    valid = mask.clone()
    valid[..., 20, 20] = False
    assert torch.equal(found.mask, valid)
    assert torch.equal(found.height.isfinite(), valid)
    assert torch.equal(found.points.isfinite().all(1, keepdim=True), valid)
    torch.testing.assert_close(found.height[valid], LeastSquares()(s.gradient, valid)[valid])
    assert found.assumed[-1].startswith("1 normals inside the mask")


def test_methods_by_name_and_made_with_pixel_size():
    s = surface(24)
    n = gradient_to_normals(s.gradient)
    found = reconstruct(n[0], method=LeastSquares(pixel_size=0.5))
    torch.testing.assert_close(found.height, 0.5 * LeastSquares()(s.gradient))
    assert float(found.points[0, 0, 0, 2]) == 1.0
    slope = reconstruct(n)
    torch.testing.assert_close(slope.height, torchdls.SlopeDLS()(s.gradient))
    assert slope.noise.shape == (1,)


def test_gradients_pass_through():
    s = surface(12)
    n = gradient_to_normals(s.gradient).requires_grad_()
    reconstruct(n, method="least_squares").height.square().sum().backward()
    assert n.grad.isfinite().all()
    assert n.grad.abs().sum() > 0


@pytest.mark.parametrize(
    "change, error, match",
    [
        ({"convention": "x"}, ValueError, "convention"),
        ({"method": "x"}, ValueError, "'x' is unknown"),
        ({"method": 3}, TypeError, "method is a int"),
        ({"mask": torch.zeros(1, 1, 8, 8, dtype=torch.bool)}, ValueError, "no valid normal"),
        ({"camera": torch.eye(3), "method": LeastSquares(pixel_size=2.0)}, ValueError, "beside a camera"),
        ({"camera": torch.zeros(3, 3)}, ValueError, "singular"),
        ({"normals": torch.ones(1, 2, 8, 8)}, ValueError, "normals"),
    ],
)
def test_bad_arguments(change, error, match):
    arguments = {"normals": torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1).expand(1, 3, 8, 8)} | change
    with pytest.raises(error, match=match):
        reconstruct(**arguments)
