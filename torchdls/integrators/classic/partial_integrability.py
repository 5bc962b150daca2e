"""Least squares without the edges around which the field is not integrable."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._checks import check_numbers, check_whole
from torchdls._precision import full_precision
from torchdls.integrators.base import Fields, IntegrationResult, Integrator
from torchdls.integrators.classic.curl_tree import CurlTree
from torchdls.operators import GradientOperator
from torchdls.operators.edges import cell_edges, complete_cells
from torchdls.solvers import SolveResult, solve


class PartialIntegrability(Integrator):
    r"""Projection on the fields that are integrable but for a few released edges.

        min over z, f   \sum_e w_e ((A z)_e + f_e - v_e)^2,     f_e = 0 but on the released edges

    which is least squares without those edges. The rule: around a cell of 2 x 2 pixels the slopes of a surface add up
    to 0; where the sum exceeds `threshold` times its noise (by the median of its magnitude), the edge of the cell that
    departs most from the surface of least squares is released. Edges of a spanning tree (of least curl) stay, so that
    no pixel loses its hold. Two solves.

    A lesson rather than a tool: it about halves the error from 2 % of wild slopes, and `L1` does better; and a jump of
    constant height has no curl along it and passes unseen, where `MEstimator` or `Bilateral` see it. Edges that you
    know to be wrong are released by weights of 0 in `torchdls.solve`.

    The derivative is that of the second solve: which edges are released is taken as fixed.

    Args:
        threshold: curl, in units of its own noise, above which a cell gives up an edge.
        solve_tol: relative residual of each solve.
        max_iter: limit of conjugate-gradient steps of each.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is not positive.

    Source: after Karacali, Snyder, "Reconstructing discontinuous surfaces from a given gradient field using partial
    integrability", Computer Vision and Image Understanding 92, 2003. The rule is ours: theirs is not confirmed.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spoilt = surface.gradient.clone()
        >>> spoilt[..., 10, 20] += 9.0  # one wild sample
        >>> methods = torchdls.LeastSquares(), torchdls.PartialIntegrability()
        >>> errors = [torchdls.rmse(method(spoilt), surface.height) for method in methods]
        >>> bool(errors[1] < 0.9 * errors[0])
        True
    """

    def __init__(
        self,
        threshold: float = 4.0,
        solve_tol: float = 1e-6,
        max_iter: int = 2000,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        check_numbers("PartialIntegrability", threshold=threshold, solve_tol=solve_tol)
        check_whole("PartialIntegrability", max_iter=max_iter)
        if not threshold > 0 or not solve_tol > 0 or not max_iter > 0:
            given = f"threshold={threshold!r}, solve_tol={solve_tol!r} and max_iter={max_iter!r}"
            raise ValueError(f"PartialIntegrability: {given} given, all must be positive")
        self.threshold, self.solve_tol, self.max_iter = threshold, solve_tol, max_iter

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        return self._report(fields).height

    def _report(self, fields: Fields) -> IntegrationResult:
        """The height, and how the second solve went."""
        graph = CurlTree.of(fields)
        found = self._solve(fields, graph.v, graph.w * ~self._released(fields, graph))
        return IntegrationResult(found.height, found.iterations, found.converged)

    @full_precision
    def released(self, gradient: Tensor, mask: Tensor | None = None, weight: Tensor | None = None) -> Tensor:
        """The edges that are released.

        Args:
            gradient: as in the call, and so for the mask and weight.
            mask: as in the call.
            weight: as in the call.

        Returns:
            (N, 2, H, W) bool; [:, 0, i, j] is the edge from pixel (i, j) to the right, [:, 1, i, j] the one down.

        Raises:
            TypeError: as the call.
            ValueError: as the call.
        """
        fields = self._check_fields(gradient, mask, weight)
        return self._released(fields, CurlTree.of(fields))

    def _released(self, fields: Fields, graph: CurlTree) -> Tensor:
        v, w = graph.v.detach(), graph.w.detach()
        z = self._solve(fields, v, w).height.detach()
        misfit = (GradientOperator("forward", fields.steps)(z) - v).abs()
        bad = complete_cells(w > 0) & (graph.curl.abs() > self.threshold * graph.noise)
        # Of two edges at a corner, which always depart alike, the tree holds one.
        around = cell_edges(torch.where(graph.tree, -1, misfit))
        worst = bad[:, None] & (around == around.amax(1, keepdim=True)) & (around >= 0)
        top, bottom, right, left = worst.unbind(1)
        along = F.pad(top, (0, 1, 0, 1)) | F.pad(bottom, (0, 1, 1, 0))
        return torch.stack([along, F.pad(right, (1, 0, 0, 1)) | F.pad(left, (0, 1, 0, 1))], 1)

    def _solve(self, fields: Fields, v: Tensor, w: Tensor) -> SolveResult:
        anchors = fields.anchor, fields.anchor_weight
        return solve(v, w, *anchors, tol=self.solve_tol, max_iter=self.max_iter, pixel_size=fields.steps)
