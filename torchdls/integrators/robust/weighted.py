"""Least squares weighted by how far the field is from integrable."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls.integrators.base import Fields
from torchdls.integrators.classic.least_squares import LeastSquares
from torchdls.integrators.data_term import Quadratic
from torchdls.integrators.fields import normalize_fields
from torchdls.integrators.robust.residuals import least_slope
from torchdls.operators.edges import beside_edges, cell_curl, complete_cells, present_edges
from torchdls.solvers import SolveResult, solve


class WeightedLeastSquares(LeastSquares):
    r"""Least squares that distrusts edges around which the field is not integrable.

        z = argmin  1/2 \sum_e q_e w_e ((A z)_e - v_e)^2 + 1/2 \sum_i r_i (z_i - a_i)^2,
        q_e = 1 / (1 + (c_e / kappa)^2)^2 + floor

    The slopes of a surface sum to zero around every cell of 2 x 2 pixels; this sum is the curl of the cell. c_e^2 is
    the mean of the squared curls of the two cells beside an edge, kappa `threshold` times the robust scale of the curl
    (a median). The trusts are fixed beforehand, so there is one solve and nothing to iterate; w are the trusts of
    `LeastSquares`.

    The derivative is that of the solve and of the trusts, in the gradient, weights and anchors.

    Args:
        threshold: curl, in units of its own noise, at which an edge keeps a quarter of its trust.
        floor: trust that every edge keeps, positive.
        tol: relative residual at which a surface stops.
        max_iter: limit of conjugate-gradient steps; a `ConvergenceWarning` says when it was reached.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is not positive.

    Source: after Queau, Durou, "Edge-preserving integration of a normal field: weighted least squares, TV and L1
    approaches", SSVM 2015; the curl as the sign of a bad slope: Agrawal, Chellappa, Raskar, ICCV 2005.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spoilt = surface.gradient.clone()
        >>> spoilt[..., 10, 20] += 9.0  # one wild sample
        >>> methods = torchdls.LeastSquares(), torchdls.WeightedLeastSquares()
        >>> [round(float(torchdls.rmse(method(spoilt), surface.height)), 2) for method in methods]
        [0.24, 0.05]
    """

    def __init__(
        self,
        threshold: float = 3.0,
        floor: float = 0.03,
        tol: float = 1e-6,
        max_iter: int = 2000,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(tol=tol, max_iter=max_iter, pixel_size=pixel_size)
        check_numbers("WeightedLeastSquares", threshold=threshold, floor=floor)
        if not 0 < threshold < float("inf") or not 0 < floor < float("inf"):
            raise ValueError(f"WeightedLeastSquares: threshold={threshold!r} and floor={floor!r} must be positive")
        self.threshold, self.floor = threshold, floor

    def _is_direct(self, fields: Fields) -> bool:
        """Never: trust is not equal."""
        return False

    def _solve_fields(self, fields: Fields, z0: Tensor | None = None) -> SolveResult:
        """The solve and how it went, from a warm start z0."""
        v, w, *_ = self._data_term(fields)
        anchors = fields.anchor, fields.anchor_weight
        return solve(v, w, *anchors, tol=self.tol, max_iter=self.max_iter, z0=z0, pixel_size=fields.steps)

    def _data_term(self, fields: Fields) -> Quadratic:
        """Slopes v and trusts q w; they do not depend on the height."""
        v, w, steps, _ = super()._data_term(fields)
        w = present_edges(v) if w is None else w
        return Quadratic(v, w * self._trust(fields), steps)

    def _trust(self, fields: Fields) -> Tensor:
        """(N, 2, H, W), q."""
        fields, _ = normalize_fields(fields)  # on which q does not depend
        g = fields.gradient
        valid = torch.ones_like(g, dtype=torch.bool) if fields.weight is None else (fields.weight > 0).expand_as(g)
        valid = valid if fields.mask is None else valid & fields.mask
        v, w, *_ = super()._data_term(fields)
        curl, cells = cell_curl(v, fields.steps), complete_cells((present_edges(v) if w is None else w) > 0)
        noise = masked_median(curl.abs().flatten(1), cells.flatten(1)) / NORMAL_MEDIAN
        kappa = self.threshold * torch.maximum(noise, least_slope(g, valid))
        badness = torch.where(cells, (curl / kappa[:, None, None]).square(), 0)
        number = beside_edges(cells.to(curl.dtype)).clamp(min=1)
        return (1 + beside_edges(badness) / number).square().reciprocal() + self.floor
