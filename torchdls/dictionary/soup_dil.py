"""One sweep of SOUP-DIL: sparse codes by hard thresholding and unit-norm atoms, one sum of outer products at a time."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchdls.dictionary.thresholds import THRESHOLDS, Threshold, shrink

Order = Literal["atom", "block"]
Unused = Literal["first", "keep"]

# Atoms that share one product with the residual; inside such a group they are corrected for each other one by one.
_GROUP = 8


def soup_dil_sweep(
    P: Tensor,
    D: Tensor,
    B: Tensor,
    mu: float | Tensor,
    bound: float = math.inf,
    order: Order = "atom",
    *,
    unused: Unused = "first",
    learn: bool = True,
    threshold: Threshold = "hard",
) -> tuple[Tensor, Tensor]:
    r"""One pass of block coordinate descent over all rows of B and all atoms of D.

        min over D, B of  ||P - D B||_F^2 + mu^2 ||B||_0   subject to  ||d_i|| = 1, |b_ji| <= bound

    With E_i = P - sum_{k != i} d_k b_k, the minimisers for one row and for one atom are

        x = d_i^T E_i;   b_i = x where |x| > mu (strictly), else 0, then clipped to [-bound, bound]
        h = E_i b_i^T;   d_i = h / ||h||,  and for b_i = 0: see `unused`

    "atom" does this in the order of the paper, atom i right after row i. "block" updates all rows of B with D held
    fixed, and then all atoms with B held fixed. Neither order ever raises the objective. Differentiable, with the
    support of B frozen.

    Args:
        P: (N, n, L) patches.
        D: (N, n, K) one dictionary per surface, or (1, n, K) one for the whole batch, learned from all its patches.
        B: (N, K, L) codes to start from.
        mu: threshold, at least 0: a number, or a tensor that broadcasts to (N, K): (N, 1) per surface, (K,) per atom.
        bound: the bound a on the codes.
        order: "atom" or "block".
        unused: an atom whose row of codes is zero becomes the first unit vector e_1 ("first", as in the paper's
            reference), or stays as it is ("keep"). Both leave the objective unchanged.
        learn: False keeps D fixed and updates the codes alone.
        threshold: "hard" as above; "soft" or "firm" replace mu^2 ||B||_0 by the penalties of
            `torchdls.dictionary.thresholds`, which have a derivative in mu.

    Returns:
        D and B after the sweep; the arguments are not written to.

    Raises:
        ValueError: shapes do not fit, an option is unknown, the bound is not positive, or a number mu is negative.

    Source: Ravishankar, Nadakuditi, Fessler, "Efficient sum of outer products dictionary learning (SOUP-DIL)", 2015.
    """
    _check(P, D, B, order, unused, threshold)
    _check_levels(mu, bound, B)
    N, _, L = P.shape
    levels = _levels(mu, B)
    if D.shape[0] == N or not learn:
        D, B = _sweep(P, D.expand(N, -1, -1) if learn else D, B, levels, bound, order, unused, learn, threshold)
        return D, B
    # One dictionary for all: the patches of the batch side by side are the patches of one surface.
    side_by_side, codes = P.transpose(0, 1).flatten(1)[None], B.transpose(0, 1).flatten(1)[None]
    if levels.shape[0] > 1:
        levels = levels.expand(N, -1, L).transpose(0, 1).flatten(1)[None]
    D, codes = _sweep(side_by_side, D, codes, levels, bound, order, unused, learn, threshold)
    return D, codes[0].unflatten(1, (N, L)).transpose(0, 1)


def _sweep(
    P: Tensor,
    D: Tensor,
    B: Tensor,
    mu: Tensor,
    bound: float,
    order: Order,
    unused: Unused,
    learn: bool,
    rule: Threshold,
) -> tuple[Tensor, Tensor]:
    R = P - D @ B
    if order == "atom" and learn:
        return _atom_order(R, D, B, mu, bound, unused, rule)
    R, B = _update_codes(R, D, B, mu, bound, rule)
    return (_update_atoms(R, D, B, unused) if learn else D), B


def _atom_order(
    R: Tensor, D: Tensor, B: Tensor, mu: Tensor, bound: float, unused: Unused, rule: Threshold
) -> tuple[Tensor, Tensor]:
    """Row, atom, row, atom, ..: the residual R is brought up to date once per group, rows within the group exactly."""
    atoms: list[Tensor] = []
    rows: list[Tensor] = []
    for start in range(0, D.shape[-1], _GROUP):
        D0, B0 = D[..., start : start + _GROUP], B[:, start : start + _GROUP]
        X = D0.mT @ R + B0
        # What the group has changed so far: R - C S is the residual of the moment, with C (N, n, 2k) and S (N, 2k, L).
        C, S = D0[..., :0], B0[:, :0]
        group_atoms, group_rows = [], []
        for k in range(D0.shape[-1]):
            d, b, m = D0[..., k : k + 1], B0[:, k : k + 1], mu[:, start + k : start + k + 1] if mu.shape[1] > 1 else mu
            x = X[:, k : k + 1] - (d.mT @ C) @ S
            b_new = shrink(x, m, bound, rule)
            h = R @ b_new.mT - C @ (S @ b_new.mT) + d * (b @ b_new.mT)
            d_new = _normalize(h, d, unused)
            C, S = torch.cat([C, d_new, -d], -1), torch.cat([S, b_new, b], 1)
            group_atoms.append(d_new)
            group_rows.append(b_new)
        R = R - C @ S
        atoms += group_atoms
        rows += group_rows
    return torch.cat(atoms, -1), torch.cat(rows, 1)


def _update_codes(R: Tensor, D: Tensor, B: Tensor, mu: Tensor, bound: float, rule: Threshold) -> tuple[Tensor, Tensor]:
    """All rows of B in turn with D held fixed; returns the new residual and codes."""
    rows: list[Tensor] = []
    for start in range(0, D.shape[-1], _GROUP):
        D0, B0 = D[..., start : start + _GROUP], B[:, start : start + _GROUP]
        X, G = D0.mT @ R + B0, D0.mT @ D0
        change = B0[:, :0]
        group_rows = []
        for k in range(D0.shape[-1]):
            m = mu[:, start + k : start + k + 1] if mu.shape[1] > 1 else mu
            b_new = shrink(X[:, k : k + 1] - G[:, k : k + 1, :k] @ change, m, bound, rule)
            change = torch.cat([change, b_new - B0[:, k : k + 1]], 1)
            group_rows.append(b_new)
        R = R - D0 @ change
        rows += group_rows
    return R, torch.cat(rows, 1)


def _update_atoms(R: Tensor, D: Tensor, B: Tensor, unused: Unused) -> Tensor:
    """All atoms in turn with B held fixed.

    h_i = R b_i^T + d_i ||b_i||^2 with the residual of the moment, which the atoms before i have changed by their own
    steps. Through the residual, and not through P B^T, nothing large cancels: float32 stays accurate.
    """
    H, C = R @ B.mT, B @ B.mT
    steps = D[..., :0]
    atoms: list[Tensor] = []
    for i in range(D.shape[-1]):
        d = D[..., i : i + 1]
        h = H[..., i : i + 1] - steps @ C[:, :i, i : i + 1] + d * C[:, i : i + 1, i : i + 1]
        used = C[:, i : i + 1, i : i + 1] > 0
        d_new = _normalize(torch.where(used, h, 0), d, unused)
        steps = torch.cat([steps, d_new - d], -1)
        atoms.append(d_new)
    return torch.cat(atoms, -1)


def _normalize(h: Tensor, d: Tensor, unused: Unused) -> Tensor:
    """h / ||h|| for each surface, and the documented rule where h = 0; safe in the derivative too."""
    square = h.square().sum(1, keepdim=True)
    some = square > 0
    if unused == "keep":
        instead = d
    else:
        instead = torch.zeros_like(d)
        instead[:, 0] = 1
    return torch.where(some, h * torch.where(some, square, 1).rsqrt(), instead)


def _levels(mu: float | Tensor, B: Tensor) -> Tensor:
    """Mu as (N or 1, K or 1, 1)."""
    if not isinstance(mu, Tensor):
        return torch.full((1, 1, 1), float(mu), dtype=B.dtype, device=B.device)
    return (mu if mu.ndim == 2 else mu.reshape(1, -1)).to(B)[..., None]


def _check_levels(mu: float | Tensor, bound: float, B: Tensor) -> None:
    if not bound > 0:
        raise ValueError(f"bound: {bound!r} given, a positive number is needed")
    N, K, _ = B.shape
    if isinstance(mu, Tensor):
        rows, columns = mu.shape if mu.ndim == 2 else (1, mu.numel())
        if mu.ndim > 2 or rows not in (1, N) or columns not in (1, K):
            raise ValueError(f"mu: {tuple(mu.shape)} given, it must broadcast to (N, K) = ({N}, {K})")
    elif not mu >= 0:
        raise ValueError(f"mu: {mu!r} given, a number of at least 0 is needed")


def _check(P: Tensor, D: Tensor, B: Tensor, order: str, unused: str, threshold: str) -> None:
    if order not in ("atom", "block"):
        raise ValueError(f"order: {order!r} is unknown; choose 'atom' or 'block'")
    if unused not in ("first", "keep"):
        raise ValueError(f"unused: {unused!r} is unknown; choose 'first' or 'keep'")
    if threshold not in THRESHOLDS:
        raise ValueError(f"threshold: {threshold!r} is unknown; choose from {', '.join(map(repr, THRESHOLDS))}")
    fits = P.ndim == D.ndim == B.ndim == 3 and D.shape[0] in (1, P.shape[0])
    if not fits or D.shape[1] != P.shape[1] or B.shape != (P.shape[0], D.shape[2], P.shape[2]):
        raise ValueError(
            f"soup_dil_sweep: P {tuple(P.shape)}, D {tuple(D.shape)} and B {tuple(B.shape)} do not fit; "
            "(N, n, L), (N or 1, n, K) and (N, K, L) are needed"
        )
