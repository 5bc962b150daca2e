"""Loops compiled by Numba (the extra `fast`): whether there are any, how they are compiled, and threads to run them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor


@functools.cache
def installed() -> bool:
    """Whether there is a Numba."""
    return find_spec("numba") is not None


def serves(*tensors: Tensor) -> bool:
    """Whether the loops can be had for tensors that are not recorded."""
    return installed() and all(t.device.type == "cpu" for t in tensors)


def backends() -> dict[str, str]:
    """What does the work where there is a choice, by the name of the function.

    The compiled loops of the extra `fast` serve on the CPU where no derivative is recorded, by themselves; everywhere
    else, and without Numba, PyTorch does.

    Returns:
        "numba" or "torch" for `soup_dil_sweep`, and so for `DLS`, and for `SlopeDLS`.

    Example:
        >>> torchdls.backends()["soup_dil_sweep"] in ("numba", "torch")
        True
    """
    return dict.fromkeys(("soup_dil_sweep", "SlopeDLS"), "numba" if installed() else "torch")


def compiled(f: Callable[..., Any]) -> Any:
    """The function compiled on its first call; kept on disk where Numba finds a place to write."""
    from numba import njit

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
    try:
        return njit(f, cache=True, **options)
    except RuntimeError:  # nowhere to write
        return njit(f, **options)


class Workers:
    """Calls a function for parts of a work at the same time, on as many threads as PyTorch may use."""

    def __init__(self) -> None:
        self.count = torch.get_num_threads()
        self._pool = ThreadPoolExecutor(self.count) if self.count > 1 else None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def map(self, f: Callable[..., Any], *arguments: Any) -> list[Any]:
        """f of every set of arguments."""
        return list((map if self._pool is None else self._pool.map)(f, *arguments))

    def split(self, f: Callable[..., Any], *tensors: Tensor) -> list[Any]:
        """f of parts of some tensors, one for each thread."""
        if self._pool is None:
            return [f(*tensors)]
        step = -(-len(tensors[0]) // self.count)
        return self.map(f, *(x.split(step) for x in tensors))
