"""Sparse coding by orthogonal matching pursuit, many patches at once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_real
from torchdls._precision import full_precision

_CHUNK = 8192  # patches worked on at once
_APART = 1e3  # in units of rounding: the least squared distance of an atom from the span of the others of a patch


@full_precision
def orthogonal_matching_pursuit(
    P: Tensor, D: Tensor, n_nonzero: int | None = None, *, mu: float | Tensor = 0.0, tol: float | Tensor = 0.0
) -> Tensor:
    r"""Codes B (N, K, L) of patches, one atom at a time.

    Each patch p takes the atom of largest |d_i^T r|, with r its residual, and fits all atoms it has taken by least
    squares; an atom that depends on those taken before, so that |r|^2 does not fall, is dropped. It stops with
    `n_nonzero` atoms, at |r|^2 <= tol, or when no |d_i^T r| exceeds mu: an atom lowers |r|^2 by at least (d_i^T r)^2,
    so that each step lowers |r|^2 + mu^2 ||b||_0. Differentiable, with the support of B frozen.

    Args:
        P: (N, n, L) patches.
        D: (N, n, K), or (1, n, K) for all; unit-norm atoms.
        n_nonzero: most atoms of a patch; None for no limit but n.
        mu: least correlation, at least 0: a number or a tensor that broadcasts to (N, L).
        tol: squared residual that suffices: a number or a tensor that broadcasts to (N, L).

    Raises:
        TypeError: P is not float32 or float64, D of another dtype, or a tensor `mu` or `tol` not of floats.
        ValueError: shapes do not fit, or `n_nonzero` is not an integer of at least 1.
        TypeError: P and D are not tensors of one dtype, float32 or float64.

    Source: Pati, Rezaiifar, Krishnaprasad, "Orthogonal matching pursuit", 1993; Rubinstein, Zibulevsky, Elad,
    "Efficient implementation of the K-SVD algorithm using batch orthogonal matching pursuit", 2008.

    Example:
        >>> D = torch.eye(3)[None]
        >>> torchdls.orthogonal_matching_pursuit(torch.tensor([[[0.1], [2.0], [1.0]]]), D, n_nonzero=1)[0, :, 0]
        tensor([0., 2., 0.])
    """
    check_real("orthogonal_matching_pursuit", "P", P)
    check_alike("orthogonal_matching_pursuit", "D", D, P.dtype)
    if (
        P.ndim != 3
        or D.ndim != 3
        or D.shape[0] not in (1, P.shape[0])
        or D.shape[1] != P.shape[1]
        or 0 in (*P.shape, *D.shape)
    ):
        shapes = f"P {tuple(P.shape)} and D {tuple(D.shape)} do not fit"
        raise ValueError(f"orthogonal_matching_pursuit: {shapes}; (N, n, L) and (N or 1, n, K) are needed")
    if n_nonzero is not None and (not isinstance(n_nonzero, int) or n_nonzero < 1):
        raise ValueError(f"n_nonzero: {n_nonzero!r} given, an integer of at least 1 is needed")
    N, n, L = P.shape
    for label, level in (("mu", mu), ("tol", tol)):
        if not isinstance(level, Tensor):
            continue
        check_real("orthogonal_matching_pursuit", label, level)
        if not _broadcasts(level.shape, (N, L)):
            raise ValueError(
                f"orthogonal_matching_pursuit: {label} {tuple(level.shape)} given, it must broadcast to ({N}, {L})"
            )
    limit = min(n, D.shape[-1], n if n_nonzero is None else n_nonzero)
    least, enough = (torch.as_tensor(t, dtype=P.dtype, device=P.device).expand(N, L) for t in (mu, tol))
    codes = []
    for i in range(N):
        d = D[i if D.shape[0] > 1 else 0]
        columns = zip(P[i].split(_CHUNK, -1), least[i].split(_CHUNK), enough[i].split(_CHUNK), strict=True)
        codes.append(torch.cat([_pursue(p, d, limit, m, t) for p, m, t in columns], 0).mT)
    return torch.stack(codes)


def _broadcasts(shape: Sequence[int], to: tuple[int, ...]) -> bool:
    wanted = to[len(to) - len(shape) :]
    return len(shape) <= len(to) and all(a in (1, b) for a, b in zip(shape, wanted, strict=True))


def _pursue(P: Tensor, D: Tensor, limit: int, least: Tensor, enough: Tensor) -> Tensor:
    """(L, K) codes of patches (n, L) in one dictionary: the atoms are found first, then fitted, which has a derivative.

    An atom stays only if the fit with it leaves less of the patch, as measured, and if it is so far from the span of
    those before it that rounding does not decide its code.
    """
    gram, start = D.mT @ D, P.mT @ D
    codes = torch.zeros_like(start)
    with torch.no_grad():
        found = _supports(P, D, gram, start, limit, least, enough)
    for rows, atoms, kept in found:
        inner, target = _equations(gram, start[rows], atoms, kept)
        codes = codes.index_put((rows[:, None].expand_as(atoms), atoms), torch.linalg.solve(inner, target))
    return codes


def _supports(
    P: Tensor, D: Tensor, gram: Tensor, start: Tensor, limit: int, least: Tensor, enough: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Patches (l,), the atoms that they tried in turn (l, k), and which of these they kept; all patches, in parts."""
    left = P.square().sum(0)
    floor = torch.maximum(least, 10 * torch.finfo(P.dtype).eps * left.sqrt())  # rounding is no signal
    rows = torch.arange(P.shape[1], device=P.device)
    atoms, kept, correlation = rows.new_zeros(len(rows), 0), rows.new_zeros(len(rows), 0) > 0, start
    done = []
    for _ in range(D.shape[-1]):
        size, atom = correlation.abs().scatter(1, atoms, -1.0).max(1)
        go = (size > floor[rows]) & (left > enough[rows]) & (kept.sum(1) < limit)
        done.append((rows[~go], atoms[~go], kept[~go]))
        rows, before, old = rows[go], left[go], correlation[go]
        if not len(rows):
            return done
        atoms, kept = (torch.cat([t[go], new[go, None]], 1) for t, new in ((atoms, atom), (kept, atom >= 0)))
        inner, target = _equations(gram, start[rows], atoms, kept)
        last = torch.zeros_like(target)
        last[:, -1] = 1
        (x, inverse), failed = _solve_two(inner, target, last)
        residual = P.mT[rows] - torch.zeros_like(old).scatter(1, atoms, x) @ D.mT
        left = residual.square().sum(1)
        apart = 1 / inverse[:, -1]  # squared distance of the atom from those before it
        better = (left < before) & (apart > _APART * torch.finfo(P.dtype).eps) & (failed == 0)
        kept[:, -1] = better
        left = torch.where(better, left, before)
        correlation = torch.where(better[:, None], residual @ D, old)
    return [*done, (rows, atoms, kept)]


def _solve_two(inner: Tensor, a: Tensor, b: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    """The solutions for two right-hand sides, and where there are none (not 0)."""
    found, failed = torch.linalg.solve_ex(inner, torch.stack([a, b], 2))
    return found.unbind(2), failed


def _equations(gram: Tensor, start: Tensor, atoms: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
    """The normal equations of the atoms of each patch (l, k, k) and (l, k); those it did not keep get 0."""
    both = kept[:, :, None] & kept[:, None]
    eye = torch.eye(atoms.shape[1], dtype=gram.dtype, device=gram.device)
    inner = torch.where(both, gram[atoms[:, :, None], atoms[:, None, :]], eye)
    return inner, torch.where(kept, start.gather(1, atoms), 0)
