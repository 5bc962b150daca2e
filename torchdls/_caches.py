"""The one store for what is built from sizes and masks alone (tables, orders of elimination), bounded in bytes.

What was used least recently goes first. It holds constants: no result depends on what it holds.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any

from torch import Tensor

LIMIT = 576 * 2**20  # bytes of all that is kept: the tables of 4096 x 4096 pixels in float32 fit


class Store:
    """Values by key, with at most `limit` bytes of tensors; one that is larger by itself is not kept."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.held = 0
        self._values: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._lock = Lock()

    def find(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of the key, made if it is not there; threads that ask at once may make it twice."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key][0]
        value = make()
        with self._lock:
            if key not in self._values:
                self._keep(key, value, weight(value))
        return value

    def _keep(self, key: Hashable, value: Any, size: int) -> None:
        if size > self.limit:
            return
        while self.held + size > self.limit:
            self.held -= self._values.popitem(last=False)[1][1]
        self._values[key] = value, size
        self.held += size


STORE = Store(LIMIT)


def weight(value: Any) -> int:
    """Bytes of the tensors in a value, and 100 for each thing in it."""
    if isinstance(value, Tensor):
        return 100 + value.nbytes
    if isinstance(value, tuple | list):
        return 100 + sum(map(weight, value))
    return 100 + (len(value) if isinstance(value, bytes) else 0)
