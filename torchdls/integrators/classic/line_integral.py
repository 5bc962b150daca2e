"""Averaged line integrals."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from torchdls.integrators.base import Fields, Integrator
from torchdls.operators import edge_slopes


class LineIntegral(Integrator):
    r"""Line integrals of the slopes, averaged over paths and starting points.

    From every pixel two paths with one corner lead to a pixel (i, j): along the row first, or along the column first.
    With X and Y the running sums of the edge slopes along rows and columns, the average over all starting pixels is

        row first:     Y[i, j] - mean_r Y[r, j] + mean_r X[r, j]
        column first:  X[i, j] - mean_c X[i, c] + mean_c Y[i, c]

    and the height is the mean of the two, less its mean. No equation is solved and no pixel is preferred, but errors
    add up along the paths: noise leaves stripes that least squares does not have. For teaching and tests.

    Paths cross the whole rectangle: takes no mask, weights or anchors.

    Args:
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: `pixel_size` is not positive.

    Source: after Wu, Li, "A Line-Integration Based Method for Depth Recovery from Surface Normals", Computer Vision,
    Graphics, and Image Processing 43, 1988.

    Example:
        >>> slopes = torch.ones(1, 2, 16, 16)  # of a plane
        >>> height = torchdls.LineIntegral()(slopes)
        >>> round(float(height[0, 0, -1, -1] - height[0, 0, 0, 0]), 2)
        30.0
    """

    accepts = frozenset()

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        vx, vy = edge_slopes(fields.gradient)[0].split(1, -3)
        dx, dy = fields.steps
        x = dx * F.pad(vx[..., :, :-1].cumsum(-1), (1, 0))
        y = dy * F.pad(vy[..., :-1, :].cumsum(-2), (0, 0, 1, 0))
        row_first = y + (x - y).mean(-2, keepdim=True)
        column_first = x + (y - x).mean(-1, keepdim=True)
        z = (row_first + column_first) / 2
        return z - z.mean((-2, -1), keepdim=True)
