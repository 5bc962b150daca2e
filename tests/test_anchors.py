"""Coarse depths whose scale and offset are fitted, pieces that are placed, and both through `reconstruct`."""

import math

import pytest
import torch
from torch import Tensor

from tests.helpers import random_field
from torchdls import (
    SURFACES,
    Piecewise,
    fit_coarse,
    gradient_to_normals,
    normals_to_gradient,
    place_pieces,
    reconstruct,
    rmse,
)
from torchdls.anchors import parts_of

NAN = float("nan")


def two_pieces(n: int = 16) -> tuple[Tensor, Tensor]:
    z = SURFACES["peaks"](n, dtype=torch.float64).height
    pieces = torch.ones(1, 1, n, n, dtype=torch.int64)
    pieces[..., 10:] = 2
    return z, pieces


def test_scale_and_offset_are_those_that_made_the_coarse_heights():
    z, pieces = two_pieces()
    moved = z + 7.0 * (pieces == 2)  # the second piece is 7 too high
    coarse = -2.5 * z + 4
    coarse[..., 3, 4] = 1e3  # what is wild has no say
    coarse[..., 0, :] = NAN
    fit = fit_coarse(moved, coarse, pieces=pieces)
    torch.testing.assert_close(fit.scale, torch.tensor([-2.5]).double(), rtol=1e-4, atol=0)
    torch.testing.assert_close(fit.offset, torch.tensor([4.0]).double(), rtol=1e-3, atol=0)
    assert not fit.known[..., 0, :].any()
    right = fit.known & (coarse != 1e3)
    torch.testing.assert_close(fit.anchor[right], z[right], rtol=1e-3, atol=1e-3)


def test_scale_and_offset_of_depths_under_a_camera():
    z, pieces = two_pieces()
    z = 0.1 * z
    moved = z + 0.3 * (pieces == 2)
    fit = fit_coarse(moved, 5.0 * z.exp() - 1.5, pieces=pieces, log_depth=True)
    torch.testing.assert_close(fit.scale, torch.tensor([5.0]).double(), rtol=1e-3, atol=0)
    torch.testing.assert_close(fit.offset, torch.tensor([-1.5]).double(), rtol=1e-2, atol=0)
    torch.testing.assert_close(fit.anchor, z, rtol=1e-2, atol=1e-3)


def test_a_flat_surface_tells_no_scale():
    flat = torch.zeros(1, 1, 6, 6)
    with pytest.raises(ValueError, match="too flat"):
        fit_coarse(flat, random_field(1, 1, 6, 6).float())


def test_parts_by_size():
    inside = torch.zeros(1, 1, 3, 7, dtype=torch.bool)
    inside[..., :2] = inside[..., 3:] = True
    found = parts_of(inside)[0, 0]
    assert (found[:, :2] == 2).all()
    assert (found[:, 3:] == 1).all()
    assert (found[:, 2] == 0).all()


def test_offsets_move_their_pieces():
    z, pieces = two_pieces()
    pieces[..., 0, 0] = 0
    offsets = torch.tensor([[1.0, -2.0]]).double().requires_grad_()
    placed = place_pieces(z, pieces, offsets)
    expected = z + torch.where(pieces == 1, 1.0, torch.where(pieces == 2, -2.0, 0.0))
    torch.testing.assert_close(placed, expected)
    placed.sum().backward()
    assert offsets.grad.tolist() == [[float((pieces == k).sum()) for k in (1, 2)]]
    with pytest.raises(ValueError, match="offsets"):
        place_pieces(z, pieces, offsets[:, :1])


def goblet(n: int = 48) -> tuple[Tensor, Tensor, Tensor]:
    """The bowl hides the stem; of the foot, 40 pixels deeper and oblique, a crescent is seen: normals, mask, height."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    a, b = (x - 24) / 15, (y - 18) / 15
    bowl, foot = a**2 + b**2 < 0.995, (x - 24) ** 2 / 18**2 + (y - 33) ** 2 / 12**2 < 1
    up = (1 - a**2 - b**2).clamp(min=1e-3).sqrt()
    behind = torch.tensor([-1.5, 0.0, 1.0]).double().view(3, 1, 1) / 3.25**0.5
    height = torch.where(bowl, 40 + 15 * up, 1.5 * (x - 24))
    return torch.where(bowl, torch.stack([a, -b, up]), behind)[None], (bowl | foot)[None, None], height[None, None]


def hand(n: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    """A finger that points at the viewer, before a palm: it hides where it grows from."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    finger = (x > 9) & (x < 30) & (y > 9) & (y < 30)
    height = torch.where(finger, 60 + 0.8 * (x - 20) + 0.6 * (y - 20), 0.0)
    slopes = torch.stack([0.8 * finger.double(), 0.6 * finger.double()])[None]
    return gradient_to_normals(slopes), torch.ones(1, 1, n, n, dtype=torch.bool), height[None, None]


@pytest.mark.parametrize("scene", [goblet, hand])
def test_a_piece_without_a_tie_is_told_and_brought_to_its_place_by_an_anchor_an_offset_or_a_coarse_depth(scene):
    normals, mask, true = scene()
    field = normals_to_gradient(normals, mask=mask)
    method = Piecewise(noise=0.0)
    loose = method.solve(field.gradient, field.mask)
    sizes = [int((loose.pieces == k).sum()) for k in (1, 2)]
    assert min(sizes) > 50  # the body and what is behind it
    assert loose.tied[0, 0]
    assert not loose.tied[0, 1]

    def off(height: Tensor) -> float:
        apart = torch.where(mask, height - true, NAN)
        return float((apart - apart.nanmedian()).abs().nanmean())

    assert off(loose.height) > 5
    steps = [(true - loose.height)[loose.pieces == k].median() for k in range(1, int(loose.pieces.max()) + 1)]
    assert off(place_pieces(loose.height, loose.pieces, torch.stack(steps)[None])) < 1
    spots = torch.full_like(true, NAN)
    for k in (1, 2):
        inner = ((loose.pieces == k).double().flatten().cumsum(0) == sizes[k - 1] // 2).nonzero()[0]
        spots.view(-1)[inner] = true.view(-1)[inner]
    held = reconstruct(normals, mask, method=method, known=spots)
    assert off(held.height.nan_to_num()) < 1
    coarse = (
        0.1 * (true + 2 * torch.sin(torch.arange(float(true.shape[-1]))).double()) + 3
    )  # ten times too small, and wavy
    rough = reconstruct(normals, mask, method=method, coarse=coarse)
    assert off(rough.height.nan_to_num()) < 2.5


def test_a_known_point_or_median_gives_depth_its_unit():
    s = SURFACES["peaks"](24, dtype=torch.float64)
    k = torch.tensor([[200.0, 0, 12], [0, 200, 12], [0, 0, 1]]).double()
    log_depth = 0.01 * s.height
    n = gradient_to_normals(0.01 * s.gradient, camera=k)
    spot = torch.full_like(log_depth, NAN)
    spot[..., 5, 6] = 3.0
    found = reconstruct(n, camera=k, method="least_squares", known=spot).depth
    assert abs(float(found[..., 5, 6]) - 3.0) < 1e-6
    other = reconstruct(n, camera=k, method="least_squares", known=2.0).depth
    assert abs(float(other.median()) - 2.0) < 1e-6
    ratio = found / other
    assert float(ratio.max() / ratio.min()) - 1 < 1e-6
    with pytest.raises(ValueError, match="known"):
        reconstruct(n, camera=k, method="least_squares", known=-spot)


def test_a_method_by_name_learns_the_focal_length():
    s = SURFACES["sphere"](24, dtype=torch.float64)
    k = torch.tensor([[300.0, 0, 12], [0, 300, 12], [0, 0, 1]]).double()
    n = gradient_to_normals(s.gradient / 300, camera=k)
    named = reconstruct(n, camera=k, method="piecewise")
    made = reconstruct(n, camera=k, method=Piecewise(300.0))
    assert torch.equal(named.depth, made.depth)
    assert float(rmse(named.depth.log() * 300, s.height)) < 0.2
    with pytest.raises(ValueError, match="focal_length"):
        reconstruct(n, camera=k, method=Piecewise())
    several = torch.stack([k, k @ torch.diag(torch.tensor([2.0, 2.0, 1.0]).double())])
    with pytest.raises(ValueError, match="focal lengths 300 to 600"):
        reconstruct(n.expand(2, -1, -1, -1), camera=several, method="piecewise")
    assert math.isclose(float(named.depth.log().mean()), 0, abs_tol=1e-6)
