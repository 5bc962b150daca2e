"""Integration along the path that a leading eigenvector shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls.integrators.base import Fields, IntegrationResult, Integrator
from torchdls.operators import edge_slopes
from torchdls.operators.edges import present_edges
from torchdls.solvers import solve
from torchdls.solvers.spanning_forest import spanning_forest


class SpectralPath(Integrator):
    r"""Trapezium rule along a tree that goes where the surface bends least.

        W_ij = exp(-mu k_ij^2),     k_ij^2 = 2 (1 - n_i . n_j) / d_ij^2     for neighbours i, j with normals n

    The leading eigenvector of W, by `n_iter` power steps of W + 1, is large where normals change little. From its
    largest entry the path goes on to the neighbour of largest entry, and where it is stuck, back to the best place that
    it left: a spanning tree. Heights add up along its edges by the trapezium rule.

    **For teaching**: half of the slopes are not used, so noise adds up as a random walk. Measured on 64 x 64 pixels of
    smooth relief at 20 dB, the error is 3.5 to 5 times that of `LeastSquares`, 1.5 to 2.5 times that of `LineIntegral`.
    The path goes around some wild slopes (2 %: .73 to .93 of `LeastSquares`), where `L1` does far better. The bend k
    depends on the steepness, so heights do not scale with the slopes.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean. The
    derivative is that of the sums along the tree, which is taken as fixed.

    Args:
        mu: how strongly bends are shunned, positive; in squared pixels.
        n_iter: power steps, at least 1.
        solve_tol: relative residual of the sums along the tree, which are found by the solve.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of its range.

    Source: after Robles-Kelly, Hancock, "A graph-spectral method for surface height recovery", Pattern Recognition
    38(8), 2005. Theirs has eight neighbours and another rule for going back (not confirmed); four here.

    Example:
        >>> slopes = torch.ones(1, 2, 16, 16)  # of a plane
        >>> height = torchdls.SpectralPath()(slopes)
        >>> round(float(height[0, 0, -1, -1] - height[0, 0, 0, 0]), 2)
        30.0
    """

    accepts = frozenset()

    def __init__(
        self,
        mu: float = 10.0,
        n_iter: int = 200,
        solve_tol: float = 1e-6,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        check_numbers("SpectralPath", mu=mu, solve_tol=solve_tol)
        if not 0 < mu < math.inf or not solve_tol > 0:
            raise ValueError(f"SpectralPath: mu={mu!r} and solve_tol={solve_tol!r} given, both must be positive")
        if not isinstance(n_iter, int) or n_iter < 1:
            raise ValueError(f"SpectralPath: n_iter={n_iter!r} given, an integer of at least 1 is needed")
        self.mu, self.n_iter, self.solve_tol = mu, n_iter, solve_tol

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        return self._report(fields).height

    def _report(self, fields: Fields) -> IntegrationResult:
        """The height, and how the sums along the tree were found."""
        v, _ = edge_slopes(fields.gradient)
        tree = _tree(self._leading(fields), present_edges(v) > 0).to(v.dtype)
        found = solve(v, tree, tol=self.solve_tol, max_iter=2000, pixel_size=fields.steps)
        return IntegrationResult(found.height, found.iterations, found.converged)

    def _leading(self, fields: Fields) -> Tensor:
        """(N, H, W), the leading eigenvector, in float64: its largest entry is 1."""
        g = fields.gradient.detach().double()
        n = torch.cat([-g, torch.ones_like(g[:, :1])], 1)
        n = n / n.norm(dim=1, keepdim=True)
        bends = [(n - n.roll(-1, dim)).square().sum(1) / d**2 for dim, d in zip((-1, -2), fields.steps, strict=True)]
        x, y = (torch.exp(-self.mu * torch.stack(bends, 1)) * present_edges(g)).unbind(1)
        e = torch.ones_like(x)
        for _ in range(self.n_iter):
            ahead = x * e.roll(-1, -1) + y * e.roll(-1, -2)
            e = e + ahead + (x * e).roll(1, -1) + (y * e).roll(1, -2)
            e = e / e.amax((-2, -1), keepdim=True)
        return e


def _tree(e: Tensor, live: Tensor) -> Tensor:
    """(N, 2, H, W) bool: from the largest entry on, always the edge to the largest entry that can be reached."""
    there = torch.stack([e.roll(-1, -1), e.roll(-1, -2)], 1)
    here = e[:, None].expand_as(there)
    return spanning_forest(-torch.minimum(here, there), -torch.maximum(here, there), live)
