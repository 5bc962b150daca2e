"""Light directions from a mirror ball."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_real
from torchdls._precision import full_precision

_BRIGHTEST = 0.9  # pixels of at least this part of the brightest one are the highlight


@full_precision
def lights_from_ball(images: Tensor, ball: Tensor) -> Tensor:
    r"""Directions of distant lights from their highlights on a mirror ball, seen from afar.

    With the highlight at (x, y) from the centre of a ball of radius r (y up), the normal there is n = (x, y, sqrt(r^2 -
    x^2 - y^2)) / r, and a mirror sends the light from l to the viewer v = (0, 0, 1) where

        l = 2 (n . v) n - v

    The centre and radius are those of the disk of the ball's pixels (the middle of its extent; its area). The highlight
    is the mean place of its brightest pixels, those of at least nine tenths of the range above the median, weighted by
    their brightness.

    Args:
        images: (K, H, W), one for each light.
        ball: (1, H, W) or (H, W) bool, the pixels of the ball.

    Returns:
        (K, 3), of length 1: x right, y up, z to the viewer.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, the ball has fewer than 12 pixels, or an image shows no highlight on it.

    Source: Chrome-sphere calibration as usual in photometric stereo (Woodham 1980 on reflectance of a mirror).

    Example:
        >>> y, x = torch.meshgrid(torch.linspace(1, -1, 65), torch.linspace(-1, 1, 65), indexing="ij")
        >>> ball = x**2 + y**2 <= 1
        >>> spot = torch.exp(-((x - 0.5) ** 2 + y**2) / 0.005)  # to the right
        >>> torchdls.lights_from_ball(spot[None], ball).round(decimals=2)
        tensor([[0.8700, 0.0000, 0.5000]])
    """
    check_real("lights_from_ball", "images", images)
    check_alike("lights_from_ball", "ball", ball, torch.bool)
    if images.ndim != 3 or 0 in images.shape or ball.shape not in (images.shape[1:], (1, *images.shape[1:])):
        raise ValueError(
            f"lights_from_ball: images {tuple(images.shape)} and ball {tuple(ball.shape)} given, "
            "(K, H, W) and (1, H, W) are needed"
        )
    ball = ball.reshape(images.shape[1:])
    rows, columns = ball.nonzero(as_tuple=True)
    if len(rows) < 12:
        raise ValueError(f"lights_from_ball: ball {tuple(ball.shape)} has {len(rows)} pixels, at least 12 are needed")
    top, bottom, left, right = (t.to(images.dtype) for t in (rows.min(), rows.max(), columns.min(), columns.max()))
    centre = (top + bottom) / 2, (left + right) / 2
    radius = math.sqrt(len(rows) / math.pi)
    on_ball = images[:, rows, columns]
    base = on_ball.median(1, keepdim=True).values
    above = on_ball - base
    peak = above.amax(1, keepdim=True)
    if bool((peak <= 0).any()) or not bool(peak.isfinite().all()):
        which = int((~(peak[:, 0] > 0)).nonzero()[0, 0]) if bool((~(peak > 0)).any()) else 0
        raise ValueError(f"lights_from_ball: image {which} of {len(images)} shows no highlight on the ball")
    weight = torch.where(above >= _BRIGHTEST * peak, above, 0)
    weight = weight / weight.sum(1, keepdim=True)
    x = ((weight * columns).sum(1) - centre[1]) / radius
    y = (centre[0] - (weight * rows).sum(1)) / radius
    z = (1 - x.square() - y.square()).clamp(min=0).sqrt()
    length = (x.square() + y.square() + z.square()).sqrt()
    n = torch.stack([x, y, z], 1) / length[:, None]
    light = 2 * n[:, 2:] * n
    return light - light.new_tensor([0.0, 0.0, 1.0])
