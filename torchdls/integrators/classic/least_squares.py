"""Least squares: the solve (*) itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from torch import Tensor

from torchdls._checks import check_numbers, check_whole
from torchdls.integrators.base import Fields, IntegrationResult, Integrator
from torchdls.integrators.classic.dirichlet import solve_dirichlet
from torchdls.integrators.data_term import Quadratic
from torchdls.solvers import SolveResult, direct_result, integrate_direct, solve
from torchdls.solvers.periodic import solve_periodic


class LeastSquares(Integrator):
    r"""Least-squares integration, weighted, masked and anchored.

        z = argmin  1/2 \sum_e w_e ((A z)_e - v_e)^2 + 1/2 \sum_i r_i (z_i - a_i)^2

    On a full rectangle with equal weights this is one direct solve by cosine transforms; otherwise conjugate gradients,
    preconditioned by it.

    With `boundary="dirichlet"` the heights of the border (the pixels with a neighbour outside the mask or the image)
    are known: they are those of the anchor, exactly and whatever its weight, and 0 where there is none. On a full
    rectangle with equal weights this is one direct solve by sine transforms.

    With `boundary="periodic"` the surface repeats, as a texture that is tiled: the last column is beside the first, the
    last row above the first, and the height meets itself there without a seam. A mean slope, which no such surface has,
    is dropped. One direct solve by Fourier transforms; takes no mask and no weight, and one anchor weight per surface.

    Args:
        tol: relative residual at which a surface stops.
        max_iter: limit of conjugate-gradient steps; a `ConvergenceWarning` says when it was reached.
        boundary: "neumann" (free), "dirichlet" (known heights) or "periodic" (tileable).
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: `tol`, `max_iter` or `pixel_size` is not positive, or `boundary` is unknown.

    Source: Simchony, Chellappa, Shao (1990); Durou, Courteille (2007); Horovitz, Kiryati (2004) for the anchors.

    Example:
        >>> torchdls.LeastSquares()(torch.ones(1, 2, 2, 3)).round(decimals=3)[0]  # a plane
        tensor([[[-1.5000, -0.5000,  0.5000],
                 [-0.5000,  0.5000,  1.5000]]])
        >>> mask = torch.tensor([[True, True, False, True]]).expand(1, 1, 1, 4)
        >>> torchdls.LeastSquares()(torch.ones(1, 2, 1, 4), mask).round(decimals=3)  # mean 0 on each part
        tensor([[[[-0.5000,  0.5000,  0.0000,  0.0000]]]])
    """

    _steady: bool | None = True

    def __init__(
        self,
        tol: float = 1e-6,
        max_iter: int = 500,
        boundary: Literal["neumann", "dirichlet", "periodic"] = "neumann",
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        check_numbers(type(self).__name__, tol=tol)
        check_whole(type(self).__name__, max_iter=max_iter)
        if not tol > 0 or not max_iter > 0:
            raise ValueError(f"LeastSquares: tol={tol!r} and max_iter={max_iter!r} given, both must be positive")
        known = ("neumann", "dirichlet", "periodic")
        if boundary not in known:
            raise ValueError(
                f"LeastSquares: boundary={boundary!r} is unknown; choose from {', '.join(map(repr, known))}"
            )
        self.tol = tol
        self.max_iter = max_iter
        self.boundary = boundary
        if boundary == "periodic":
            self.accepts = frozenset({"anchor"})
        self._steady = None if boundary == "dirichlet" else True  # the quadratic does not hold a border
        self._reads_edges = boundary == "neumann"
        self._follows_offsets = boundary != "dirichlet"  # a border without anchors stays at 0

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        if self._is_direct(fields):
            return integrate_direct(fields.gradient, fields.steps)
        return self._solve_fields(fields).height

    def _report(self, fields: Fields) -> IntegrationResult:
        """The height, and how the solve went."""
        found = self._solve_fields(fields)
        return IntegrationResult(found.height, found.iterations, found.converged)

    def _data_term(self, fields: Fields) -> Quadratic:
        """The slopes and trusts of the edges."""
        return Quadratic.of(fields)

    def _is_direct(self, fields: Fields) -> bool:
        """Whether it is a full rectangle with equal trust and free borders."""
        bare = fields.mask is None and fields.weight is None and fields.anchor is None
        return bare and not fields.on_edges and self.boundary == "neumann"

    def _solve_fields(self, fields: Fields, z0: Tensor | None = None) -> SolveResult:
        """The solve and how it went, from a warm start z0."""
        if self._is_direct(fields):
            return direct_result(integrate_direct(fields.gradient, fields.steps))
        if self.boundary == "dirichlet":
            return solve_dirichlet(fields, tol=self.tol, max_iter=self.max_iter, z0=z0)
        if self.boundary == "periodic":
            v = self._data_term(fields).v
            return direct_result(solve_periodic(v, fields.anchor, fields.anchor_weight, fields.steps))
        v, w, *_ = self._data_term(fields)
        return solve(
            v,
            w,
            fields.anchor,
            fields.anchor_weight,
            tol=self.tol,
            max_iter=self.max_iter,
            z0=z0,
            pixel_size=fields.steps,
        )
