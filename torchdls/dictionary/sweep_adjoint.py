"""The adjoint of a SOUP-DIL sweep, with no more memory than the sweep: its steps are undone one by one.

A sweep is made of two kinds of steps, for row b and atom d (in the paper's order one after the other for each atom):

    row:   x = d^T R + b;  b' = shrink(x);  R' = R + d (b - b')
    atom:  h = R b'^T + d ||b'||^2;  d' = h / ||h||;  R' = R + (d - d') b'

Each gives back the residual before it from the one after it, so nothing has to be stored but the nonzero codes. The
support is frozen: only the patches of nonzero codes are touched.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.soup_dil import Order, Unused
from torchdls.dictionary.thresholds import Threshold


class Codes(NamedTuple):
    """The nonzero codes of each atom: the patches that use it, and the values."""

    patches: list[Tensor]
    values: list[Tensor]

    @staticmethod
    def of(B: Tensor) -> Codes:
        """From all codes (K, L)."""
        counts = B.count_nonzero(1).tolist()
        rows, columns = B.nonzero(as_tuple=True)
        return Codes(list(columns.split(counts)), list(B[rows, columns].split(counts)))

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
        R.index_add_(0, s, torch.outer(b, d1 - d))
        residual, pull, square = R[s], gR[s], b @ b
        through, h = pull.mT @ b, residual.mT @ b + d * square
        to_atom, size = gD[:, i] - through, h.norm()
        slopes.D[:, i] += through
        if not size > 0:  # no patch uses it
            slopes.D[:, i] += to_atom if self.unused == "keep" else 0
            return
        gh = (to_atom - d1 * (d1 @ to_atom)) / size
        slopes.D[:, i] += gh * square
        new_codes[i] = new_codes[i] + pull @ (d - d1) + residual @ gh + 2 * (d @ gh) * b
        gR.index_add_(0, s, torch.outer(b, gh))

    def _undo_row(self, i: int, R: Tensor, gR: Tensor, new_codes: list[Tensor], slopes: Slopes) -> None:
        d, (s, s1) = self.D[:, i], (self.codes.patches[i], self.codes_after.patches[i])
        b, b1 = self.codes.values[i], self.codes_after.values[i]
        R.index_add_(0, s, torch.outer(-b, d))
        R.index_add_(0, s1, torch.outer(b1, d))
        pull, pull1 = gR[s], gR[s1]
        gx = self._through_threshold(b1, s1, new_codes[i] - pull1 @ d, slopes.mu)
        slopes.D[:, i] += pull.mT @ b - pull1.mT @ b1 + R[s1].mT @ gx
        slopes.codes[i] = pull @ d + gR.new_zeros(len(gR)).index_copy_(0, s1, gx)[s]
        gR.index_add_(0, s1, torch.outer(gx, d))

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
