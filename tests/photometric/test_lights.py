"""Lights from a mirror ball that is rendered by the law of reflection."""

import math

import pytest
import torch

from torchdls import lights_from_ball, ring_of_lights


def ball(light, n=121, radius=50.0, centre=(58.0, 63.0)):
    """The mirror image of a lamp of one degree or so."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    x, y = (x - centre[1]) / radius, (centre[0] - y) / radius
    inside = x.square() + y.square() <= 1
    z = (1 - x.square() - y.square()).clamp(min=0).sqrt()
    normal = torch.stack([x, y, z])
    mirrored = 2 * z * normal - torch.tensor([0, 0, 1.0]).double()[:, None, None]
    angle = torch.acos((mirrored * light[:, None, None]).sum(0).clamp(-1, 1))
    return torch.where(inside, torch.exp(-(angle / math.radians(4)).square()) + 0.1, 0.3), inside


@pytest.mark.parametrize("tilt", [5.0, 30.0, 60.0])
def test_directions_are_found_to_a_degree(tilt):
    lights = ring_of_lights(6, tilt, dtype=torch.float64)
    images = torch.stack([ball(light)[0] for light in lights])
    found = lights_from_ball(images, ball(lights[0])[1])
    torch.testing.assert_close(found.norm(dim=1), torch.ones(6).double())
    assert torch.rad2deg(torch.acos((found * lights).sum(1).clamp(max=1))).max() < 1.0


@pytest.mark.parametrize("images, mask, error, message", [
    (torch.ones(2, 20, 20), torch.ones(20, 20, dtype=torch.bool), ValueError, "image 0 of 2 shows no highlight"),
    (torch.ones(2, 20, 20), torch.zeros(20, 20, dtype=torch.bool), ValueError, "0 pixels"),
    (torch.ones(2, 20, 20), torch.ones(19, 20, dtype=torch.bool), ValueError, r"\(2, 20, 20\) and ball \(19, 20\)"),
    (torch.ones(2, 20, 20), torch.ones(20, 20), TypeError, "ball has dtype torch.float32"),
    (torch.ones(2, 20, 20).int(), torch.ones(20, 20, dtype=torch.bool), TypeError, "images"),
])  # fmt: skip
def test_bad_input_is_named(images, mask, error, message):
    with pytest.raises(error, match=message):
        lights_from_ball(images, mask)
