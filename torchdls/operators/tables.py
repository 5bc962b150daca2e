"""A cache, bounded in bytes, for the constant tables (cosines, eigenvalues) that operators look up at every call."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from torchdls._caches import STORE


def table(build: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Cache a table that `build(*args)` computes on the CPU in float64, in the dtype and on the device of `like`.

    Tables are constants: they are built outside autograd and outside inference mode, so one table serves every caller.
    While a graph is being traced nothing is cached, since a traced tensor must not outlive its graph.
    """

    def make(args: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        with torch.inference_mode(False), torch.no_grad():
            values = build(*args)
            if not values.is_floating_point():  # positions stay integers
                dtype = dtype.to_complex() if values.is_complex() else values.dtype
            return values.to(dtype).to(device)

    @wraps(build)
    def lookup(*args: Any, like: Tensor) -> Tensor:
        key = args, like.dtype, like.device
        return make(*key) if torch.compiler.is_compiling() else STORE.find((build, *key), lambda: make(*key))

    return lookup
