r"""Least squares with masks, weights and anchors: conjugate gradients whose vectors are files.

    (A^T W A + r) z = A^T W v + r a,      W = 0 on edges that leave the mask

preconditioned as in memory (`torchdls.solvers.preconditioner`): by a solve with even weights between two scalings,
S (A^T A + rho)^-1 S, whose cosine transforms go by bands and strips, or by the diagonal where all pixels are held
firmly. Memory holds a band or strip, and a number for each component; vectors, trusts and components lie on disk.
A component that nothing holds has its own free constant: residuals keep a sum of 0 over it, and so does the height.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor
from torchdls.large.components import Parts, Whole
from torchdls.large.edges import Edges
from torchdls.large.files import Field
from torchdls.large.transform import Passes, columns_back, columns_forward, integrated, rows_back, rows_forward
from torchdls.operators import GradientOperator
from torchdls.operators.edges import edge_ends
from torchdls.solvers.preconditioner import BLOCK, FIRM, local_weight

_LOOSE = 0.1  # of the diagonal that the weights around it let expect
_HELD = 0.05  # share of the anchors in the diagonal, at every pixel, from which on all are held firmly


class Hold(Protocol):
    """What holds the heights."""

    def strength(self, rows: slice) -> Array:
        """(rows, W) r, at least 0."""

    def pull(self, rows: slice) -> Array:
        """(rows, W) r a."""


class Anchors:
    """The anchors of a field, less the mean of each component, so that heights far from 0 keep their digits."""

    def __init__(self, field: Field, parts: Parts | Whole, bands: list[slice]) -> None:
        self._field, self._parts = field, parts
        total = sum(parts.sums(rows, self.strength(rows)) for rows in bands)
        pulls = sum(parts.sums(rows, self._pull(rows)) for rows in bands)
        self.level: Array = np.where(total > 0, pulls / np.where(total > 0, total, 1), 0)
        self.level[-1] = 0  # outside everyone stands for himself

    def strength(self, rows: slice) -> Array:
        """(rows, W) r."""
        return self._field.anchors(rows)[1]

    def _pull(self, rows: slice) -> Array:
        a, r = self._field.anchors(rows)
        return a * r

    def pull(self, rows: slice) -> Array:
        """(rows, W) r (a - level)."""
        a, r = self._field.anchors(rows)
        found: Array = r * (a - self.level[self._parts.of(rows)]).astype(r.dtype)
        return found


class System:
    """The system of a field and its solution by conjugate gradients.

    Args:
        passes: over a field.
        hold: what holds the heights, in the place of the field's anchors.
        x: file to start from, and for the solution; None for zeros.

    Attributes:
        x: (H, W) the solution, less the level of the anchors.
        iterations: of the last `solve`.
        residual: relative, at its end.
    """

    def __init__(self, passes: Passes, hold: Hold | None = None, x: Array | None = None) -> None:
        self.passes, field = replace(passes, say=lambda text: None), passes.field
        self._say = passes.say
        self._bands = self.passes.bands()
        self._edges = Edges(self.passes)
        self.parts = Whole(field.shape) if field.even else Parts(self.passes, lambda rows: self._edges.trusts(rows) > 0)
        if len(self.parts.size) == 1 and field.anchor is None:
            raise ValueError("large.integrate: mask is False everywhere, or no pixel has a neighbour that is trusted")
        self._level: Array = np.zeros(len(self.parts.size))
        if hold is None and field.anchor is not None:
            hold = anchors = Anchors(field, self.parts, self._bands)
            self._level = anchors.level
        self._hold, self._warm = hold, x is not None
        self.x = passes.scratch("height") if x is None else x
        self._r, self._p, self._y = (passes.scratch(name) for name in ("residual", "direction", "other"))
        self.iterations, self.residual = 0, 0.0
        held = np.zeros(len(self.parts.size)) if hold is None else self._sums(hold.strength)
        self._outside = len(self.parts.size) - 1
        self._free = held == 0
        self._free[self._outside] = False
        self._scaling = Scaling(self.passes, self._edges, hold, self._inside)

    def solve(self, tol: float, max_iter: int) -> bool:
        """Iterate until the relative residual is at most `tol`; whether it came to that."""
        rho, goal, square = 0.0, 0.0, 0.0
        for rows in self._bands:
            b = self._right(rows)
            goal += dot(b, b)
            self._r[rows] = b - self._normal(rows, self.x) if self._warm else b
            square += dot(self._r[rows], self._r[rows])
        if goal == 0 or square <= (tol**2) * goal:
            return True
        mean = np.zeros_like(self.parts.size)
        for self.iterations in range(1, max_iter + 1):
            new = self._precondition(mean)
            ratio, rho = (new / rho if rho else 0.0), new
            for rows in self._bands:
                self._p[rows] = self._y[rows] + ratio * self._p[rows]
            mean, square = self._step(rho)
            self.residual = (square / goal) ** 0.5
            self._say(f"step {self.iterations}, relative residual {self.residual:.1e}")
            if self.residual <= tol:
                return True
        return False

    def heights(self) -> Iterator[tuple[slice, Array]]:
        """Bands of the height: mean 0 over each free component, 0 outside, anchors where a pixel has nothing else."""
        mean = np.where(self._free, self._sums(lambda rows: self.x[rows]) / self.parts.size, -self._level)
        for rows in self._bands:
            labels = self.parts.of(rows)
            alone = 0.0 if self._level is None else self._lone(rows)
            yield rows, np.where(labels < self._outside, self.x[rows] - mean[labels].astype(self.x.dtype), alone)

    def _lone(self, rows: slice) -> Array | float:
        field = self.passes.field
        if field.anchor is None:
            return 0.0
        a, r = field.anchors(rows)
        return np.where(r > 0, a, 0)

    def _sums(self, of: Callable[[slice], Array]) -> Array:
        found = np.zeros_like(self.parts.size)
        for rows in self._bands:
            found += self.parts.sums(rows, of(rows))
        return found

    def _inside(self, rows: slice) -> Array:
        found: Array = self.parts.of(rows) < self._outside
        return found

    def _precondition(self, mean: Array) -> float:
        """Take the means of the free components off r; y = S (A^T A + rho)^+ S r; r y."""
        passes, total = self.passes, 0.0
        mean = np.where(self._free, mean, 0)
        scaling = self._scaling
        for rows in self._bands:
            self._r[rows] -= mean[self.parts.of(rows)].astype(self._r.dtype)
            scaled = scaling.of(rows) * self._r[rows]
            self._y[rows] = scaled if scaling.firm else rows_forward(as_tensor(scaled))
        if not scaling.firm:
            for columns in passes.strips():
                spectrum = columns_forward(self._y[:, columns])
                found = integrated(spectrum, columns, passes.size, passes.step, scaling.rho)
                self._y[:, columns] = columns_back(found)
        for rows in self._bands:
            back = self._y[rows] if scaling.firm else rows_back(self._y[rows])
            self._y[rows] = scaling.of(rows) * back + scaling.loose(rows) * self._r[rows]
            total += dot(self._r[rows], self._y[rows])
        return total

    def _step(self, rho: float) -> tuple[Array, float]:
        """Along p to the least energy; the means of r over the components, and the square of what else there is."""
        energy = 0.0
        for rows in self._bands:
            self._y[rows] = self._normal(rows, self._p)
            energy += dot(self._p[rows], self._y[rows])
        length, square = (rho / energy if energy > 0 else 0.0), 0.0
        sums = np.zeros_like(self.parts.size)
        for rows in self._bands:
            self.x[rows] += length * self._p[rows]
            self._r[rows] -= length * self._y[rows]
            square += dot(self._r[rows], self._r[rows])
            sums += self.parts.sums(rows, self._r[rows])
        lost = float((sums**2 / self.parts.size)[self._free].sum())
        return sums / self.parts.size, max(0.0, square - lost)

    def _right(self, rows: slice) -> Array:
        """A^T W v + r a of a band; 0 outside."""
        more = self._edges.more(rows)
        v, w = self._edges.slopes(more)
        b = self._back(v if w is None else w * v, rows, more)
        b = b if self._hold is None else b + self._hold.pull(rows)
        found: Array = np.where(self._inside(rows), b, 0)
        return found

    def _normal(self, rows: slice, x: Array) -> Array:
        """(A^T W A + r) x of a band."""
        more = self._edges.more(rows)
        slopes = GradientOperator("forward", self.passes.step)(as_tensor(np.array(x[more]))[None, None])
        b = self._back(slopes if self.passes.field.even else self._edges.trusts(more) * slopes, rows, more)
        return b if self._hold is None else b + self._hold.strength(rows) * x[rows]

    def _back(self, slopes: Tensor, rows: slice, more: slice) -> Array:
        """A^T of slopes on a band and one more row on either side, without those."""
        b = GradientOperator("forward", self.passes.step).adjoint(slopes)[0, 0]
        found: Array = b[rows.start - more.start :][: rows.stop - rows.start].numpy()
        return found


class Scaling:
    """The scalings s of the preconditioner, or the inverse of the square root of the diagonal where it is enough.

    Attributes:
        rho: the shift of the even solve between them.
        firm: whether the diagonal is all.
    """

    def __init__(self, passes: Passes, edges: Edges, hold: Hold | None, inside: Callable[[slice], Array]) -> None:
        self._inside, self._dtype = inside, passes.field.dtype
        self._scale: Array | None = None
        self.rho, self.firm = 0.0, False
        self._loose: Array | None = None
        if hold is None and passes.field.weight is None:
            return
        self._scale = passes.scratch("scale")
        k, shares, alive, least = sum(2 / d**2 for d in passes.step), 0.0, 0, 1.0
        for rows in passes.bands():
            total, r = self._total(passes, edges, hold, rows, k)
            share = np.divide(r, total, out=np.ones_like(total), where=total > 0)
            count, least = int(np.count_nonzero(total)), min(least, float(share.min()))
            shares, alive = shares + float(share.sum(dtype=np.float64)) - (total.size - count), alive + count
            self._scale[rows] = total
        q = shares / max(alive, 1)
        self.rho = k * q / max(1 - q, 1e-6)
        self.firm = self.rho > FIRM * k and least > _HELD
        self._loose = passes.scratch("loose") if passes.field.weight is not None and not self.firm else None
        for rows in passes.bands():
            diagonal, total = self._diagonal(passes, edges, hold, rows), self._scale[rows]
            if self._loose is not None:
                self._loose[rows] = np.divide(1, diagonal, out=np.zeros_like(total), where=diagonal < _LOOSE * total)
            total, top = (diagonal, 1.0) if self.firm else (total, k + self.rho)
            self._scale[rows] = np.sqrt(np.divide(top, total, out=np.zeros_like(total), where=total > 0))

    def of(self, rows: slice) -> Array:
        """(rows, W) s, 0 outside."""
        inside: Array = self._inside(rows)
        return inside.astype(self._dtype) if self._scale is None else inside * self._scale[rows]

    def loose(self, rows: slice) -> Array | float:
        """(rows, W) the inverse of the diagonal where a pixel hangs by edges far weaker than those around, else 0."""
        return 0.0 if self._loose is None else self._inside(rows) * self._loose[rows]

    def _total(
        self, passes: Passes, edges: Edges, hold: Hold | None, rows: slice, k: float
    ) -> tuple[Array, Array | float]:
        """k d + r of a band, with d the weight of the edges around a pixel, and r."""
        r = 0.0 if hold is None else hold.strength(rows)
        if passes.field.even:
            return np.full((rows.stop - rows.start, passes.size[1]), k, self._dtype) + r, r
        start = max(0, rows.start // BLOCK - 1) * BLOCK
        more = slice(start, min(passes.size[0], (-(-rows.stop // BLOCK) + 1) * BLOCK))
        d = local_weight(edges.trusts(more))[0, 0].numpy()[rows.start - start :][: rows.stop - rows.start]
        return (k * d + r).astype(self._dtype), r

    def _diagonal(self, passes: Passes, edges: Edges, hold: Hold | None, rows: slice) -> Array:
        more, scale = edges.more(rows), torch.tensor(passes.step).view(1, 2, 1, 1)
        w = edges.trusts(more)
        d = edge_ends(w / scale.to(w).square())[0, 0].numpy()[rows.start - more.start :][: rows.stop - rows.start]
        return d if hold is None else d + hold.strength(rows)


def dot(a: Array, b: Array) -> float:
    """Their product, summed in double precision."""
    return float(np.vdot(a, b)) if a.dtype == np.float64 else float(np.sum(a * b, dtype=np.float64))
