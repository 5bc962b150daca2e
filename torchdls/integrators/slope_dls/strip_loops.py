"""The loops that code strips of overlapping patches, compiled by Numba; `strips_fused` calls them, and nobody else.

A group holds patches of a few strips of rows. Half a patch wide blocks of columns stand side by side as lanes v: a
patch is block v and block v + 1, so that what was made of the columns of a block serves both patches that hold it.
Atoms are even or odd about the middle of a patch, so that sums and differences of mirrored samples are all that they
see, and products have half of the terms. Even atoms stand before odd ones.
"""

from __future__ import annotations

import numpy as np

from torchdls._compiled import compiled

_LANES = 256  # that a product takes at a time: their rows stay in the fastest cache


@compiled
def _product(A, X, Y, lanes):
    """Y = A X in the first lanes, for a small square A; two rows and four terms at a time."""
    h = A.shape[0]
    for start in range(0, lanes, _LANES):
        stop = min(start + _LANES, lanes)
        for i in range(0, h - 1, 2):
            y, z, first = Y[i, start:stop], Y[i + 1, start:stop], h % 4
            if first == 2 or first == 0:
                p, q = X[0, start:stop], X[1, start:stop]
                a0, a1, b0, b1 = A[i, 0], A[i, 1], A[i + 1, 0], A[i + 1, 1]
                if first == 2:
                    for v in range(len(y)):
                        y[v] = a0 * p[v] + a1 * q[v]
                        z[v] = b0 * p[v] + b1 * q[v]
                else:
                    r, t = X[2, start:stop], X[3, start:stop]
                    a2, a3, b2, b3 = A[i, 2], A[i, 3], A[i + 1, 2], A[i + 1, 3]
                    for v in range(len(y)):
                        y[v] = a0 * p[v] + a1 * q[v] + a2 * r[v] + a3 * t[v]
                        z[v] = b0 * p[v] + b1 * q[v] + b2 * r[v] + b3 * t[v]
                    first = 4
            else:
                y[:] = 0
                z[:] = 0
                for c in range(first):
                    a0, b0, p = A[i, c], A[i + 1, c], X[c, start:stop]
                    for v in range(len(y)):
                        y[v] += a0 * p[v]
                        z[v] += b0 * p[v]
            for c in range(first, h, 4):
                p, q, r, t = X[c, start:stop], X[c + 1, start:stop], X[c + 2, start:stop], X[c + 3, start:stop]
                a0, a1, a2, a3 = A[i, c], A[i, c + 1], A[i, c + 2], A[i, c + 3]
                b0, b1, b2, b3 = A[i + 1, c], A[i + 1, c + 1], A[i + 1, c + 2], A[i + 1, c + 3]
                for v in range(len(y)):
                    y[v] += a0 * p[v] + a1 * q[v] + a2 * r[v] + a3 * t[v]
                    z[v] += b0 * p[v] + b1 * q[v] + b2 * r[v] + b3 * t[v]
        if h % 2:
            y = Y[h - 1, start:stop]
            y[:] = 0
            for c in range(h):
                a0, p = A[h - 1, c], X[c, start:stop]
                for v in range(len(y)):
                    y[v] += a0 * p[v]


@compiled
def by_blocks(noise, columns):
    """(c, rows, s, s, columns) -> (c, rows, s, s, blocks): at every block that of its column."""
    flat = noise.reshape(-1, noise.shape[-1])
    found = np.empty((flat.shape[0], len(columns)), noise.dtype)
    for i in range(len(flat)):
        for b in range(len(columns)):
            found[i, b] = flat[i, columns[b]]
    return found.reshape((*noise.shape[:-1], len(columns)))


@compiled
def _gather(x, tops, starts, lanes, S):
    """Sums and differences of mirrored rows of the strips, block by block, into S (s, h lanes ..)."""
    s, blocks = S.shape[0], len(starts)
    for r in range(s // 2):
        for c in range(s // 2):
            even, odd = S[r, c * lanes : (c + 1) * lanes], S[s // 2 + r, c * lanes : (c + 1) * lanes]
            for m in range(len(tops)):
                a, b, v = x[tops[m] + r], x[tops[m] + s - 1 - r], m * blocks
                for k in range(blocks):
                    p, q = a[starts[k] + c], b[starts[k] + c]
                    even[v + k] = p + q
                    odd[v + k] = p - q


@compiled
def _scatter(S, tops, starts, lanes, total):
    """The transpose of `_gather`, added to `total`."""
    s, blocks = S.shape[0], len(starts)
    for r in range(s // 2):
        for c in range(s // 2):
            even, odd = S[r, c * lanes : (c + 1) * lanes], S[s // 2 + r, c * lanes : (c + 1) * lanes]
            for m in range(len(tops)):
                a, b, v = total[tops[m] + r], total[tops[m] + s - 1 - r], m * blocks
                for k in range(blocks):
                    p, q = even[v + k], odd[v + k]
                    a[starts[k] + c] += p + q
                    b[starts[k] + c] += p - q


@compiled
def _across(C, even, odd):
    """Sums and differences (h, lanes) of mirrored columns, from the blocks C (h, lanes) of one atom of the columns."""
    h, lanes = C.shape
    for c in range(h):
        left, right, e, o = C[c], C[h - 1 - c], even[c], odd[c]
        for v in range(lanes - 1):
            e[v] = left[v] + right[v + 1]
            o[v] = left[v] - right[v + 1]
        e[lanes - 1] = o[lanes - 1] = 0


@compiled
def _back_across(even, odd, weight, C):
    """The transpose of `_across`, each patch times its weight."""
    h, lanes = C.shape
    for c in range(h):
        to, e, o, f, d = C[c], even[c], odd[c], even[h - 1 - c], odd[h - 1 - c]
        to[0] = (e[0] + o[0]) * weight[0]
        for v in range(1, lanes):
            to[v] = (e[v] + o[v]) * weight[v] + (f[v - 1] - d[v - 1]) * weight[v - 1]


@compiled
def _threshold(F, noise, at, level, count):
    """Coefficients (h, lanes) above level x noise are kept and counted, others become 0.

    The noise (h, blocks) is of one strip, whose lanes begin at `at`.
    """
    blocks, one = noise.shape[1], F.dtype.type(1)
    levels, counts = level[at : at + blocks], count[at : at + blocks]
    for k in range(F.shape[0]):
        f, own = F[k, at : at + blocks], noise[k]
        for b in range(blocks):
            kept = one if abs(f[b]) > levels[b] * own[b] else one - one
            f[b] *= kept
            counts[b] += kept


@compiled
def _weights(count, trust, segments, strips, size, rule, weight):
    """Weights of the patches in the average by the lanes: rule 0 is "equal", 1 "count", 2 "size"."""
    blocks, one = len(segments), count.dtype.type(1)
    for m in range(strips):
        for b in range(blocks):
            v, k = m * blocks + b, segments[b]
            if k >= 0:
                weight[v] = trust[m % len(trust), k % trust.shape[1]]
                if rule > 0:
                    weight[v] *= (size * size if rule == 2 else 1) / (one + count[v])


@compiled
def _spread(weight, top, starts, size, line, total):
    """Adds the weight (blocks) of every patch of a strip to all of its pixels; `line` is room for a row."""
    half, blocks = size // 2, len(starts)
    for i in range(len(line)):
        line[i] = 0
    for c in range(half):
        line[starts[0] + c] += weight[0]
        for b in range(1, blocks):
            line[starts[b] + c] += weight[b] + weight[b - 1]
    for r in range(top, top + size):
        to = total[r]
        for i in range(len(line)):
            to[i] += line[i]


@compiled
def _code_group(
    x, atoms, back, noise, tops, rows, starts, segments, level, trust, rule, room, sums, thin, line, total, spread
):  # fmt: skip
    """A group of strips, see `code_strips`; `room`, `sums` (2, h, lanes), `thin` (3, lanes) .. are written to."""
    h, lanes = sums.shape[1:]
    s, size, blocks, (S, C) = 2 * h, h * lanes, len(starts), (room[: 2 * h], room[2 * h :])
    own, count, weight = thin
    own[:], count[:], weight[:] = np.inf, 0, 0
    for m in range(len(tops)):
        for b in range(blocks):
            if segments[b] >= 0:
                own[m * blocks + b] = level[m, segments[b]]
    _gather(x, tops, starts, lanes, S)
    for half in range(2):
        _product(atoms[half], S[half * h : half * h + h], C[half * h : half * h + h], size)
    for k in range(s):
        _across(C[k, :size].reshape(h, lanes), sums[0], sums[1])
        for half in range(2):
            f = room[2 * k + half, :size].reshape(h, lanes)
            _product(atoms[half], sums[half], f, lanes)
            for m in range(len(tops)):
                _threshold(f, noise[rows[m], k, half * h : half * h + h], m * blocks, own, count)
    _weights(count, trust, segments, len(tops), s, rule, weight)
    for k in range(s - 1, -1, -1):
        for half in range(2):
            _product(back[half], room[2 * k + half, :size].reshape(h, lanes), sums[half], lanes)
        _back_across(sums[0], sums[1], weight, C[k, :size].reshape(h, lanes))
    for half in range(2):
        _product(back[half], C[half * h : half * h + h], S[half * h : half * h + h], size)
    _scatter(S, tops, starts, lanes, total)
    for m in range(len(tops)):
        _spread(weight[m * blocks : (m + 1) * blocks], tops[m], starts, s, line, spread)


@compiled
def code_strips(x, atoms, noise, tops, rows, starts, segments, level, trust, rule, group, total, weight):
    """Codes strips of patches of fields (2 N, H, W); adds weighted estimates to `total` and the weights to `weight`.

    `atoms` (2, h, h) are the first halves of the even and the odd ones. Strip i begins at row tops[i] and has the noise
    noise[component, rows[i]] (s, s, blocks). Block b begins at column starts[b]; with the next it is patch segments[b]
    of its strip, or none where that is -1. `level` is (2 N, strips, patches), `trust` as well or one number; `group`
    strips are worked on at a time.
    """
    h, blocks = atoms.shape[1], len(starts)
    lanes = -(-group * blocks // 32) * 32
    back = np.empty_like(atoms)
    for half in range(2):
        back[half] = atoms[half].T
    # Coefficients take the place of what they are made of, and give it back. Rows are not a power of two apart.
    room = np.zeros((4 * h, h * lanes + 272), x.dtype)
    sums, thin, line = np.empty((2, h, lanes), x.dtype), np.empty((3, lanes), x.dtype), np.empty(x.shape[2], x.dtype)
    for i in range(len(x)):
        for first in range(0, len(tops), group):
            end = min(first + group, len(tops))
            own = trust[i, first:end] if len(trust) > 1 else trust[0]
            _code_group(
                x[i], atoms, back, noise[i % 2], tops[first:end], rows[first:end], starts, segments,
                level[i, first:end], own, rule, room, sums, thin, line, total[i], weight[i],
            )  # fmt: skip


@compiled
def add_turned(total, weight, to, to_weight):
    """Sums (2, pixels) of slopes (p + q, p - q) / sqrt 2, and their weights, added to those of p and q."""
    half, root = total.dtype.type(0.5), total.dtype.type(np.sqrt(0.5))
    for i in range(total.shape[1]):
        a, b = weight[0, i], weight[1, i]
        own = (a + b) * half
        p, q = total[0, i] / a, total[1, i] / b
        to[0, i] += (p + q) * root * own
        to[1, i] += (p - q) * root * own
        to_weight[0, i] += own
        to_weight[1, i] += own
