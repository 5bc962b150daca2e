"""Full precision under `torch.autocast`: nothing here is a product of weights that half precision would serve."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
T = TypeVar("T")

_HALF = (torch.float16, torch.bfloat16)
_DEVICES = ("cpu", "cuda", "xpu", "mps")


def full_precision(f: Callable[P, T]) -> Callable[P, T]:
    """The function with autocast switched off inside, and half-precision tensors among its arguments as float32.

    Solves, transforms and estimates of noise lose their meaning in half precision, so inside `torch.autocast` they give
    what they give outside of it, and so do their derivatives. Without autocast nothing is touched: half precision is
    then refused by whoever checks the arguments.

    A backward pass belongs outside of autocast. Where it is called inside all the same, every step that the function
    recorded there switches it off for itself (`_shield`), PyTorch's own products too. The custom functions here do so
    wherever they were recorded.
    """

    @functools.wraps(f)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.compiler.is_compiling() or torch._C._is_any_autocast_enabled():
            for device in _DEVICES:
                if torch.is_autocast_enabled(device):
                    with torch.autocast(device, enabled=False):
                        result = wrapped(*_raised(args), **_raised(kwargs))
                        if not torch.compiler.is_compiling():
                            _shield(result, (args, kwargs), device)
                        return result
        return f(*args, **kwargs)

    return wrapped


def _shield(result: Any, given: Any, device: str) -> None:
    """Switch autocast off in each step of the backward pass from a result down to what the function was given.

    The engine gives every step the state of its caller and takes it back after it, so nothing need be restored.
    """
    seen = {node for t in _tensors(given) for node in _steps(t)}
    todo = [node for t in _tensors(result) for node in _steps(t)]
    while todo:
        node = todo.pop()
        if node in seen:
            continue
        seen.add(node)
        below = [n for n, _ in node.next_functions if n is not None]
        if below:  # the others are leaves
            node.register_prehook(lambda _: torch.set_autocast_enabled(device, False))
            todo += below


def _steps(t: Tensor) -> Iterator[Any]:
    """The last recorded step of a tensor, in each function transform that is around it."""
    while True:
        if t.grad_fn is not None:
            yield t.grad_fn
        if not torch._C._functorch.is_functorch_wrapped_tensor(t):
            return
        t = torch._C._functorch.get_unwrapped(t)


def _tensors(value: Any) -> Iterator[Tensor]:
    """The tensors in a result or in arguments."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for v in value:
            yield from _tensors(v)
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _tensors([getattr(value, f.name) for f in fields(value)])


def _raised(value: Any) -> Any:
    """Half-precision tensors as float32, in tuples and dictionaries of arguments."""
    if isinstance(value, Tensor):
        return value.float() if value.dtype in _HALF else value
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return tuple(_raised(v) for v in value)
    return {k: _raised(v) for k, v in value.items()} if isinstance(value, dict) else value
