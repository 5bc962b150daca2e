"""The components of what is linked on disk: pixels inside the mask that trusted edges join, and sums over each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array
from torchdls.large.transform import Passes
from torchdls.operators.edges import edge_ends
from torchdls.solvers.components import connected_components


class Whole:
    """A full rectangle with equal trust: one component.

    Attributes:
        size: (2,) pixels of it, and 1 for what lies outside.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._width = size[1]
        self.size = np.array([float(size[0] * size[1]), 1.0])

    def of(self, rows: slice) -> Array:
        """(rows, W) zeros."""
        return np.zeros((rows.stop - rows.start, self._width), np.int8)

    def sums(self, rows: slice, x: Array) -> Array:
        """(2,) of x (rows, W)."""
        return np.array([np.sum(x, dtype=np.float64), 0.0])


class Parts:
    """The components of the edges on disk.

    A pixel without an edge is by itself, has nothing to say and counts as outside.

    Args:
        passes: over the field.
        linked: rows -> (1, 2, rows, W) bool, the edges with a trust.

    Attributes:
        size: (n + 1,) pixels of each, the last one of what lies outside; at least 1.
    """

    def __init__(self, passes: Passes, linked: Callable[[slice], Tensor]) -> None:
        self._labels = passes.scratch("components", np.int64)
        parent: list[int] = []
        above: Array | None = None
        for rows in passes.bands():
            more = slice(max(rows.start - 1, 0), min(rows.stop + 1, passes.size[0]))
            edges, first = linked(more), rows.start - more.start
            part = slice(first, first + rows.stop - rows.start)
            inside = (edge_ends(edges.to(torch.int8)) > 0)[0, 0, part].numpy()
            crossing = edges[0, 1, first - 1].numpy() if first else None
            within = edges[..., part, :].clone()
            within[:, 1, -1] = False  # edges to the next band
            local = connected_components(within)[0].numpy()
            roots, numbers = np.unique(local[inside], return_inverse=True)
            labels = np.full(local.shape, -1)
            labels[inside] = numbers + len(parent)
            parent += range(len(parent), len(parent) + len(roots))
            if above is not None and crossing is not None:
                for a, b in np.unique(np.stack([above[crossing], labels[0][crossing]]), axis=1).T.tolist():
                    _join(parent, a, b)
            self._labels[rows], above = labels, labels[-1]
        _, table = np.unique([_root(parent, k) for k in range(len(parent))], return_inverse=True)
        count = int(table.max()) + 1 if len(table) else 0
        self._number = np.append(table, count).astype(np.int64)  # -1, outside, finds the last
        self.size = np.zeros(count + 1)
        self.size = np.maximum(sum(self.sums(rows, 1.0) for rows in passes.bands()), 1)

    def of(self, rows: slice) -> Array:
        """(rows, W) number of the component of each pixel."""
        found: Array = self._number[self._labels[rows]]
        return found

    def sums(self, rows: slice, x: Array | float) -> Array:
        """(n + 1,) of x (rows, W) over each component."""
        labels = self.of(rows)
        found: Array = np.bincount(labels.ravel(), np.broadcast_to(x, labels.shape).ravel(), len(self.size))
        return found


def _root(parent: list[int], k: int) -> int:
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


def _join(parent: list[int], a: int, b: int) -> None:
    a, b = _root(parent, a), _root(parent, b)
    parent[max(a, b)] = min(a, b)
