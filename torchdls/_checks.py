"""What every function asks of its tensors, once: a wrong type or dtype is a TypeError, a wrong shape a ValueError.

A message restates the call: who complains, which argument, what came and what is needed.
"""

from __future__ import annotations

from numbers import Real

import torch
from torch import Tensor

REAL = (torch.float32, torch.float64)


def require(holds: bool, message: str) -> None:
    """ValueError with the message unless it holds."""
    if not holds:
        raise ValueError(message)


def check_numbers(name: str, **options: object) -> None:
    """Real numbers that are not NaN."""
    for label, value in options.items():
        if not isinstance(value, Real) or isinstance(value, bool):
            raise TypeError(f"{name}: {label} is a {type(value).__name__}, a number is needed")
        require(value == value, f"{name}: {label}={value!r} given, a number is needed")


def check_whole(name: str, **options: object) -> None:
    """Integers."""
    for label, value in options.items():
        if not isinstance(value, int) or isinstance(value, bool):
            raise TypeError(f"{name}: {label} is a {type(value).__name__}, an integer is needed")


def check_real(name: str, label: str, field: Tensor) -> None:
    """A tensor of float32 or float64."""
    if not isinstance(field, Tensor):
        raise TypeError(f"{name}: {label} is a {type(field).__name__}, a tensor is needed")
    if field.dtype not in REAL:
        raise TypeError(f"{name}: {label} has dtype {field.dtype}; float32 or float64 is needed")


def check_alike(name: str, label: str, field: Tensor, dtype: torch.dtype) -> None:
    """A tensor of this dtype, such as that of the field beside it."""
    if not isinstance(field, Tensor):
        raise TypeError(f"{name}: {label} is a {type(field).__name__}, a tensor is needed")
    if field.dtype != dtype:
        raise TypeError(f"{name}: {label} has dtype {field.dtype}, {dtype} is needed")


def check_dtype(name: str, dtype: torch.dtype) -> None:
    """float32 or float64, asked for of a result."""
    if dtype not in REAL:
        raise TypeError(f"{name}: dtype is {dtype}; torch.float32 or torch.float64 is needed")


def check_together(name: str, **fields: object) -> None:
    """Tensors of float32 or float64, all of one dtype and on one device."""
    first: tuple[str, Tensor] | None = None
    for label, field in fields.items():
        if not isinstance(field, Tensor):
            raise TypeError(f"{name}: {label} is a {type(field).__name__}, a tensor is needed")
        check_real(name, label, field)
        first = (label, field) if first is None else first
        if field.dtype != first[1].dtype:
            raise TypeError(f"{name}: {label} has dtype {field.dtype}, that of {first[0]}, {first[1].dtype}, is needed")
        if field.device != first[1].device:
            raise ValueError(f"{name}: {label} is on {field.device}, {first[0]} on {first[1].device}")


def check_field(name: str, label: str, field: Tensor, channels: int) -> None:
    """A tensor (N, channels, H, W) or (channels, H, W) of float32 or float64 that is not empty."""
    check_real(name, label, field)
    if field.ndim not in (3, 4) or field.shape[-3] != channels or 0 in field.shape:
        wanted = f"(N, {channels}, H, W) or ({channels}, H, W)"
        raise ValueError(f"{name}: {label} {tuple(field.shape)} given, {wanted} is needed")


def check_fit(
    name: str,
    label: str,
    field: Tensor,
    like: Tensor,
    like_label: str,
    *,
    channels: tuple[int, ...],
    dtype: torch.dtype | None = None,
    scalar: bool = False,
) -> None:
    """A tensor of the dtype, device, size and batch of another one, or of batch 1, with so many channels.

    Args:
        name: who asks.
        label: of the argument.
        field: the argument.
        like: what it must fit.
        like_label: of that.
        channels: the numbers of channels that do.
        dtype: that of `like` for None.
        scalar: whether 1 x 1 pixels do as well.
    """
    check_alike(name, label, field, like.dtype if dtype is None else dtype)
    if field.device != like.device:
        raise ValueError(f"{name}: {label} is on {field.device}, {like_label} on {like.device}")
    sizes = (tuple(like.shape[-2:]), (1, 1)) if scalar else (tuple(like.shape[-2:]),)
    fits = field.ndim == like.ndim and field.shape[-3] in channels and tuple(field.shape[-2:]) in sizes
    if not fits or (field.ndim == 4 and field.shape[0] not in (1, like.shape[0])):
        shapes = f"{like_label} {tuple(like.shape)} and {label} {tuple(field.shape)}"
        raise ValueError(f"{name}: {shapes} {_difference(like, field, channels)}")


def _difference(like: Tensor, field: Tensor, channels: tuple[int, ...]) -> str:
    if field.ndim != like.ndim:
        return f"differ in the number of dimensions, {like.ndim} and {field.ndim}"
    if field.shape[-3] not in channels:
        return f"do not fit: {field.shape[-3]} channels, {' or '.join(map(str, channels))} needed"
    for dim, axis in ((-1, "width"), (-2, "height")):
        if field.shape[dim] != like.shape[dim]:
            return f"differ in {axis}"
    return "differ in batch size"
