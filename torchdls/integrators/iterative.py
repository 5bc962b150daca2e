"""The call that tells everything: what integrators share that iterate and have more to return than the height."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

from torchdls._precision import full_precision
from torchdls.integrators.base import Callback as Callback
from torchdls.integrators.base import Fields, Integrator


class HasHeight(Protocol):
    """A named tuple that holds a height, among other things."""

    @property
    def height(self) -> Tensor:
        """(N, 1, H, W)."""


Result = TypeVar("Result", bound=HasHeight)


class Iterative(Integrator, Generic[Result]):
    """An integrator that iterates; a subclass has `_iterate`, `_to_pixel_size` and says what its result holds."""

    @abstractmethod
    def _iterate(self, fields: Fields, callback: Callback | None = None) -> Result:
        """The result from checked fields, with heights in pixels."""

    @abstractmethod
    def _to_pixel_size(self, result: Result) -> Result:
        """The result with its heights, and what else has their unit, in the unit of `pixel_size`."""

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        return self._iterate(fields).height

    @full_precision
    def solve(
        self,
        gradient: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
        *,
        callback: Callback | None = None,
    ) -> Result:
        """Integrate as `forward` does, and tell everything that was found on the way.

        Args:
            gradient: see `forward`, and so for the mask, weight and anchors; a single field is a batch of one.
            mask: see `forward`.
            weight: see `forward`.
            anchor: see `forward`.
            anchor_weight: see `forward`.
            callback: called after each iteration as callback(iteration, cost (N,)), with iterations from 1 and the
                cost whose history the result holds.

        Returns:
            The named tuple of the method, always batched, such as `DLSResult` or `RobustResult`.

        Raises:
            TypeError: as `forward`.
            ValueError: as `forward`.
        """
        fields, level = self._levelled_fields(gradient, mask, weight, anchor, anchor_weight)
        found: Any = self._to_pixel_size(self._iterate(fields, callback))
        result: Result = found._replace(height=self._placed(found.height, level))
        return result
