"""The codes of one surface with the atoms held fixed, chunk by chunk in the same memory, where nothing is recorded.

A chunk stays in the cache from its residual to its share of R B^T and B B^T. Its D^T R is one product; from there rows
follow by what the rows before them have changed, those far before by a product with a block, the last few one by one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.thresholds import Threshold, cut, shrink

_CHUNK = 16384  # patches: long enough that the loop over the atoms costs little, short enough for the cache
_FEW = 8  # rows that follow one by one


class Shrinkage(NamedTuple):
    """How codes are shrunk: the threshold of each atom, the bound and the rule."""

    levels: Sequence[float]
    bound: float
    threshold: Threshold

    def apply(self, x: Tensor, atom: int) -> None:
        """To a row of codes, in place."""
        if self.threshold != "hard":
            x.copy_(shrink(x, self.levels[atom], self.bound, self.threshold))
            return
        torch.ops.aten.hardshrink.out(x, cut(self.levels[atom], self.bound), out=x)
        if not math.isinf(self.bound):
            x.clamp_(-self.bound, self.bound)


def update_codes(R: Tensor, D: Tensor, B: Tensor, how: Shrinkage, patches: bool) -> tuple[Tensor, Tensor]:
    """B (K, L) and R (n, L) are brought up to date; with `patches` R is P instead, and stays as it is.

    Returns:
        R B^T (n, K) and B B^T (K, K).
    """
    (n, L), K = R.shape, D.shape[1]
    H, C, G = R.new_zeros(n, K), R.new_zeros(K, K), D.mT @ D
    length = min(L, _CHUNK)
    Q, moved = R.new_empty(K, length), R.new_empty(K, length)
    room = R.new_empty(n if patches else 0, length)
    for first in range(0, L, length):
        r, b = R[:, first : first + length], B[:, first : first + length]
        q, d = Q[:, : r.shape[1]], moved[:, : r.shape[1]]
        r = torch.addmm(r, D, b, alpha=-1, out=room[:, : r.shape[1]]) if patches else r
        torch.addmm(b, D.mT, r, out=q)
        _follow(q, b, d, G, how)
        r.addmm_(D, d)
        b.copy_(q)
        H.addmm_(r, b.mT)
        C.addmm_(q, q.mT)
    return H, C


def _follow(q: Tensor, b: Tensor, d: Tensor, G: Tensor, how: Shrinkage) -> None:
    """Rows of D^T R + B to new codes, one after the other; d becomes what they have changed, old - new."""
    new, old, change = q.unbind(), b.unbind(), d.unbind()
    for start, end, reach in _order(0, len(G)):
        if reach:
            q[end:reach].addmm_(G[end:reach, start:end], d[start:end])
            continue
        for k in range(start, end):
            if k > start:
                new[k].addmv_(d[start:k].mT, G[k, start:k])
            how.apply(new[k], k)
            torch.sub(old[k], new[k], out=change[k])


def _order(start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(first, last, 0): few rows one by one; (first, last, reach): what these have changed, for all up to `reach`."""
    if end - start <= _FEW:
        yield start, end, 0
        return
    middle = (start + end) // 2
    yield from _order(start, middle)
    yield start, middle, end
    yield from _order(middle, end)
