"""What an integrator asks of the slopes: its data term."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from torch import Tensor

from torchdls.integrators.fields import Fields
from torchdls.noise import averaging_error
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.operators.edges import wrapped_edge_slopes
from torchdls.operators.modes import Boundary


class DataTerm(Protocol):
    """A data term bound to its fields, as a function of the height.

    A named tuple of tensors whose first dimension is the batch (or 1), so that surfaces can leave the batch.
    """

    @property
    def steady(self) -> bool:
        """Whether the majoriser is the data term itself: one quadratic, whatever the height."""

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z."""

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor | None]:
        """Slopes v and trusts w (N, 2, H, W) of a quadratic that touches the data term at z and is nowhere below it.

        The quadratic is 1/2 sum w (A . - v)^2, but for a constant; None stands for trusts of 1.
        """


def edges_of(fields: Fields) -> tuple[Tensor, Tensor | None]:
    """Slopes v and trusts w on the edges of the grid; weights count beside what averaging itself errs by."""
    if fields.on_edges:
        return fields.gradient, fields.weight
    if fields.boundary == "periodic":
        return wrapped_edge_slopes(fields.gradient), None
    if fields.weight is None:
        return edge_slopes(fields.gradient, fields.mask)
    error = averaging_error(fields.gradient, fields.mask, fields.weight, fields.steps)
    return edge_slopes(fields.gradient, fields.mask, fields.weight, error=error)


class Quadratic(NamedTuple):
    """1/2 sum w (A z - v)^2: the data term of least squares, and of all whose trusts do not depend on the height."""

    v: Tensor
    w: Tensor | None
    steps: tuple[float, float]
    boundary: Boundary = "neumann"

    @classmethod
    def of(cls, fields: Fields) -> Quadratic:
        """That of least squares: slopes and trusts of the edges."""
        return cls(*edges_of(fields), fields.steps, fields.boundary)

    @property
    def steady(self) -> bool:
        """Always."""
        return True

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z."""
        misfit = (GradientOperator("forward", self.steps, self.boundary)(z) - self.v).square()
        return 0.5 * (misfit if self.w is None else self.w * misfit).sum((-3, -2, -1))

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor | None]:
        """Itself."""
        return self.v, self.w


def anchored_cost(data: DataTerm, fields: Fields, z: Tensor) -> Tensor:
    """(N,) data term and anchors at z."""
    cost = data.cost(z)
    if fields.anchor is not None and fields.anchor_weight is not None:
        cost = cost + 0.5 * (fields.anchor_weight * (z - fields.anchor).square()).sum((-3, -2, -1))
    return cost
