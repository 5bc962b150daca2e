"""The call that all integrators share: what comes in is checked once, here, and reaches the method as a clean batch."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchdls._checks import check_field
from torchdls._options import plain, same, shown
from torchdls._precision import full_precision
from torchdls._tracing import all_finite
from torchdls.integrators.data_term import DataTerm
from torchdls.integrators.fields import Fields as Fields
from torchdls.integrators.fields import (
    check_accepted,
    check_values,
    edge_fields,
    fit_fields,
    level_anchors,
    on_torus,
    within_mask,
)
from torchdls.operators import as_pixel_size

Callback = Callable[[int, Tensor], None]


class IntegrationResult(NamedTuple):
    """What `solve` returns at least; always batched.

    Attributes:
        height: (N, 1, H, W).
        iterations: (N,) the iterations each surface took; 0 for direct methods.
        converged: (N,) bool, whether it met the method's tolerance within them.

    Example:
        >>> result = torchdls.FrankotChellappa().solve(torch.ones(2, 2, 8, 8))
        >>> result.height.shape, result.iterations.tolist(), result.converged.tolist()
        (torch.Size([2, 1, 8, 8]), [0, 0], [True, True])
    """

    height: Tensor
    iterations: Tensor
    converged: Tensor


class Integrator(nn.Module, ABC):
    """A method that turns gradients into heights.

    A new method is one short class with `_integrate`. If it is built on the solve (*), it also gives its data term
    (`_data_term`) and says whether that is one quadratic (`_steady`), and so serves as `data_term` of DLS.

    A method that cannot honour a mask, weights or anchors leaves them out of `accepts`; a call that brings one then
    raises a ValueError, rather than a surface that ignores it.

    Args:
        pixel_size: spacing of the columns and the rows (dx, dy), or one number for both; heights come out in its unit.

    Example:
        >>> class Flat(torchdls.Integrator):  # whatever the slopes are
        ...     def _integrate(self, fields):
        ...         return torch.zeros_like(fields.gradient[:, :1])
        >>> Flat()(torch.ones(1, 2, 4, 5)).shape
        torch.Size([1, 1, 4, 5])
    """

    # Which of the optional arguments of `forward` the method honours.
    accepts: frozenset[str] = frozenset({"mask", "weight", "anchor"})

    # Of methods built on the solve (*), whether their data term is one quadratic, whatever the height; None for others,
    # which have no data term.
    _steady: bool | None = None

    # Whether the method sees the slopes only on the edges of the grid, so that they can be given there (`from_edges`).
    _reads_edges: bool = False

    # Whether a constant on all anchors of a component is a constant on its heights, and nothing more.
    _follows_offsets: bool = True

    def __init__(self, *, pixel_size: float | Sequence[float] = 1.0) -> None:
        super().__init__()
        self.pixel_size = as_pixel_size(pixel_size)

    @full_precision
    def forward(
        self,
        gradient: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
    ) -> Tensor:
        """Integrate a batch of gradient fields, or a single one without its batch dimension.

        Args:
            gradient: (N, 2, H, W) or (2, H, W), float32 or float64: dz/dx to the right, dz/dy down.
            mask: (N, 1, H, W) bool, True where the gradient is valid. What lies outside is never read, NaN included.
            weight: (N, 1, H, W) or (N, 2, H, W), at least 0: trust in each slope, for instance 1 / variance.
            anchor: (N, 1, H, W) known heights, read only where `anchor_weight` > 0.
            anchor_weight: (N, 1, H, W), or one number, at least 0: trust in the anchor heights.

        Returns:
            Height (N, 1, H, W), or (1, H, W) for a single field: zero mean over each connected component of the mask
            that has no anchor, 0 outside the mask. A mask, weight or anchor with N = 1 serves the whole batch.

        Raises:
            TypeError: an argument is not a tensor, or the mask is not bool.
            ValueError: a shape, dtype or device does not fit, a value inside the mask is not finite, a weight is
                negative, a mask is all False, an anchor comes without its weight, the method does not take one of them
                (see `accepts`), or the height is beyond what its dtype can hold. The message names the argument and
                the shapes.
        """
        fields, level = self._levelled_fields(gradient, mask, weight, anchor, anchor_weight)
        height = self._integrate(fields)
        height = self._placed(height if self._unit == 1 else height * self._unit, level)
        return height if gradient.ndim == 4 else height[0]

    @full_precision
    def from_edges(
        self,
        slopes: Tensor,
        trust: Tensor | None = None,
        mask: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
    ) -> Tensor:
        r"""Integrate slopes that are known between the pixels rather than at them.

            min  1/2 \sum_e w_e ((A z)_e - v_e)^2 + ...   or the method's own data term, once per edge

        For sensors and methods that measure differences of heights, and to release single edges (w_e = 0), for
        instance along a known jump. Edges without trust are never read, NaN included.

        Args:
            slopes: v, (N, 2, H, W) or (2, H, W): [:, 0, i, j] between the columns j and j + 1 (the last column is not
                read), [:, 1, i, j] between the rows i and i + 1 (the last row is not read), as `edge_slopes` gives.
            trust: w, (N, 2, H, W) or (N, 1, H, W), at least 0: inverse variances; None for equal trust.
            mask: (N, 1, H, W) bool; edges with an end outside are not there.
            anchor: see `forward`.
            anchor_weight: see `forward`.

        Returns:
            Height as of `forward`; zero mean over each part that trusted edges connect and no anchor holds.

        Raises:
            TypeError: as `forward`.
            ValueError: as `forward`, or the method reads slopes at pixels.

        Example:
            >>> v, w = torchdls.edge_slopes(torch.ones(1, 2, 1, 4), torch.ones(1, 1, 1, 4, dtype=torch.bool))
            >>> w[..., 0, 0, 1] = 0  # released: two parts
            >>> torchdls.LeastSquares().from_edges(v, w).round(decimals=3)
            tensor([[[[-0.5000,  0.5000, -0.5000,  0.5000]]]])
        """
        fields, level = level_anchors(self._check_edges(slopes, trust, mask, anchor, anchor_weight))
        height = self._placed(self._integrate(self._in_pixels(fields)) * self._unit, level)
        return height if slopes.ndim == 4 else height[0]

    if TYPE_CHECKING:  # the call of `nn.Module` gives Any

        def __call__(
            self,
            gradient: Tensor,
            mask: Tensor | None = None,
            weight: Tensor | None = None,
            anchor: Tensor | None = None,
            anchor_weight: Tensor | float | None = None,
        ) -> Tensor:
            """As `forward`."""

    def options(self) -> dict[str, Any]:
        """The arguments of the constructor as plain data, with which `torchdls.build` makes the integrator again.

        Returns:
            Numbers, words, None and tuples; of a part such as a learner or a data term {"name": ..., option: value};
            of a tensor, whose values live in the `state_dict`, the mark {"tensor": shape, "dtype": ..., "kind": ...}.

        Raises:
            TypeError: an option has no form as plain data, such as a learner that is no registered class.
        """
        return {name: plain(value) for name, value in self._arguments().items()}

    def _arguments(self) -> dict[str, Any]:
        """The arguments of the constructor: each is kept as the attribute of its name."""
        return {name: getattr(self, name) for name in inspect.signature(_class_of(self)).parameters}

    def __repr__(self) -> str:
        """The call that makes it: every option that differs from its default."""
        kind, arguments = _class_of(self), self._arguments()
        parameters = inspect.signature(kind).parameters.items()
        needed = {name: arguments[name] for name, p in parameters if p.default is p.empty}
        defaults = kind(**needed)._arguments()
        told = [n for n, value in arguments.items() if n in needed or not same(value, defaults[n])]
        return f"{kind.__name__}({', '.join(f'{name}={shown(arguments[name])}' for name in told)})"

    @abstractmethod
    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels from checked fields; what a subclass provides."""

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
    ) -> Any:
        """Integrate as `forward` does, and tell how it went.

        Args:
            gradient: see `forward`, and so for the mask, weight and anchors; a single field is a batch of one.
            mask: see `forward`.
            weight: see `forward`.
            anchor: see `forward`.
            anchor_weight: see `forward`.
            callback: called after each iteration as callback(iteration, cost (N,)), with iterations from 1, by methods
                whose result holds the history of a cost.

        Returns:
            A named tuple, always batched, with at least `height`, `iterations` and `converged`, as `IntegrationResult`.

        Raises:
            TypeError: as `forward`.
            ValueError: as `forward`.
        """
        fields, level = self._levelled_fields(gradient, mask, weight, anchor, anchor_weight)
        result = self._report(fields)
        return result._replace(height=self._placed(result.height * self._unit, level))

    def _report(self, fields: Fields) -> IntegrationResult:
        """The height in pixels from checked fields, and how it went; a method that iterates says so."""
        height = self._integrate(fields)
        iterations = torch.zeros(len(height), dtype=torch.int64, device=height.device)
        return IntegrationResult(height, iterations, iterations == 0)

    def _data_term(self, fields: Fields) -> DataTerm:
        """The data term of checked fields; what methods built on the solve (*) provide."""
        raise TypeError(f"{type(self).__name__} has no data term: it is not built on the solve")

    def _placed(self, height: Tensor, level: Tensor | None) -> Tensor:
        """The height in the unit of `pixel_size` with its level, if the numbers of its dtype reach so far."""
        return self._finite(height if level is None else height + level)

    def _finite(self, height: Tensor) -> Tensor:
        """The height, if the numbers of its dtype reach so far."""
        if all_finite(height):
            return height
        raise ValueError(
            f"{type(self).__name__}: the height is not finite: slopes, weights or anchors are beyond {height.dtype}"
        )

    @property
    def _unit(self) -> float:
        """Side h = sqrt(dx dy) of a square pixel of the same area: the height that is 1 inside the solvers."""
        return sqrt(self.pixel_size[0] * self.pixel_size[1])

    def _check_edges(
        self,
        slopes: Tensor,
        trust: Tensor | None,
        mask: Tensor | None,
        anchor: Tensor | None,
        anchor_weight: Tensor | float | None,
    ) -> Fields:
        """The arguments of `from_edges` as one batch, found to fit, in the unit of `pixel_size`."""
        name = type(self).__name__
        if not self._reads_edges:
            raise ValueError(f"{name}: takes no slopes on edges; LeastSquares, L1, Huber, MEstimator and DLS do")
        check_accepted(name, self.accepts, False, mask=mask, anchor=anchor, anchor_weight=anchor_weight)
        check_field(name, "slopes", slopes, 2)
        checked = within_mask(name, fit_fields(name, torch.zeros_like(slopes), mask, None, anchor, anchor_weight))
        check_values(name, checked)
        return edge_fields(name, slopes, trust, checked)

    def _check_fields(
        self,
        gradient: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
    ) -> Fields:
        """Validate the arguments of `forward` and bring them to the form of `Fields`; never writes to them."""
        return self._in_pixels(self._checked(gradient, mask, weight, anchor, anchor_weight))

    def _levelled_fields(
        self,
        gradient: Tensor,
        mask: Tensor | None,
        weight: Tensor | None,
        anchor: Tensor | None,
        anchor_weight: Tensor | float | None,
    ) -> tuple[Fields, Tensor | None]:
        """The same with the mean anchor of each component taken off, and this level in the unit of `pixel_size`.

        No method sees how far from 0 its anchors lie, so that none rounds its heights by that; see `level_anchors`.
        """
        fields = self._checked(gradient, mask, weight, anchor, anchor_weight)
        fields, level = level_anchors(fields) if self._follows_offsets else (fields, None)
        return self._in_pixels(fields), level

    def _checked(
        self,
        gradient: Tensor,
        mask: Tensor | None,
        weight: Tensor | None,
        anchor: Tensor | None,
        anchor_weight: Tensor | float | None,
    ) -> Fields:
        """The arguments of `forward` as one batch, found to fit, in the unit of `pixel_size`."""
        name = type(self).__name__
        torus = self._on_torus
        if mask is weight is anchor is anchor_weight is None:
            check_field(name, "gradient", gradient, 2)
            fields = Fields(gradient if gradient.ndim == 4 else gradient[None], None, None, None, None, (1.0, 1.0))
            check_values(name, fields)
            return on_torus(name, fields) if torus else fields
        check_accepted(name, self.accepts, torus, mask=mask, weight=weight, anchor=anchor, anchor_weight=anchor_weight)
        check_field(name, "gradient", gradient, 2)
        fields = within_mask(name, fit_fields(name, gradient, mask, weight, anchor, anchor_weight))
        check_values(name, fields)
        return on_torus(name, fields) if torus else fields

    @property
    def _on_torus(self) -> bool:
        """Whether the surface repeats: an option of few methods."""
        return getattr(self, "boundary", None) == "periodic"

    def _in_pixels(self, fields: Fields) -> Fields:
        """The fields for heights in units of one pixel."""
        h = self._unit
        return fields._replace(
            anchor=None if fields.anchor is None else fields.anchor / h,
            anchor_weight=None if fields.anchor_weight is None else fields.anchor_weight * h**2,
            steps=(self.pixel_size[0] / h, self.pixel_size[1] / h),
        )


def _class_of(module: Integrator) -> type[Integrator]:
    """The class of a module, whatever parametrisations it has been given since."""
    kind: type[Integrator] = parametrize.type_before_parametrizations(module)
    return kind
