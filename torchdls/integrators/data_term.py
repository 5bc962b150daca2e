"""What an integrator asks of the slopes: its data term."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from torchdls.integrators.fields import Fields
from torchdls.noise import averaging_error
from torchdls.operators import GradientOperator, edge_slopes


class DataTerm(Protocol):
    """A data term bound to its fields, as a function of the height."""

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z."""

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes v and trusts w (N, 2, H, W) of a quadratic that touches the data term at z and is nowhere below it.

        The quadratic is 1/2 sum w (A . - v)^2, but for a constant.
        """


def edges_of(fields: Fields) -> tuple[Tensor, Tensor | None]:
    """Slopes v and trusts w on the edges of the grid; weights count beside what averaging itself errs by."""
    if fields.weight is None:
        return edge_slopes(fields.gradient, fields.mask)
    error = averaging_error(fields.gradient, fields.mask, fields.weight, fields.steps)
    return edge_slopes(fields.gradient, fields.mask, fields.weight, error=error)


def edge_cost(z: Tensor, v: Tensor, w: Tensor | None, steps: tuple[float, float]) -> Tensor:
    """(N,) 1/2 sum w (A z - v)^2."""
    misfit = (GradientOperator("forward", steps)(z) - v).square()
    return 0.5 * (misfit if w is None else w * misfit).sum((-3, -2, -1))
