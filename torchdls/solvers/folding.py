"""Choices that follow values, inside `vmap`: what it maps over becomes more surfaces of the batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchdls._tracing import is_concrete

Choice = Callable[..., tuple[Tensor, ...]]


def choose_per_surface(choose: Choice, *fields: Tensor) -> tuple[Tensor, ...]:
    """choose(*fields), all with the batch in front; it may look at values, and what it gives has no derivative."""
    if all(is_concrete(field) for field in fields):
        return choose(*fields)
    chosen: tuple[Tensor, ...] = _Choice.apply(choose, *(field.detach() for field in fields))
    return chosen


class _Choice(torch.autograd.Function):
    @staticmethod
    def forward(choose: Choice, *fields: Tensor) -> tuple[Tensor, ...]:
        return tuple(choose(*fields))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, *_: Tensor | None) -> tuple[None, ...]:
        return (None,) * ctx.count

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        outputs = _Choice.apply(*fold_vmap(info.batch_size, in_dims, inputs))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0,) * len(outputs)


def fold_vmap(size: int, in_dims: tuple[int | None, ...], inputs: tuple[Any, ...]) -> list[Any]:
    """The dimension that vmap maps over, folded into the batch of every tensor."""

    def fold(x: Any, dim: int | None) -> Any:
        if not isinstance(x, Tensor):
            return x
        x = x.unsqueeze(0).expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
        return x.flatten(0, 1)

    return [fold(x, d) for x, d in zip(inputs, in_dims, strict=True)]
