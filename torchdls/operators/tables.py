"""A cache, bounded in bytes, for the constant tables (cosines, eigenvalues) that operators look up at every call."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from torchdls._caches import STORE
from torchdls._tracing import is_fake

Built = TypeVar("Built", Tensor, tuple[Tensor, ...])


def table(build: Callable[..., Built]) -> Callable[..., Built]:
    """Cache what `build(*args)` computes on the CPU in float64, in the dtype and on the device of `like`.

    It is one tensor, or several that are always used together: one look-up costs as much as a small product.

    Tables are constants: they are built outside autograd and outside inference mode, so one table serves every caller.
    What a compiler follows is not cached, since a traced tensor must not outlive its graph; nor is a fake one.
    """

    def make(args: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Built:
        with torch.inference_mode(False), torch.no_grad():
            values = build(*args)
            if isinstance(values, tuple):
                return tuple(_placed(x, dtype, device) for x in values)
            return _placed(values, dtype, device)

    @wraps(build)
    def lookup(*args: Any, like: Tensor) -> Built:
        key: tuple[Any, torch.dtype, torch.device] = (args, like.dtype, like.device)

        def kept() -> Built:
            found: Built = STORE.find((build, *key), lambda: make(*key))
            return found

        if torch.compiler.is_dynamo_compiling() or _symbolic(args):
            return make(*key)
        if torch.compiler.is_compiling():  # `torch.export` takes a tensor from outside of its graph for a constant
            with _disable_current_modes():
                return kept()
        return make(*key) if is_fake(like) else kept()

    return lookup


def _placed(values: Tensor, dtype: torch.dtype, device: torch.device) -> Tensor:
    if values.is_complex():
        dtype = torch.complex128 if dtype == torch.float64 else torch.complex64
    elif not values.is_floating_point():  # positions stay integers
        dtype = values.dtype
    return values.to(dtype).to(device)


def _symbolic(args: tuple[Any, ...]) -> bool:
    """Whether a size is left open, in a graph for every size."""
    return any(_symbolic(a) if isinstance(a, tuple) else isinstance(a, torch.SymInt) for a in args)
