r"""Least squares inside a mask: conjugate gradients whose vectors are files.

    A^T W A z = A^T W v,      W = 1 on the edges between two pixels of the mask, else 0

preconditioned by the least squares of the full rectangle, M (A^T A)^+ M with the mask M, whose cosine transforms go by
bands and strips. Memory holds a band or strip, and a number for each component of the mask; four vectors and the
components lie on disk. Every component has its own free constant: residuals keep a sum of 0 over each, and so does the
height.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor
from torchdls.large.transform import Passes, columns_back, columns_forward, integrated, rows_back, rows_forward
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.solvers.components import connected_components


class Parts:
    """The components of a mask on disk.

    Attributes:
        size: (n + 1,) pixels of each, the last one of what lies outside; at least 1.
    """

    def __init__(self, passes: Passes) -> None:
        self._labels = passes.scratch("components", np.int64)
        parent: list[int] = []
        above: Array | None = None
        for rows in passes.bands():
            local, inside = _labels(passes, rows)
            roots, numbers = np.unique(local[inside], return_inverse=True)
            labels = np.full(local.shape, -1)
            labels[inside] = numbers + len(parent)
            parent += range(len(parent), len(parent) + len(roots))
            if above is not None:
                linked = (above >= 0) & (labels[0] >= 0)
                for a, b in np.unique(np.stack([above[linked], labels[0][linked]]), axis=1).T.tolist():
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


def _labels(passes: Passes, rows: slice) -> tuple[Array, Array]:
    """(rows, W) components within a band, by any numbers, and what is inside."""
    inside = passes.field.inside(rows)[None]
    linked = edge_slopes(torch.zeros(1, 2, *inside.shape[-2:]), inside)[1]
    assert linked is not None
    return connected_components(linked > 0)[0].numpy(), inside[0, 0].numpy()


def _root(parent: list[int], k: int) -> int:
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


def _join(parent: list[int], a: int, b: int) -> None:
    a, b = _root(parent, a), _root(parent, b)
    parent[max(a, b)] = min(a, b)


class Masked:
    """The system of a mask and its solution by conjugate gradients.

    Args:
        passes: over a field with a mask.

    Attributes:
        iterations: of the last `solve`.
        residual: relative, at its end.
    """

    def __init__(self, passes: Passes) -> None:
        self.passes = replace(passes, say=lambda text: None)
        self._say = passes.say
        self.parts = Parts(self.passes)
        if len(self.parts.size) == 1:
            raise ValueError("large.integrate: mask is False everywhere")
        self.x, self.r, self.p, self.y = (passes.scratch(name) for name in ("height", "residual", "direction", "other"))
        self.iterations, self.residual = 0, 0.0

    def solve(self, tol: float, max_iter: int) -> bool:
        """Iterate until the relative residual is at most `tol`; whether it came to that."""
        bands, rho, goal = self.passes.bands(), 0.0, 0.0
        for rows in bands:
            self.r[rows] = self._divergence(rows)
            goal += _dot(self.r[rows], self.r[rows])
        if goal == 0:
            return True
        mean = np.zeros_like(self.parts.size)
        for self.iterations in range(1, max_iter + 1):
            new = self._precondition(mean)
            ratio, rho = (new / rho if rho else 0.0), new
            for rows in bands:
                self.p[rows] = self.y[rows] + ratio * self.p[rows]
            mean, square = self._step(rho)
            self.residual = (square / goal) ** 0.5
            self._say(f"step {self.iterations}, relative residual {self.residual:.1e}")
            if self.residual <= tol:
                return True
        return False

    def heights(self) -> Iterator[tuple[slice, Array]]:
        """Bands of the height: mean 0 over each component, 0 outside."""
        mean = sum(self.parts.sums(rows, self.x[rows]) for rows in self.passes.bands()) / self.parts.size
        for rows in self.passes.bands():
            labels = self.parts.of(rows)
            inside = labels < len(self.parts.size) - 1
            yield rows, np.where(inside, self.x[rows] - mean[labels].astype(self.x.dtype), 0)

    def _precondition(self, mean: Array) -> float:
        """Take the means of the components off r; y = M (A^T A)^+ M r; r y."""
        passes, total = self.passes, 0.0
        outside = len(self.parts.size) - 1
        mean[outside] = 0
        for rows in passes.bands():
            self.r[rows] -= mean[self.parts.of(rows)].astype(self.r.dtype)
            self.y[rows] = rows_forward(as_tensor(self.r[rows]))
        for columns in passes.strips():
            spectrum = integrated(columns_forward(self.y[:, columns]), columns, passes.size, passes.step)
            self.y[:, columns] = columns_back(spectrum)
        for rows in passes.bands():
            self.y[rows] = np.where(self.parts.of(rows) < outside, rows_back(self.y[rows]), 0)
            total += _dot(self.r[rows], self.y[rows])
        return total

    def _step(self, rho: float) -> tuple[Array, float]:
        """Along p to the least energy; the means of r over the components, and the square of what else there is."""
        bands, energy = self.passes.bands(), 0.0
        for rows in bands:
            self.y[rows] = self._normal(rows)
            energy += _dot(self.p[rows], self.y[rows])
        length, square = (rho / energy if energy > 0 else 0.0), 0.0
        sums = np.zeros_like(self.parts.size)
        for rows in bands:
            self.x[rows] += length * self.p[rows]
            self.r[rows] -= length * self.y[rows]
            square += _dot(self.r[rows], self.r[rows])
            sums += self.parts.sums(rows, self.r[rows])
        return sums / self.parts.size, max(0.0, square - float((sums**2 / self.parts.size).sum()))

    def _divergence(self, rows: slice) -> Array:
        """A^T W v of a band."""
        more = self._more(rows)
        v, _ = edge_slopes(self.passes.field.slopes(more)[None], self.passes.field.inside(more)[None])
        return self._back(v, rows, more)

    def _normal(self, rows: slice) -> Array:
        """A^T W A p of a band."""
        more = self._more(rows)
        slopes = GradientOperator("forward", self.passes.step)(as_tensor(self.p[more])[None, None])
        _, w = edge_slopes(slopes, self.passes.field.inside(more)[None])
        assert w is not None
        return self._back(w * slopes, rows, more)

    def _more(self, rows: slice) -> slice:
        return slice(max(rows.start - 1, 0), min(rows.stop + 1, self.passes.size[0]))

    def _back(self, slopes: Tensor, rows: slice, more: slice) -> Array:
        """A^T of slopes on a band and one more row on either side, without those."""
        b = GradientOperator("forward", self.passes.step).adjoint(slopes)[0, 0]
        found: Array = b[rows.start - more.start :][: rows.stop - rows.start].numpy()
        return found


def _dot(a: Array, b: Array) -> float:
    return float(np.vdot(a, b)) if a.dtype == np.float64 else float(np.sum(a * b, dtype=np.float64))
