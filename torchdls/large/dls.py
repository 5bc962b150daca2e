r"""DLS out of core: patches come tile by tile, the height by conjugate gradients whose vectors are files.

    codes     of a patch depend on that patch and D alone: tile by tile, and sparse on disk between iterations
    atoms     depend on two sums over all patches, R B^T and B B^T: one sweep in the block order, exact (`TiledSweep`)
    height    (A^T A + 2 lam c) z = A^T v + 2 lam fold(D B), c patches hold a pixel: fold(D B) tile by tile (`System`)

So it is `DLS(learner=SoupDIL(order="block"), select=False)` of the whole surface to rounding. The tiles are those of
the grid of patches, and their windows overlap by what patches overlap.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor
from torchdls.dictionary import FixedDictionary, SoupDIL, TiledSweep
from torchdls.integrators import DLS, LeastSquares
from torchdls.integrators.dls.options import Exact
from torchdls.integrators.dls.settings import spans_patches
from torchdls.large.least_squares import least_squares
from torchdls.large.system import System, dot
from torchdls.large.transform import Passes
from torchdls.operators import Patches

AUTO_LAM = 0.5  # as in memory
_CG_STEPS = 500


def check_dls(method: DLS) -> None:
    """ValueError for options with which a surface cannot go tile by tile."""
    learner = method.learner
    sweeps = isinstance(learner, FixedDictionary) or (isinstance(learner, SoupDIL) and learner.order == "block")
    wrong = {
        "learner": not sweeps and method.learn != "fixed",
        "data_term": type(method.data_term) is not LeastSquares,
        "boundary": method.boundary != "neumann",
        "select": method.select is True or method._guarded,
        "height_step": not isinstance(method.height_step, Exact),
        "dictionary": method.dictionary.ndim == 3 and len(method.dictionary) > 1,
    }
    if any(wrong.values()):
        names = ", ".join(name for name, is_wrong in wrong.items() if is_wrong)
        able = "DLS(learner=SoupDIL(order='block') or 'fixed', select=False) with least squares and height_step='exact'"
        raise ValueError(f"large.integrate: {able} is done in tiles; {names} of {method!r} is another")


class Followed(NamedTuple):
    """What the iterations did: their number, and whether the height settled to the tolerance before the last."""

    iterations: int
    converged: bool


class Run:
    """DLS of one surface, by tiles.

    Args:
        passes: over a full rectangle.
        method: that `check_dls` takes.
        tile: side of the tiles, in pixels.
        noise: standard deviation of one gradient sample, for mu="auto".
    """

    def __init__(self, passes: Passes, method: DLS, tile: int, noise: float) -> None:
        self.unit = math.sqrt(passes.step[0] * passes.step[1])
        self.passes = replace(passes, step=(passes.step[0] / self.unit, passes.step[1] / self.unit))
        self.method, self.patches = method, method.patches
        self._z = self.passes.scratch("surface")
        for rows, height in least_squares(self.passes):
            self._z[rows] = height
        self._dtype = as_tensor(self._z[:1]).dtype
        D = method.dictionary.detach().to(self._dtype)
        self.D = D.reshape(1, *D.shape[-2:]) / D.reshape(1, *D.shape[-2:]).norm(dim=1, keepdim=True)
        automatic, mu = isinstance(method.mu, str), method.mu
        self.schedule = [noise] if isinstance(mu, str) else list(mu) if isinstance(mu, tuple) else [float(mu)]
        self.lam = AUTO_LAM if isinstance(method.lam, str) else float(method.lam)
        free = not isinstance(method.mu, tuple) and not self.schedule[0] > 0
        fits = self.patches.fit((1, 1, *self.passes.size))
        if not fits or (free and (automatic or spans_patches(method.dictionary, method.learner))):
            self.lam = 0.0  # least squares, as in memory
        self._tiles = list(tiles(self.patches, self.passes.size, tile)) if fits else []

    def follow(self) -> Followed:
        """Iterate until the height settles."""
        method, passes = self.method, self.passes
        if self.lam == 0:
            return Followed(0, True)
        hold = Pull(self.patches, passes, 2 * self.lam)
        system = System(replace(passes, say=lambda text: None), hold, self._z)
        first, before = passes.scratch("first"), passes.scratch("before")
        for rows in system.passes.bands():
            first[rows] = self._z[rows]
        last = len(self.schedule) - 1
        for iteration in range(method.n_iter):
            passes.say(f"iteration {iteration + 1} of {method.n_iter}, {len(self._tiles)} tiles")
            self._sweep(float(self.schedule[min(iteration, last)]))
            self._fold(hold.pulls)
            for rows in system.passes.bands():
                before[rows] = self._z[rows]
            assert isinstance(method.height_step, Exact)
            system.solve(method.height_step.tol, _CG_STEPS)
            changes = len(set(self.schedule[iteration:])) > 1
            step, way = (_distance(system.passes, self._z, other) for other in (before, first))
            if not changes and step <= method.tol * way and method.tol > 0:
                return Followed(iteration + 1, True)
        return Followed(method.n_iter, False)

    def heights(self) -> Iterator[tuple[slice, Array]]:
        """Bands of the height, of mean 0."""
        bands = replace(self.passes, say=lambda text: None).bands()
        total = sum(float(np.sum(self._z[rows], dtype=np.float64)) for rows in bands)
        mean = total / (self.passes.size[0] * self.passes.size[1])
        for rows in bands:
            yield rows, (self._z[rows] - mean) * self.unit

    def _sweep(self, mu: float) -> None:
        """One pass of the learner over the codes of all tiles, and their atoms."""
        learner, D = self.method.learner, self.D
        learned = self.method.learn != "fixed" and isinstance(learner, SoupDIL)
        for _ in range(getattr(learner, "n_sweeps", 1)):
            unused = {"unused": learner.unused} if isinstance(learner, SoupDIL) else {}
            sweep = TiledSweep(D, mu, self.method._settings.bound, threshold=self.method._settings.threshold, **unused)
            for k, window in enumerate(self._tiles):
                P = self.patches.extract(as_tensor(np.array(self._z[window]))[None, None])
                B = self._codes(k, P)
                _, B = sweep.codes(P - D @ B, B)
                self._keep(k, B)
            D = sweep.atoms() if learned else D
        self.D = D

    def _fold(self, pulls: Array) -> None:
        """2 lam fold(D B) of all tiles."""
        for rows in replace(self.passes, say=lambda text: None).bands():
            pulls[rows] = 0
        for k, window in enumerate(self._tiles):
            shape = tuple(part.stop - part.start for part in window)
            B = self._codes(k, self.D.new_zeros(1, 1, math.prod(self.patches.grid(shape))))
            pulls[window] += (2 * self.lam) * self.patches.adjoint(self.D @ B, shape)[0, 0].numpy()

    def _codes(self, k: int, like: Tensor) -> Tensor:
        """(1, K, L) codes of a tile; 0 before the first sweep."""
        B = like.new_zeros(1, self.D.shape[-1], like.shape[-1])
        place = self.passes.place / f"codes-{k}.npy"
        if place.exists():
            with open(place, "rb") as file:
                index, values = torch.from_numpy(np.load(file)), torch.from_numpy(np.load(file))
            B.view(-1)[index.long()] = values
        return B

    def _keep(self, k: int, B: Tensor) -> None:
        flat = B.reshape(-1)
        index = flat.nonzero()[:, 0]
        with open(self.passes.place / f"codes-{k}.npy", "wb") as file:
            np.save(file, index.int().numpy() if flat.numel() < 2**31 else index.numpy())
            np.save(file, flat[index].numpy())


class Pull:
    """What the patches hold the height by: r = 2 lam c, and r a = 2 lam fold(D B) in a file."""

    def __init__(self, patches: Patches, passes: Passes, weight: float) -> None:
        self.pulls = passes.scratch("pull")
        (h, w), dtype = passes.size, self.pulls.dtype
        # The number of patches is that along the rows times that along the columns.
        self._down = (weight * _coverage(h, patches, 0))[:, None].astype(dtype)
        self._across = _coverage(w, patches, 1).astype(dtype)

    def strength(self, rows: slice) -> Array:
        """(rows, W) 2 lam c."""
        found: Array = self._down[rows] * self._across
        return found

    def pull(self, rows: slice) -> Array:
        """(rows, W) 2 lam fold(D B)."""
        return self.pulls[rows]


def tiles(patches: Patches, size: tuple[int, int], tile: int) -> Iterator[tuple[slice, slice]]:
    """Windows whose own patches, taken together, are those of the whole, each once."""
    spans = []
    for axis in (0, 1):
        starts, each = _starts(size[axis], patches, axis), max(1, tile // patches._stride[axis])
        parts = (starts[k : k + each] for k in range(0, len(starts), each))
        spans.append([slice(part[0], part[-1] + patches._size[axis]) for part in parts])
    yield from ((down, across) for down in spans[0] for across in spans[1])


def _starts(n: int, patches: Patches, axis: int) -> list[int]:
    """Where the patches begin along an axis of n pixels; the last one ends with it."""
    last = n - patches._size[axis]
    starts = list(range(0, last + 1, patches._stride[axis]))
    return starts if starts[-1] == last else [*starts, last]


def _coverage(n: int, patches: Patches, axis: int) -> Array:
    """(n,) how many patches hold each pixel of an axis."""
    changes = np.zeros(n + 1)
    for start in _starts(n, patches, axis):
        changes[start] += 1
        changes[start + patches._size[axis]] -= 1
    found: Array = changes.cumsum()[:n]
    return found


def _distance(passes: Passes, a: Array, b: Array) -> float:
    total = 0.0
    for rows in passes.bands():
        difference = a[rows] - b[rows]
        total += dot(difference, difference)
    return math.sqrt(total)
