"""The loops of a fused sweep, compiled by Numba; `sweep_fused` calls them, and nobody else.

Patches, codes and atoms stand in rows here: R (L, n), codes (L, K), atoms (K, n). Few codes of a patch are nonzero or
change, so all but one dense product, which is left to PyTorch, runs over these alone.
"""

from __future__ import annotations

import numpy as np

from torchdls._compiled import compiled

_EXACT = 256  # terms that are summed in the dtype of the patches, before double precision takes over
_STREAMS = 8  # columns that are read side by side


@compiled
def _shrunk(x, cut, bound, rule):
    """`thresholds.shrink` of one number; rule 0 is "hard", 1 "soft", 2 "firm"."""
    if not abs(x) > cut:
        return x - x  # 0
    b = x
    if rule > 0 and (rule == 1 or abs(x) <= cut + cut):
        b = x - cut if x > 0 else x + cut
        if rule == 2:
            b = b + b
    return min(max(b, -bound), bound)


@compiled
def bring(X, rows):
    """Rows of X (L, m) into contiguous ones; in X, as `unfold` lays patches out, say, neighbours may lie far apart.

    A few columns at a time, as many as the processor fetches ahead of.
    """
    L, m = X.shape
    for start in range(0, m, _STREAMS):
        end = min(start + _STREAMS, m)
        for i in range(L):
            for k in range(start, end):
                rows[i, k] = X[i, k]


@compiled
def subtract(R, codes, atoms):
    """R -= D b for patches (L, n) and their codes (L, K)."""
    own = np.empty(codes.shape[1] + 1, np.int64)
    for i in range(R.shape[0]):
        m = 0
        for k in range(codes.shape[1]):  # without a branch
            own[m] = k
            m += codes[i, k] != 0
        for t in range(m):
            k = own[t]
            b = codes[i, k]
            for p in range(R.shape[1]):
                R[i, p] -= b * atoms[k, p]


@compiled
def subtract_used(R, used, values, counts, atoms):
    """R -= D b from the lists that `update_codes` leaves."""
    at = 0
    for i in range(R.shape[0]):
        for t in range(at, at + counts[i]):
            k, b = np.int64(used[t]), values[t]
            for p in range(R.shape[1]):
                R[i, p] -= b * atoms[k, p]
        at += counts[i]


@compiled
def update_codes(R, Q, codes, used, values, counts, moves, cut, bound, rule, H, C):
    """All codes of some patches with the atoms held fixed.

    R (L, n) and `codes` (L, K) are brought up to date. Q (L, K) is D^T r. Row k of `moves` (K, K + n) says what a
    change of code k does to D^T r of the atoms after it, and to r. b r^T and b b^T are added to H (K, n) and C (K, K).
    `used`, `values` and `counts` become the atoms that the patches use, one patch after the other, their codes, and how
    many they are.
    """
    (L, n), K, at = R.shape, Q.shape[1], 0
    state, own = np.empty(K + n, R.dtype), np.empty(K, np.int64)
    for i in range(L):
        m = 0
        for k in range(K):
            state[k] = Q[i, k] + codes[i, k]
        for p in range(n):
            state[K + p] = R[i, p]
        for k in range(K):
            old = codes[i, k]
            if abs(state[k]) > cut[k] or old != 0:
                new = _shrunk(state[k], cut[k], bound, rule)
                codes[i, k] = new
                change = old - new
                for p in range(K + n):
                    state[p] += change * moves[k, p]
                if new != 0:
                    own[m] = k
                    m += 1
        for p in range(n):
            R[i, p] = state[K + p]
        for t in range(m):
            k = own[t]
            b = codes[i, k]
            for p in range(n):
                H[k, p] += b * state[K + p]
            for c in range(m):
                C[k, own[c]] += b * codes[i, own[c]]
            used[at + t], values[at + t] = k, b
        counts[i] = m
        at += m


@compiled
def _as_atom(h, old, keep, new):
    """h / ||h|| into `new`; where h = 0, the atom of before or the first unit vector."""
    square = 0.0
    for p in range(len(h)):
        square += np.float64(h[p]) * h[p]
    some = False
    for p in range(len(h)):
        new[p] = h[p] / np.sqrt(square) if square > 0 else 0
        some |= new[p] != 0
    if not some:
        for p in range(len(h)):
            new[p] = old[p] if keep else p == 0


@compiled
def update_atoms(H, C, atoms, keep, new):
    """All atoms (K, n) with the codes held fixed, from H and C, into `new`; H is overwritten."""
    K, n = atoms.shape
    for k in range(K):
        for p in range(n):
            H[k, p] += atoms[k, p] * C[k, k]
    for k in range(K):
        _as_atom(H[k], atoms[k], keep, new[k])
        for j in range(k + 1, K):
            if C[k, j] != 0:
                for p in range(n):
                    H[j, p] -= (new[k, p] - atoms[k, p]) * C[k, j]


@compiled
def update_group(R, Q, B, atoms, start, cut, bound, rule, keep, new, where, before, after):
    """Row, atom, row, atom, .. of a group of atoms from `start` on.

    R (m L, n) holds the patches of m surfaces one after the other, B (m, K, L) their codes, Q (g, m L) is D^T R of the
    atoms of the group; all are brought up to date, and the atoms go into `new` (K, n). `where`, `before` and `after`
    (m L) are room for the patches of one atom and their codes.
    """
    n, L = R.shape[1], B.shape[2]
    part, total = np.empty(n, R.dtype), np.empty(n, np.float64)
    for j in range(Q.shape[0]):
        k = start + j
        d, e, count = atoms[k], new[k], 0
        for s in range(B.shape[0]):
            begin = count
            for i in range(L):  # without a branch
                old = B[s, k, i]
                where[count] = i
                count += (abs(Q[j, s * L + i] + old) > cut[s, k]) | (old != 0)
            for t in range(begin, count):
                i = where[t]
                where[t] = s * L + i
                before[t] = B[s, k, i]
                B[s, k, i] = after[t] = _shrunk(Q[j, s * L + i] + before[t], cut[s, k], bound, rule)
        along = 0.0
        total[:] = 0
        for begin in range(0, count, _EXACT):
            part[:] = 0
            for t in range(begin, min(begin + _EXACT, count)):
                b, row = after[t], R[where[t]]
                along += b * before[t]
                for p in range(n):
                    part[p] += b * row[p]
            for p in range(n):
                total[p] += part[p]
        for p in range(n):
            total[p] += along * d[p]
        _as_atom(total, d, keep, e)
        for t in range(count):
            a, b, row = before[t], after[t], R[where[t]]
            for p in range(n):
                row[p] += a * d[p] - b * e[p]
        for i in range(j + 1, Q.shape[0]):
            was, now = np.dot(d, atoms[start + i]), np.dot(e, atoms[start + i])
            for t in range(count):
                Q[i, where[t]] += before[t] * was - after[t] * now
