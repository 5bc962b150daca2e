"""The call that all integrators share: what comes in is checked once, here, and reaches the method as a clean batch."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchdls._tape import bool_all, visible
from torchdls.operators import GradientOperator, as_pixel_size, edge_slopes


class Fields(NamedTuple):
    """The checked input of an integrator: batched, finite, zero outside the mask, and in units of one pixel.

    With h = sqrt(dx dy), heights are divided by h and anchor weights multiplied by h^2. Slopes have no unit and stay.

    Attributes:
        gradient: (N, 2, H, W).
        mask: (N, 1, H, W) bool, or None for full rectangles.
        weight: (N, 1 or 2, H, W), or None for equal trust.
        anchor: (N, 1, H, W), or None.
        anchor_weight: (N, 1, H, W), or (N, 1, 1, 1) for one number per surface, or None.
        steps: (dx / h, dy / h), the sides of a pixel of unit area.
    """

    gradient: Tensor
    mask: Tensor | None
    weight: Tensor | None
    anchor: Tensor | None
    anchor_weight: Tensor | None
    steps: tuple[float, float]


class Integrator(nn.Module):
    """A method that turns gradients into heights.

    A new method is one short class with `integrate`. If it is an outer loop around the solve (*), it also says how
    its data term looks as a quadratic around a height (`edges`) and what it costs (`data_cost`), and so serves as
    `data_term` of DLS.

    A method that cannot honour a mask, weights or anchors leaves them out of `accepts`; a call that brings one then
    raises a ValueError, rather than a surface that ignores it.

    Args:
        pixel_size: spacing of the columns and the rows (dx, dy), or one number for both; heights come out in its unit.
    """

    # Which of the optional arguments of `forward` the method honours.
    accepts: frozenset[str] = frozenset({"mask", "weight", "anchor"})

    # Whether the method is built on the solve (*), so that `edges` and `data_cost` describe it and it can serve as a
    # data term.
    quadratic: bool = False

    def __init__(self, *, pixel_size: float | Sequence[float] = 1.0) -> None:
        super().__init__()
        self.pixel_size = as_pixel_size(pixel_size)

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
            negative,
                a mask is all False, an anchor comes without its weight, or the method does not take one of them (see
                `accepts`). The message names the argument and the shapes.
        """
        fields = self.check(gradient, mask, weight, anchor, anchor_weight)
        height = self.integrate(fields)
        height = height if self.unit == 1 else height * self.unit
        return height if gradient.ndim == 4 else height[0]

    def integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels from checked fields; what a subclass provides."""
        raise TypeError(f"{type(self).__name__}: an integrator must define integrate(fields)")

    def edges(self, fields: Fields, z: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Slopes v and trusts w of the quadratic 1/2 sum w (A z - v)^2 that stands for the data term around z."""
        return edge_slopes(fields.gradient, fields.mask, fields.weight)

    def data_cost(self, fields: Fields, z: Tensor) -> Tensor:
        """(N,) the data term at z."""
        return edge_cost(z, *self.edges(fields), fields.steps)

    @property
    def unit(self) -> float:
        """Side h = sqrt(dx dy) of a square pixel of the same area: the height that is 1 inside the solvers."""
        return sqrt(self.pixel_size[0] * self.pixel_size[1])

    def check(
        self,
        gradient: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
    ) -> Fields:
        """Validate the arguments of `forward` and bring them to the form of `Fields`; never writes to them."""
        name = type(self).__name__
        for label, field in (("mask", mask), ("weight", weight), ("anchor", anchor), ("anchor", anchor_weight)):
            _require(field is None or label in self.accepts, f"{name}: takes no {label}; LeastSquares and DLS do")
        _check_gradient(name, gradient)
        mask = _fit(name, "mask", mask, gradient, channels=(1,), dtype=torch.bool)
        weight = _fit(name, "weight", weight, gradient, channels=(1, 2))
        anchor = _fit(name, "anchor", anchor, gradient, channels=(1,))
        if isinstance(anchor_weight, int | float):
            anchor_weight = gradient.new_full((1, 1, 1, 1)[4 - gradient.ndim :], float(anchor_weight))
        trust = _fit(name, "anchor_weight", anchor_weight, gradient, channels=(1,), scalar=True)
        if (anchor is None) != (trust is None):
            given, missing = ("anchor", "anchor_weight") if trust is None else ("anchor_weight", "anchor")
            raise ValueError(f"{name}: {given} is given without {missing}; they come together")
        gradient = gradient if gradient.ndim == 4 else gradient[None]
        if mask is not None:
            _require(
                bool_all(mask.flatten(1).any(1)), f"{name}: mask {tuple(mask.shape)} is False everywhere on a surface"
            )
            gradient = torch.where(mask, gradient, 0)
            weight = None if weight is None else torch.where(mask, weight, 0)
            trust = None if trust is None else torch.where(mask, trust, 0)
        if anchor is not None and trust is not None:
            anchor = torch.where(trust > 0, anchor, 0)
        inside = " inside the mask" if mask is not None else ""
        for label, field in (("gradient", gradient), ("weight", weight), ("anchor", anchor), ("anchor_weight", trust)):
            if field is not None:
                _require(_all_finite(field), f"{name}: {label} {tuple(field.shape)} is not finite{inside}")
            if field is not None and label.endswith("weight"):
                _require(bool_all(field >= 0), f"{name}: {label} {tuple(field.shape)} is negative{inside}")
        h = self.unit
        steps = self.pixel_size[0] / h, self.pixel_size[1] / h
        scaled = None if anchor is None else anchor / h
        return Fields(gradient, mask, weight, scaled, None if trust is None else trust * h**2, steps)


def edge_cost(z: Tensor, v: Tensor, w: Tensor | None, steps: tuple[float, float]) -> Tensor:
    """(N,) 1/2 sum w (A z - v)^2."""
    misfit = (GradientOperator("forward", steps)(z) - v).square()
    return 0.5 * (misfit if w is None else w * misfit).sum((-3, -2, -1))


def _all_finite(field: Tensor) -> bool:
    """Whether every value is finite; one sum mostly tells, and only a sum that overflows needs the second look."""
    return not visible(field) or bool(field.detach().sum().isfinite()) or bool(field.isfinite().all())


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ValueError(message)


def _check_gradient(name: str, gradient: Tensor) -> None:
    if not isinstance(gradient, Tensor):
        raise TypeError(f"{name}: gradient is a {type(gradient).__name__}, a tensor is needed")
    if gradient.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name}: gradient has dtype {gradient.dtype}; float32 or float64 is needed")
    if gradient.ndim not in (3, 4) or gradient.shape[-3] != 2 or 0 in gradient.shape:
        raise ValueError(f"{name}: gradient {tuple(gradient.shape)} given, (N, 2, H, W) or (2, H, W) is needed")


def _fit(
    name: str,
    label: str,
    field: Tensor | None,
    gradient: Tensor,
    *,
    channels: tuple[int, ...],
    dtype: torch.dtype | None = None,
    scalar: bool = False,
) -> Tensor | None:
    """The field with a batch dimension of N, once its type, shape, dtype and device are found to fit the gradient's."""
    if field is None:
        return None
    if not isinstance(field, Tensor):
        raise TypeError(f"{name}: {label} is a {type(field).__name__}, a tensor is needed")
    dtype = gradient.dtype if dtype is None else dtype
    if field.dtype != dtype:
        error = TypeError if dtype == torch.bool else ValueError
        raise error(f"{name}: {label} has dtype {field.dtype}, {dtype} is needed")
    if field.device != gradient.device:
        raise ValueError(f"{name}: {label} is on {field.device}, gradient on {gradient.device}")
    sizes = (tuple(gradient.shape[-2:]), (1, 1)) if scalar else (tuple(gradient.shape[-2:]),)
    fits = field.ndim == gradient.ndim and field.shape[-3] in channels and tuple(field.shape[-2:]) in sizes
    if not fits or (field.ndim == 4 and field.shape[0] not in (1, gradient.shape[0])):
        shapes = f"gradient {tuple(gradient.shape)} and {label} {tuple(field.shape)}"
        raise ValueError(f"{name}: {shapes} {_difference(gradient, field, channels)}")
    field = field if field.ndim == 4 else field[None]
    return field.expand(gradient.shape[0] if gradient.ndim == 4 else 1, -1, -1, -1)


def _difference(gradient: Tensor, field: Tensor, channels: tuple[int, ...]) -> str:
    if field.ndim != gradient.ndim:
        return f"differ in the number of dimensions, {gradient.ndim} and {field.ndim}"
    if field.shape[-3] not in channels:
        return f"do not fit: {field.shape[-3]} channels, {' or '.join(map(str, channels))} needed"
    for dim, axis in ((-1, "width"), (-2, "height")):
        if field.shape[dim] != gradient.shape[dim]:
            return f"differ in {axis}"
    return "differ in batch size"
