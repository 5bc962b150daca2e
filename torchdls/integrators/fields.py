"""What integrators work on: the arguments of the call, checked and brought to one form."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_fit, require
from torchdls._tracing import all_finite, holds_everywhere, only_shapes
from torchdls.operators import edge_slopes, present_edges
from torchdls.operators.modes import Boundary
from torchdls.solvers.components import Gauge, connected_components
from torchdls.solvers.folding import choose_per_surface
from torchdls.solvers.units import unit_of


class Fields(NamedTuple):
    """The checked input of an integrator: batched, finite, zero outside the mask, and in units of one pixel.

    With h = sqrt(dx dy), heights are divided by h and anchor weights multiplied by h^2. Slopes have no unit and stay.

    Attributes:
        gradient: (N, 2, H, W), at the pixels, or on the edges between them (`on_edges`).
        mask: (N, 1, H, W) bool, or None for full rectangles.
        weight: (N, 1 or 2, H, W), in the same places, or None for equal trust.
        anchor: (N, 1, H, W), or None.
        anchor_weight: (N, 1, H, W), or (N, 1, 1, 1) for one number per surface, or None.
        steps: (dx / h, dy / h), the sides of a pixel of unit area.
        on_edges: whether slopes and weights are those of the edges, as `edge_slopes` lays them out.
        boundary: how the grid ends; "periodic" comes without mask and weight, and with one anchor weight per surface.
    """

    gradient: Tensor
    mask: Tensor | None
    weight: Tensor | None
    anchor: Tensor | None
    anchor_weight: Tensor | None
    steps: tuple[float, float]
    on_edges: bool = False
    boundary: Boundary = "neumann"


def check_accepted(name: str, accepts: frozenset[str], torus: bool, **given: object) -> None:
    """ValueError for an argument that the method cannot honour."""
    for label, field in given.items():
        taken = "anchor" if label == "anchor_weight" else label
        other = " with boundary='periodic'" if torus else "; LeastSquares and DLS do"
        require(field is None or taken in accepts, f"{name}: takes no {taken}{other}")


def fit_fields(
    name: str,
    gradient: Tensor,
    mask: Tensor | None,
    weight: Tensor | None,
    anchor: Tensor | None,
    anchor_weight: Tensor | float | None,
) -> Fields:
    """The arguments as one batch, once their types and shapes are found to fit."""
    mask = fit_field(name, "mask", mask, gradient, channels=(1,), dtype=torch.bool)
    weight = fit_field(name, "weight", weight, gradient, channels=(1, 2))
    anchor = fit_field(name, "anchor", anchor, gradient, channels=(1,))
    if isinstance(anchor_weight, int | float):
        anchor_weight = gradient.new_full((1,) * gradient.ndim, float(anchor_weight))
    trust = fit_field(name, "anchor_weight", anchor_weight, gradient, channels=(1,), scalar=True)
    if (anchor is None) != (trust is None):
        given, missing = ("anchor", "anchor_weight") if trust is None else ("anchor_weight", "anchor")
        raise ValueError(f"{name}: {given} is given without {missing}; they come together")
    return Fields(gradient if gradient.ndim == 4 else gradient[None], mask, weight, anchor, trust, (1.0, 1.0))


def within_mask(name: str, fields: Fields) -> Fields:
    """Zero outside the mask, and anchors zero where they are not trusted: NaN there goes no further."""
    gradient, mask, weight, anchor, trust, *_ = fields
    if mask is not None:
        some = holds_everywhere(mask.flatten(1).any(1))
        require(some, f"{name}: mask {tuple(mask.shape)} is False everywhere on a surface")
        gradient = torch.where(mask, gradient, 0)
        weight = None if weight is None else torch.where(mask, weight, 0)
        trust = None if trust is None else torch.where(mask, trust, 0)
    if anchor is not None and trust is not None:
        anchor = torch.where(trust > 0, anchor, 0)
    return fields._replace(gradient=gradient, weight=weight, anchor=anchor, anchor_weight=trust)


def edge_fields(name: str, slopes: Tensor, trust: Tensor | None, fields: Fields) -> Fields:
    """Fields whose slopes, and trusts if any, are those of the edges; edges that leave the mask or the image go."""
    trust = fit_field(name, "trust", trust, slopes, channels=(1, 2))
    v = slopes if slopes.ndim == 4 else slopes[None]
    inside = None if fields.mask is None else edge_slopes(v, fields.mask)[1]
    there = (present_edges(v) if inside is None else inside) > 0
    w = None
    if trust is not None or fields.mask is not None:
        w = torch.where(there, torch.ones_like(v) if trust is None else trust.expand_as(v), 0)
        require(all_finite(w) and holds_everywhere(w >= 0), f"{name}: trust {tuple(w.shape)} is negative or not finite")
        there = w > 0
    v = torch.where(there, v, 0)
    require(all_finite(v), f"{name}: slopes {tuple(v.shape)} are not finite on edges that are trusted")
    return fields._replace(gradient=v, weight=w, on_edges=True)


def level_anchors(fields: Fields) -> tuple[Fields, Tensor | None]:
    """The fields with the mean of the anchors of each component taken off, and what was; None without anchors.

    The mean is weighted by the trust in the anchors. It is (N, 1, H, W), 0 where a component has no anchor, or
    (N, 1, 1, 1) where all of a surface is one component. A height is its level and what is found for the rest; in
    single precision the rest, found with anchors 10^6 away, would be worth nothing.
    """
    gradient, mask, weight, anchor, r, *_ = fields
    if anchor is None or r is None:
        return fields, None
    bare = mask is None and weight is None
    linked = None if bare else weight if fields.on_edges else edge_slopes(gradient, mask, weight)[1]
    nothing = r.new_zeros(len(gradient), 0)
    labels = nothing.long() if linked is None else choose_per_surface(_labels, linked)[0]
    most = r.detach().amax((1, 2, 3), keepdim=True).double()
    trust = (r.double() / torch.where(most > 0, most, 1)).expand(anchor.shape)
    level = Gauge(labels, nothing, nothing).mean(anchor.double(), trust).to(anchor.dtype)
    return fields._replace(anchor=torch.where(r > 0, anchor - level, 0)), level


def _labels(linked: Tensor) -> tuple[Tensor]:
    """(N, H * W), of the components of edges with a trust; (N, 0) where there are shapes alone."""
    if only_shapes(linked):
        return (linked[:, 0, 0, :0].long(),)
    return (connected_components(linked > 0).flatten(1),)


def check_values(name: str, fields: Fields) -> None:
    """Finite everywhere (within the mask), and no weight negative."""
    inside = "" if fields.mask is None else " inside the mask"
    for label in ("gradient", "weight", "anchor", "anchor_weight"):
        field = getattr(fields, label)
        if field is not None:
            if not all_finite(field):
                raise ValueError(f"{name}: {label} {tuple(field.shape)} is not finite{inside}")
            if label.endswith("weight") and not holds_everywhere(field >= 0):
                raise ValueError(f"{name}: {label} {tuple(field.shape)} is negative{inside}")


def on_torus(name: str, fields: Fields) -> Fields:
    """The fields of a surface that repeats, once they are found to allow it."""
    r = fields.anchor_weight
    if r is not None and r[0].numel() > 1:
        shape = tuple(r.shape)
        raise ValueError(f"{name}: takes one anchor_weight per surface with boundary='periodic', {shape} is given")
    return fields._replace(boundary="periodic")


def fit_field(
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
    check_fit(name, label, field, gradient, "gradient", channels=channels, dtype=dtype, scalar=scalar)
    field = field if field.ndim == 4 else field[None]
    return field.expand(gradient.shape[0] if gradient.ndim == 4 else 1, -1, -1, -1)


def has_even_trust(fields: Fields, weight: Tensor | None = None) -> Tensor:
    """(N, 1, 1, 1) bool: a full rectangle with equal trust and no anchor, where the noise of the height is known."""
    full = torch.full_like(fields.gradient[:, :1, :1, :1], not fields.on_edges, dtype=torch.bool)
    if fields.mask is not None:
        full = full & (largest_per_surface(~fields.mask) == 0)
    for w in (fields.weight, weight):
        full = full if w is None else full & (largest_per_surface(w) == -largest_per_surface(-w))
    return full if fields.anchor_weight is None else full & (largest_per_surface(fields.anchor_weight) == 0)


def mean_weight(fields: Fields) -> Tensor:
    """(N, 1, 1, 1), over the weights that are not 0; 1 without weights."""
    weight = fields.weight
    if weight is None:
        return torch.ones_like(fields.gradient[:, :1, :1, :1])
    total, count = (t.sum((1, 2, 3), keepdim=True) for t in (weight, weight > 0))
    return torch.where(count > 0, total / count.clamp(min=1), 1)


def largest_per_surface(x: Tensor) -> Tensor:
    """(N, 1, 1, 1), the largest value of each surface."""
    return x.flatten(1).amax(1)[:, None, None, None]


class Units(NamedTuple):
    """Of slopes (and heights) and of weights, powers of two (N, 1, 1, 1)."""

    slope: Tensor
    trust: Tensor


def slope_unit(gradient: Tensor) -> Tensor:
    """(N, 1, 1, 1), the largest power of two in the slopes where their fourth powers are beyond the dtype, else 1."""
    tame = 2.0**250 if gradient.dtype == torch.float64 else 2.0**30
    unit = unit_of(gradient.detach().abs().amax((1, 2, 3), keepdim=True))
    return torch.where((unit > tame) | (unit < 1 / tame), unit, 1)


def normalize_fields(fields: Fields, slopes: bool = True) -> tuple[Fields, Units]:
    """The same fields with weights of order 1 and, if `slopes`, slopes whose fourth powers are within the dtype.

    Nothing is rounded. What is so already, weights up to 1/16 and 16, stays as it is. Anchor weights beyond all that
    changes a height in the dtype act as that.
    """
    g, _, weight, anchor, r, *_ = fields
    one = torch.ones_like(g[:, :1, :1, :1])
    trust = one if weight is None else unit_of(weight.detach().abs().amax((1, 2, 3), keepdim=True))
    trust = torch.where((trust > 16) | (trust < 1 / 16), trust, 1)
    slope = slope_unit(g) if slopes else one
    if r is not None:
        firm = 2.0**40 if g.dtype == torch.float64 else 2.0**24
        least = torch.finfo(r.dtype).tiny  # a weight that is not 0 stays so
        r = torch.where(r > 0, (r / trust).clamp(least, firm), 0)
    return fields._replace(
        gradient=g / slope,
        weight=None if weight is None else weight / trust,
        anchor=None if anchor is None else anchor / slope,
        anchor_weight=r,
    ), Units(slope, trust)
