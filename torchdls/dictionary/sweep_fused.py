"""A sweep of SOUP-DIL by compiled loops (the extra `fast`), where nothing is recorded and the tensors are on the CPU.

It does what `soup_dil` does, without what is 0: one dense product D^T R, then patch by patch only the atoms that a
patch uses or used. Rounding differs, so a code that is within it of the threshold may be kept in one and not in the
other.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._compiled import Workers
from torchdls.dictionary.thresholds import THRESHOLDS, Threshold

_CHUNK = 2048  # patches of one thread that are worked on at a time: they stay in the cache
_GROUP = 16  # atoms of the paper's order that share one product with the residual


def _loops() -> ModuleType:
    """Loaded when first used: Numba takes half a second."""
    from torchdls.dictionary import sweep_loops

    return sweep_loops


class _How(NamedTuple):
    """The options of a sweep, as the loops take them."""

    bound: Any
    rule: int
    keep: bool
    learn: bool
    patches: bool


def sweep(
    R: Tensor,
    D: Tensor,
    B: Tensor,
    cut: Tensor,
    bound: float = math.inf,
    threshold: Threshold = "hard",
    keep: bool = False,
    *,
    atom_order: bool = True,
    learn: bool = True,
    patches: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """One sweep, see `soup_dil_sweep`; R and B are overwritten where they lie as the loops need them.

    So they do when they come from a sweep before: then patches are contiguous in R, and in B rows in the order of the
    paper, patches otherwise.

    Args:
        R: (N, n, L) residual, or with `patches` the patches, which stay as they are.
        D: (N, n, K), or (1, n, K) shared.
        B: (N, K, L).
        cut: (N or 1, K), up to where a code is cut.
        bound: of the codes.
        threshold: "hard", "soft" or "firm".
        keep: unused atoms stay as they are.
        atom_order: row, atom, row, atom; or all rows and then all atoms.
        learn: False keeps D.
        patches: R is given as patches, and the residual afterwards is not asked for.

    Returns:
        R (with `patches`, whatever it was used for), D and B.
    """
    R, D, B = R.detach(), D.detach(), B.detach()
    by_atom = atom_order and learn
    if not patches:
        codes, rows, before = (B if by_atom else B.mT).contiguous(), R.mT.contiguous(), B
    elif by_atom:
        codes = B.clone(memory_format=torch.contiguous_format)
        rows, before = torch.baddbmm(R.mT, B.mT, D.mT.expand(len(R), -1, -1), alpha=-1), B
    else:
        codes, rows, before = torch.empty_like(B.mT, memory_format=torch.contiguous_format), R.mT, B.mT
    cut = cut.to(B).expand(len(B), -1).contiguous()
    how = _How(B.new_full((), bound).numpy()[()], THRESHOLDS.index(threshold), keep, learn, patches)
    step, new = _atom_order if by_atom else _block_order, []
    alone = len(D) == 1 and learn and len(R) > 1
    for i in (slice(None),) if alone else (slice(k, k + 1) for k in range(len(R))):
        new.append(step(rows[i], D[0 if len(D) == 1 else i.start], codes[i], before[i], cut[i], how))
    return rows.mT, torch.stack(new) if learn else D, codes if by_atom else codes.mT


def _block_order(R: Tensor, D: Tensor, codes: Tensor, before: Tensor, cut: Tensor, how: _How) -> Tensor:
    """All codes, then all atoms, of surfaces (m, L, n) and (m, L, K) with one dictionary (n, K), which comes back.

    With patches in place of the residual, `before` holds the codes to start from, and `codes` has room for them.
    """
    loops, (n, K), length = _loops(), D.shape, _CHUNK * torch.get_num_threads()
    atoms = D.mT.contiguous()
    moves = torch.cat([(atoms @ D).triu(1), atoms], 1).numpy()
    H, C = (R.new_zeros(K, k, dtype=torch.float64) for k in (n, K))
    Q, room = codes.new_empty(min(length, R.shape[1]), K), R.new_empty(min(length, R.shape[1]) if how.patches else 0, n)
    kept = codes[:, :length] if how.patches else codes  # lists of codes that `follow` reads, or nobody
    values, used = torch.empty_like(kept), torch.empty_like(kept, dtype=torch.int16)
    counts = used.new_empty(kept.shape[:2])

    def update(level: Any, r: Tensor, q: Tensor, b: Tensor, *lists: Tensor) -> tuple[Tensor, Tensor]:
        h, c, (u, v, many) = R.new_zeros(K, n), R.new_zeros(K, K), lists
        given = (x.numpy() for x in (r, q, b, u.view(-1), v.view(-1), many))
        loops.update_codes(*given, moves, level, how.bound, how.rule, h.numpy(), c.numpy())
        return h, c

    with Workers() as workers:
        for i, part in _chunks(R, length):
            r, b = R[i, part], codes[i, part]
            if how.patches:
                r, P = room[: len(r)], r
                workers.split(functools.partial(_subtract, atoms), P, before[i, part], r, b)
            q = torch.mm(r, D, out=Q[: len(r)])
            level = cut[i].numpy()
            lists = (x[i, slice(len(r)) if how.patches else part] for x in (used, values, counts))
            for h, c in workers.split(functools.partial(update, level), r, q, b, *lists):
                H += h
                C += c
        if not how.learn:
            return D
        new = torch.empty_like(atoms)
        loops.update_atoms(H.numpy(), C.numpy(), atoms.numpy(), how.keep, new.numpy())
        step = (new - atoms).numpy()

        def follow(r: Tensor, u: Tensor, v: Tensor, many: Tensor) -> None:
            loops.subtract_used(r.numpy(), u.view(-1).numpy(), v.view(-1).numpy(), many.numpy(), step)

        for i, part in () if how.patches else _chunks(R, length):
            workers.split(follow, *(x[i, part] for x in (R, used, values, counts)))
    return new.mT


def _atom_order(R: Tensor, D: Tensor, codes: Tensor, _: Tensor, cut: Tensor, how: _How) -> Tensor:
    """Row, atom, row, atom, .. for surfaces (m, L, n) and (m, K, L) with one dictionary (n, K), which comes back."""
    loops, rows, atoms = _loops(), R.flatten(0, 1), D.mT.contiguous()
    new, count = torch.empty_like(atoms), len(rows)
    Q, (before, after) = R.new_empty(_GROUP, count), R.new_empty(2, count)
    where = R.new_empty(count + 1, dtype=torch.int64)
    for start in range(0, len(atoms), _GROUP):
        group = atoms[start : start + _GROUP]
        q = torch.mm(group, rows.mT, out=Q[: len(group)])
        loops.update_group(
            rows.numpy(), q.numpy(), codes.numpy(), atoms.numpy(), start, cut.numpy(), how.bound, how.rule, how.keep,
            new.numpy(), where.numpy(), before.numpy(), after.numpy(),
        )  # fmt: skip
    return new.mT


def _subtract(atoms: Tensor, *given: Tensor) -> None:
    """R = P - B D^T from rows of P and B in any layout, and `codes` = B."""
    P, B, R, codes = (x.numpy() for x in given)
    loops = _loops()
    loops.bring(P, R)
    loops.bring(B, codes)
    loops.subtract(R, codes, atoms.numpy())


def _chunks(R: Tensor, length: int) -> Iterator[tuple[int, slice]]:
    """Surface and patches, as many as all threads take at a time."""
    return ((i, slice(k, k + length)) for i in range(R.shape[0]) for k in range(0, R.shape[1], length))
