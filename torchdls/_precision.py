"""Full precision under `torch.autocast`: nothing here is a product of weights that half precision would serve."""

from __future__ import annotations

import functools
from collections.abc import Callable
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

    A backward pass belongs outside of autocast. Those of the custom functions here are wrapped as well; those of
    PyTorch's own operations would be rounded there.
    """

    @functools.wraps(f)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.compiler.is_compiling() or torch._C._is_any_autocast_enabled():
            for device in _DEVICES:
                if torch.is_autocast_enabled(device):
                    with torch.autocast(device, enabled=False):
                        return wrapped(*_raised(args), **_raised(kwargs))
        return f(*args, **kwargs)

    return wrapped


def _raised(value: Any) -> Any:
    """Half-precision tensors as float32, in tuples and dictionaries of arguments."""
    if isinstance(value, Tensor):
        return value.float() if value.dtype in _HALF else value
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return tuple(_raised(v) for v in value)
    return {k: _raised(v) for k, v in value.items()} if isinstance(value, dict) else value
