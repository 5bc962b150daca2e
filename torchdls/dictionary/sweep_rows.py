"""Row, atom, row, atom, .. of one surface in the same memory, where nothing is recorded.

Most patches use few atoms. So of the residual a row and its atom read and change alone those patches that the atom is
in before or after; D^T R is one product for a group of atoms, whose later rows follow by what the rows before change.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchdls.dictionary.sweep_chunks import Shrinkage

_GROUP = 16  # atoms that share one product with the residual
_MANY = 0.2  # part of the patches from which on the whole residual is updated, rather than what is used of it


def update_rows(R: Tensor, D: Tensor, B: Tensor, how: Shrinkage, atom: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """B (K, L) and R (L, n), both contiguous, are brought up to date, and the atoms (n, K) come back.

    `atom` makes one of h = E b^T (n,), in place of the one of before. With the residual R of the moment and b' the row
    of before, E = R + d b', so that h = R b^T + d (b' b^T), and R += d b' - (new atom) b.
    """
    new, Q = torch.empty_like(D), B.new_empty(min(_GROUP, len(B)), len(R))
    for start in range(0, D.shape[1], _GROUP):
        d, b = D[:, start : start + _GROUP], B[start : start + _GROUP]
        q = torch.mm(d.mT, R.mT, out=Q[: len(b)])
        for k in range(len(q)):
            how.apply(q[k].add_(b[k]), start + k)
            used = _used(q[k], b[k])
            whole = len(used) > _MANY * len(R)
            codes = torch.stack([x if whole else x.index_select(0, used) for x in (b[k], q[k])])
            r = R if whole else R.index_select(0, used)
            h = codes[1] @ r + d[:, k] * (codes[0] @ codes[1])
            e = new[:, start + k] = atom(h, d[:, k])
            steps = torch.stack([d[:, k], -e])
            r.addmm_(codes.mT, steps)
            if not whole:
                R.index_copy_(0, used, r)
            _follow(q[k + 1 :], (steps @ d[:, k + 1 :]).mT, codes, None if whole else used)
            b[k] = q[k]
    return new


def _used(row: Tensor, before: Tensor) -> Tensor:
    """Which patches an atom is in, before or after."""
    some = row.bool().bitwise_or_(before.bool())
    if some.device.type != "cpu":
        return some.nonzero()[:, 0]
    return torch.from_numpy(some.numpy().nonzero()[0])  # in less time


def _follow(q: Tensor, change: Tensor, codes: Tensor, used: Tensor | None) -> None:
    """Rows after an atom by what it has changed: q += change codes, where it was used."""
    if used is None:
        q.addmm_(change, codes)
        return
    for row, step in zip(q, change @ codes, strict=True):
        row.index_add_(0, used, step)
