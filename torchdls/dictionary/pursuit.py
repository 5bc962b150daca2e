"""Sparse coding by orthogonal matching pursuit, many patches at once."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._checks import check_alike

_CHUNK = 8192  # patches worked on at once: their rows of the Gram matrix are gathered


def orthogonal_matching_pursuit(
    P: Tensor, D: Tensor, n_nonzero: int | None = None, *, mu: float | Tensor = 0.0, tol: float | Tensor = 0.0
) -> Tensor:
    r"""Codes B (N, K, L) of patches, one atom at a time.

    Each patch p takes the atom of largest |d_i^T r|, with r its residual, and fits all atoms it has taken by least
    squares. It stops with `n_nonzero` atoms, at |r|^2 <= tol, or when no |d_i^T r| exceeds mu: an atom lowers |r|^2 by
    at least (d_i^T r)^2, so that each step lowers |r|^2 + mu^2 ||b||_0. Differentiable, with the support of B frozen.

    Args:
        P: (N, n, L) patches.
        D: (N, n, K), or (1, n, K) for all; unit-norm atoms.
        n_nonzero: most atoms of a patch; None for no limit but n.
        mu: least correlation, at least 0: a number or a tensor that broadcasts to (N, L).
        tol: squared residual that suffices: a number or a tensor that broadcasts to (N, L).

    Raises:
        ValueError: shapes do not fit, or `n_nonzero` is not an integer of at least 1.
        TypeError: P and D are not tensors of one dtype, float32 or float64.

    Source: Pati, Rezaiifar, Krishnaprasad, "Orthogonal matching pursuit", 1993; Rubinstein, Zibulevsky, Elad,
    "Efficient implementation of the K-SVD algorithm using batch orthogonal matching pursuit", 2008.

    Example:
        >>> D = torch.eye(3)[None]
        >>> torchdls.orthogonal_matching_pursuit(torch.tensor([[[0.1], [2.0], [1.0]]]), D, n_nonzero=1)[0, :, 0]
        tensor([0., 2., 0.])
    """
    check_alike("orthogonal_matching_pursuit", P=P, D=D)
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
    limit = min(n, D.shape[-1], n if n_nonzero is None else n_nonzero)
    least, enough = (torch.as_tensor(t, dtype=P.dtype, device=P.device).expand(N, L) for t in (mu, tol))
    codes = []
    for i in range(N):
        d = D[i if D.shape[0] > 1 else 0]
        columns = zip(P[i].split(_CHUNK, -1), least[i].split(_CHUNK), enough[i].split(_CHUNK), strict=True)
        codes.append(torch.cat([_pursue(p, d, limit, m, t) for p, m, t in columns], 0).mT)
    return torch.stack(codes)


def _pursue(P: Tensor, D: Tensor, limit: int, least: Tensor, enough: Tensor) -> Tensor:
    """(L, K) codes of patches (n, L) in one dictionary."""
    gram, start = D.mT @ D, P.mT @ D
    energy = P.square().sum(0)
    floor = torch.maximum(least, 10 * torch.finfo(P.dtype).eps * energy.detach().sqrt())  # rounding is no signal
    rows = torch.arange(P.shape[1], device=P.device)
    atoms, x = rows.new_zeros(len(rows), 0), start[:, :0]
    correlation, left = start, energy
    done: list[tuple[Tensor, Tensor, Tensor]] = []
    for _ in range(limit):
        size, atom = correlation.detach().abs().scatter(1, atoms, -1.0).max(1)
        go = (size > floor[rows]) & (left > enough[rows])
        done.append((rows[~go], atoms[~go], x[~go]))
        rows, atoms = rows[go], torch.cat([atoms, atom[:, None]], 1)[go]
        if not len(rows):
            break
        inner = gram[atoms[:, :, None], atoms[:, None, :]]
        target = start[rows].gather(1, atoms)
        x = torch.linalg.solve(inner, target)
        correlation = start[rows] - (x[:, None] @ gram[atoms])[:, 0]
        left = energy[rows] - (x * target).sum(1)
    else:
        done.append((rows, atoms, x))
    codes = torch.zeros_like(start)
    for rows, atoms, x in done:
        codes = codes.index_put((rows[:, None].expand_as(atoms), atoms), x)
    return codes
