"""The adjoint of a SOUP-DIL sweep, with no more memory than the sweep: its steps are undone one by one.

A sweep is made of two kinds of steps, for row b and atom d (in the paper's order one after the other for each atom):

    row:   x = d^T R + b;  b' = shrink(x);  R' = R + d (b - b')
    atom:  h = R b'^T + d ||b'||^2;  d' = h / ||h||;  R' = R + (d - d') b'

Each gives back the residual before it from the one after it, so nothing has to be stored but the nonzero codes. The
support is frozen: only the patches of nonzero codes are touched.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.soup_dil import Order, Unused
from torchdls.dictionary.thresholds import Threshold

# Patches of one atom that are worked on at a time.
_PART = 4096


class Codes(NamedTuple):
    """The nonzero codes of each atom: the patches that use it, and the values."""

    patches: list[Tensor]
    values: list[Tensor]

    @staticmethod
    def of(B: Tensor) -> Codes:
        """From all codes (K, L)."""
        counts = B.count_nonzero(1).tolist()
        rows, columns = B.nonzero(as_tuple=True)
        values = B[rows, columns]
        return Codes(list(columns.clone().split(counts)), list(values.split(counts)))  # without the rows beside them

    @property
    def n_codes(self) -> int:
        """How many there are."""
        return sum(map(len, self.patches))

    def spread(self, values: list[Tensor], length: int) -> Tensor:
        """(K, L) other values at their places, 0 elsewhere."""
        rows = [v.new_zeros(length).index_copy_(0, s, v) for s, v in zip(self.patches, values, strict=True)]
        return torch.stack(rows)


class Slopes(NamedTuple):
    """Gradients with respect to the dictionary (n, K), the nonzero codes of each atom, and mu (one per patch, L)."""

    D: Tensor
    codes: list[Tensor]
    mu: Tensor


class Sweep(NamedTuple):
    """A sweep that was made: (n, K) dictionaries and the codes before and after it, mu (L), and its options."""

    D: Tensor
    codes: Codes
    D_after: Tensor
    codes_after: Codes
    mu: Tensor
    bound: float
    threshold: Threshold
    order: Order
    unused: Unused
    learn: bool

    def pull(self, R: Tensor, gR: Tensor, gD: Tensor, g_codes: list[Tensor]) -> Slopes:
        """The adjoint.

        Args:
            R: (L, n) residual after the sweep; overwritten by the one before it.
            gR: (L, n) gradient with respect to it; overwritten by that with respect to the one before.
            gD: (n, K) gradient with respect to the dictionary after the sweep.
            g_codes: gradients with respect to the nonzero codes of each atom after it.
        """
        new_codes = list(g_codes)
        slopes = Slopes(torch.zeros_like(gD) if self.learn else gD.clone(), list(g_codes), gR.new_zeros(len(gR)))
        atoms = range(self.D.shape[-1])
        if self.order == "atom" and self.learn:
            for i in reversed(atoms):
                self._undo_atom(i, R, gR, gD, new_codes, slopes)
                self._undo_row(i, R, gR, new_codes, slopes)
            return slopes
        for i in reversed(atoms if self.learn else range(0)):
            self._undo_atom(i, R, gR, gD, new_codes, slopes)
        for i in reversed(atoms):
            self._undo_row(i, R, gR, new_codes, slopes)
        return slopes

    def _undo_atom(self, i: int, R: Tensor, gR: Tensor, gD: Tensor, new_codes: list[Tensor], slopes: Slopes) -> None:
        d, d1, s, b = self.D[:, i], self.D_after[:, i], self.codes_after.patches[i], self.codes_after.values[i]
        _add(R, s, b, d1 - d)
        square, through = b @ b, _weigh(gR, s, b)
        h = _weigh(R, s, b) + d * square
        to_atom, size = gD[:, i] - through, h.norm()
        slopes.D[:, i] += through
        if not size > 0:  # no patch uses it
            slopes.D[:, i] += to_atom if self.unused == "keep" else 0
            return
        gh = (to_atom - d1 * (d1 @ to_atom)) / size
        slopes.D[:, i] += gh * square
        new_codes[i] = new_codes[i] + _project(gR, s, d - d1) + _project(R, s, gh) + 2 * (d @ gh) * b
        _add(gR, s, b, gh)

    def _undo_row(self, i: int, R: Tensor, gR: Tensor, new_codes: list[Tensor], slopes: Slopes) -> None:
        d, (s, s1) = self.D[:, i], (self.codes.patches[i], self.codes_after.patches[i])
        b, b1 = self.codes.values[i], self.codes_after.values[i]
        _add(R, s, -b, d)
        _add(R, s1, b1, d)
        gx = self._through_threshold(b1, s1, new_codes[i] - _project(gR, s1, d), slopes.mu)
        slopes.D[:, i] += _weigh(gR, s, b) - _weigh(gR, s1, b1) + _weigh(R, s1, gx)
        slopes.codes[i] = _project(gR, s, d) + gR.new_zeros(len(gR)).index_copy_(0, s1, gx)[s]
        _add(gR, s1, gx, d)

    def _through_threshold(self, b: Tensor, patches: Tensor, gb: Tensor, g_mu: Tensor) -> Tensor:
        """From nonzero codes to what they were before the threshold; codes at the bound do not move."""
        g = torch.where(b.abs() < self.bound, gb, 0)
        if self.threshold == "hard":
            return g
        if self.threshold == "firm":
            g, moved = torch.where(b.abs() < 2 * self.mu[patches], 2, 1) * g, b.abs() < 2 * self.mu[patches]
        else:
            moved = torch.ones_like(b, dtype=torch.bool)
        g_mu.index_add_(0, patches, torch.where(moved, -b.sign() * g, 0))
        return g


# Some rows s of X (L, n), a part of them at a time: an atom that all patches use would need a copy of X.


def _project(X: Tensor, s: Tensor, d: Tensor) -> Tensor:
    """X_s d."""
    return torch.cat([X[part] @ d for part in s.split(_PART)])


def _weigh(X: Tensor, s: Tensor, b: Tensor) -> Tensor:
    """X_s^T b."""
    parts = zip(s.split(_PART), b.split(_PART), strict=True)
    return reduce(torch.add, (X[part].mT @ c for part, c in parts))


def _add(X: Tensor, s: Tensor, b: Tensor, d: Tensor) -> None:
    """X_s += b d^T."""
    for part, c in zip(s.split(_PART), b.split(_PART), strict=True):
        X.index_add_(0, part, torch.outer(c, d))
