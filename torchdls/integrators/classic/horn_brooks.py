"""The plain iteration toward least squares."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from math import inf

import torch
from torch import Tensor

from torchdls._checks import check_numbers, check_whole
from torchdls._tracing import is_concrete, seen_everywhere
from torchdls.integrators.base import Fields, IntegrationResult, Integrator
from torchdls.integrators.data_term import edges_of
from torchdls.integrators.fields import normalize_fields
from torchdls.operators import GradientOperator
from torchdls.operators.edges import edge_ends
from torchdls.solvers import ConvergenceWarning
from torchdls.solvers.components import Gauge, free_constants
from torchdls.solvers.folding import choose_per_surface
from torchdls.solvers.units import plane_of


class HornBrooks(Integrator):
    r"""Least squares by relaxation: each pixel moves to the mean of what its neighbours say.

        z_i <- z_i + s ( (sum_e w_e (z_j +- v_e) + r_i a_i) / (sum_e w_e + r_i) - z_i )

    over the edges e = (i, j) at pixel i (with 1/dx^2 or 1/dy^2 in the weights). The pixels of the two colours of a
    checkerboard take turns: all at once, the iteration of the source never settles. It tends to the surface of
    `LeastSquares`, in O(N^2) iterations for N x N pixels with s = 1, and in O(N) with s near 2/(1 + sin(pi/2N)). A
    reference for teaching and tests: `LeastSquares` finds the same surface at once.

    The derivative is that of the iterations, and memory grows with them while gradients are recorded.

    Args:
        tol: relative residual of the normal equations, less planes and constants, at which a surface stops.
        max_iter: limit of iterations; a `ConvergenceWarning` says when it was reached.
        relaxation: s, in (0, 2).
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of its range.

    Source: Horn, Brooks, "The Variational Approach to Shape from Shading", Computer Vision, Graphics, and Image
    Processing 33, 1986; Durou, Courteille (2007) for the border.

    Example:
        >>> slopes = torch.ones(1, 2, 16, 16)  # of a plane
        >>> height = torchdls.HornBrooks(relaxation=1.8)(slopes)
        >>> round(float(height[0, 0, -1, -1] - height[0, 0, 0, 0]), 2)
        30.0
    """

    def __init__(
        self,
        tol: float = 1e-6,
        max_iter: int = 10_000,
        relaxation: float = 1.0,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        check_numbers("HornBrooks", tol=tol, relaxation=relaxation)
        check_whole("HornBrooks", max_iter=max_iter)
        if not tol > 0 or not max_iter > 0:
            raise ValueError(f"HornBrooks: tol={tol!r} and max_iter={max_iter!r} given, both must be positive")
        if not 0 < relaxation < 2:
            raise ValueError(f"HornBrooks: relaxation={relaxation!r} given, a number between 0 and 2 is needed")
        self.tol, self.max_iter, self.relaxation = tol, max_iter, relaxation

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        return self._report(fields).height

    def _report(self, fields: Fields) -> IntegrationResult:
        """The relaxation, and how many sweeps each surface took."""
        fields, unit = normalize_fields(fields)
        a = GradientOperator("forward", fields.steps)
        g = fields.gradient
        mask = torch.ones_like(g[:, :1], dtype=torch.bool) if fields.mask is None else fields.mask
        v, w = edges_of(fields._replace(mask=mask))
        assert w is not None
        r = w.new_zeros(w.shape[0], 1, 1, 1) if fields.anchor_weight is None else fields.anchor_weight
        held = r.detach().expand(len(w), 1, *w.shape[2:])
        gauge = Gauge(*choose_per_surface(_constants, w.detach(), held))
        # Planes and constants are what sweeps would take for ever to find.
        slope = torch.cat([gauge.mean(v[:, i : i + 1], w[:, i : i + 1]) for i in (0, 1)], 1)
        plane = plane_of(slope, (w.shape[-2], w.shape[-1]), fields.steps)
        b, level = a.adjoint(w * (v - slope)), gauge.remove(plane)
        if fields.anchor is not None:
            rest = fields.anchor - plane
            constant = gauge.constants(r * rest, r.expand_as(plane))
            b, level = b + r * (rest - constant), level + constant
        squares = torch.tensor(fields.steps, dtype=w.dtype, device=w.device).square().view(1, 2, 1, 1)
        diagonal = edge_ends(w / squares) + r
        step = self.relaxation / torch.where(diagonal > 0, diagonal, 1)
        i, j = (torch.arange(n, device=b.device) for n in b.shape[-2:])
        colour = (i[:, None] + j) % 2 == 0
        z = torch.where(2 * r > diagonal, b / torch.where(diagonal > 0, diagonal, 1), 0)  # firm anchors, met at once
        residual = b - a.adjoint(w * a(z)) - r * z  # from here on followed by moves: free of rounding in z
        goal = self.tol * residual.detach().flatten(1).norm(dim=1)
        active = torch.ones_like(goal, dtype=torch.bool)
        sweeps = torch.zeros_like(goal, dtype=torch.int64)
        for _ in range(self.max_iter):
            active = active & (residual.detach().flatten(1).norm(dim=1) > goal)
            if seen_everywhere(~active):
                break
            sweeps = sweeps + active
            for turn in (colour, ~colour):
                move = torch.where(active.view(-1, 1, 1, 1) & turn, step * residual, 0)
                z, residual = z + move, residual - a.adjoint(w * a(move)) - r * move
        else:
            if is_concrete(active):
                message = f"HornBrooks: {int(active.sum())} of {len(b)} surfaces above tol={self.tol:g}"
                warnings.warn(f"{message} after {self.max_iter} iterations", ConvergenceWarning, stacklevel=2)
        z = gauge.remove(z)
        z = z - gauge.constants(r * z, r.expand_as(z))  # 0 at the end, but for what its derivative knows of r
        return IntegrationResult((z + level) * unit.slope, sweeps, ~active)


def _constants(w: Tensor, r: Tensor) -> Gauge:
    """The gauge of every component, however firm its anchors: sweeps find no constant."""
    return free_constants(w, r, least=inf)
