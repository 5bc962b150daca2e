"""The way between the conventions that users meet (`torchdls._conventions`) and the canonical one."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._checks import check_field
from torchdls._conventions import GRADIENT_CONVENTIONS as GRADIENT_CONVENTIONS
from torchdls._conventions import NORMAL_CONVENTIONS as NORMAL_CONVENTIONS
from torchdls._conventions import Axes as Axes
from torchdls._precision import full_precision


@full_precision
def convert_normals(normals: Tensor, source: str = "opengl", target: str = "opengl") -> Tensor:
    """Express normals (N, 3, H, W) or (3, H, W) of convention `source` in convention `target`.

    TypeError for a wrong type, ValueError for a wrong shape or an unknown convention.

    Example:
        >>> torchdls.convert_normals(torch.tensor([0.0, 0.6, 0.8]).view(3, 1, 1), "opengl", "directx").flatten()
        tensor([ 0.0000, -0.6000,  0.8000])
    """
    check_field("convert_normals", "normals", normals, 3)
    frame = lookup(NORMAL_CONVENTIONS, "source", source), lookup(NORMAL_CONVENTIONS, "target", target)
    return permute(permute(normals, frame[0]), inverse_axes(frame[1]))


@full_precision
def convert_gradient(gradient: Tensor, source: str = "image", target: str = "image") -> Tensor:
    """Express a gradient (N, 2, H, W) or (2, H, W) of convention `source` in convention `target`.

    TypeError for a wrong type, ValueError for a wrong shape or an unknown convention.

    Example:
        >>> torchdls.convert_gradient(torch.tensor([1.0, 2.0]).view(2, 1, 1), source="matlab").flatten()
        tensor([2., 1.])
    """
    check_field("convert_gradient", "gradient", gradient, 2)
    frame = lookup(GRADIENT_CONVENTIONS, "source", source), lookup(GRADIENT_CONVENTIONS, "target", target)
    return permute(permute(gradient, frame[0]), inverse_axes(frame[1]))


def lookup(table: dict[str, Axes], name: str, convention: str) -> Axes:
    """The axes of a convention; ValueError, with the known ones, if there is none."""
    if convention not in table:
        raise ValueError(f"{name}: {convention!r} is unknown; choose from {', '.join(table)}")
    return table[convention]


def permute(field: Tensor, axes: Axes) -> Tensor:
    """The components of a field, exchanged and turned."""
    parts = field.split(1, -3)
    return torch.cat([parts[i] if sign > 0 else -parts[i] for i, sign in axes], -3)


def inverse_axes(axes: Axes) -> Axes:
    """The way back."""
    order = sorted((i, k, sign) for k, (i, sign) in enumerate(axes))
    return tuple((k, sign) for _, k, sign in order)
