"""Bilateral integration: every edge listens to the side whose surface it belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import DataTerm
from torchdls.integrators.robust.base import Estimate, Robust
from torchdls.integrators.robust.residuals import Terms


class BilateralTerm(NamedTuple):
    r"""1/2 \sum_i \sum_{x, y} t_i ( q_ahead r_ahead^2 + q_behind r_behind^2 ), one-sided residuals r in trusts q.

    Attributes:
        terms: the one-sided residuals.
        facing: (N, 1, 1, H, W), n^2: the squared cosine between the normal and the line of sight.
        sharpness: k of the rule, times the square of the focal length.
    """

    terms: Terms
    facing: Tensor
    sharpness: float

    def trust(self, z: Tensor) -> Tensor:
        """(N, 2, 2, H, W): n^2 times how much more the surface of z bends away on the other side of the pixel."""
        steps = self.facing * self.terms.difference(z).square()
        return self.facing * torch.sigmoid(self.sharpness * (steps.flip(1) - steps))

    @property
    def steady(self) -> bool:
        """Its quadratic follows the height."""
        return False

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z, with the trusts of z."""
        return self.terms.total(self.trust(z) * self.terms.trust * self.terms.residual(z).square())

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes and trusts of the quadratic with the trusts of z held; it does not bound the cost from above."""
        return self.terms.quadratic(2 * self.trust(z))


class Bilateral(Robust):
    r"""Bilateral normal integration: keeps jumps, by one-sided slopes that are weighed by the surface itself.

        z <- argmin  1/2 \sum_i \sum_{x, y} t_i ( q_a ((A z)_ahead - g_i)^2 + q_b ((A z)_behind - g_i)^2 ) + anchors
        q_a = n_i^2 sigmoid(k n_i^2 ((A z)_behind^2 - (A z)_ahead^2)),       q_b the other way round

    A pixel beside a jump sees a large difference on one side and a small one on the other; its slope then speaks of the
    side that is smooth. n_i = 1/sqrt(1 + |g_i|^2) is the cosine between the normal and the line of sight. The first
    trusts are q = n^2 / 2. Each iteration is one solve (*), with trusts that jump by many orders. The iteration is not
    convex, and its result depends on where it stops; where no pixel sees a jump it is close to least squares. Noise
    makes it shrink, since n^2 is larger where noise has flattened a slope.

    A gradient of log depth is multiplied by `focal_length` where it is compared, so that the rule means the same as for
    heights in pixels. The rule has a scale, one pixel: the method does not scale with the slopes.

    The derivative is that of the iterations run, trusts included.

    Args:
        k: sharpness of the rule, positive.
        focal_length: of the camera in pixels, where the gradient is that of log depth; 1 for heights.
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its cost by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: Cao, Santo, Shi, Okura, Matsushita, "Bilateral normal integration", ECCV 2022.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> height = torchdls.Bilateral()(surface.gradient)
        >>> round(float(torchdls.rmse(height, surface.height)), 2)
        0.02
    """

    _slopes = ("k",)

    def __init__(
        self,
        k: float = 2.0,
        focal_length: float = 1.0,
        n_iter: int = 50,
        tol: float = 1e-4,
        *,
        solve_tol: float = 1e-6,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(n_iter=n_iter, tol=tol, solve_tol=solve_tol, pixel_size=pixel_size)
        check_numbers("Bilateral", k=k, focal_length=focal_length)
        if not 0 < k < float("inf") or not 0 < focal_length < float("inf"):
            raise ValueError(f"Bilateral: k={k!r} and focal_length={focal_length!r} given, both must be positive")
        self.k, self.focal_length = k, focal_length

    def _data_term(self, fields: Fields) -> BilateralTerm:
        """The one-sided residuals, and how each pixel faces the viewer."""
        terms = Terms.of(fields, joint=False)
        slope = (self.focal_length * fields.gradient).square().sum(1, keepdim=True)[:, None]
        return BilateralTerm(terms, 1 / (1 + slope), self.k * self.focal_length**2)

    def _begin(self, fields: Fields, data: DataTerm) -> Estimate:
        """The surface of equal trust in both sides."""
        assert isinstance(data, BilateralTerm)
        v, w = data.terms.quadratic(data.facing.expand_as(data.terms.live))
        return (self._surface(fields, v, w, fields.anchor_weight),)
