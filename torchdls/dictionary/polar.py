r"""The nearest orthonormal matrix and the nearest of low rank, with derivatives where singular values are equal.

For M = Q S with Q^T Q = I and S symmetric, no singular value 0, the polar factor Q is a smooth function of M:

    dQ = Q W,     W S + S W = Q^T dM - dM^T Q

In the eigenvectors of S this divides by sums s_i + s_j of singular values, never by their differences, as a derivative
through the SVD would. The map from dM to dQ is its own adjoint, so that the same line serves in both directions.

The sum T of the first r terms of M = \sum_k s_k u_k v_k^T is smooth while s_r > s_{r+1}. With E = U^T dM V, i <= r < j,

    (U^T dT V)_{ij} = (s_i^2 E_ij + s_i s_j E_ji) / (s_i^2 - s_j^2)        (U^T dT V)_{ji} alike, of E_ji and E_ij

and E within the first r, 0 within the others: no difference of two values on the same side. It is its own adjoint, too.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdls._precision import full_precision


def polar_factor(M: Tensor) -> Tensor:
    """argmax over orthonormal Q (.., n, n) of <Q, M>: U V^T for M = U S V^T.

    Where singular values are 0 it is not unique, and what they leave open is taken not to move.

    Source: Kenney, Laub, "Polar decomposition and matrix sign function condition estimates", SIAM J. Sci. Stat. Comput.
    12, 1991.
    """
    factor: Tensor = _Polar.apply(M)
    return factor


class _Polar(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(M: Tensor) -> Tensor:
        u, _, v = torch.linalg.svd(M)
        return u @ v

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs, output)
        ctx.save_for_forward(*inputs, output)

    @staticmethod
    @full_precision
    def backward(ctx: Any, dQ: Tensor) -> Tensor:
        M, Q = ctx.saved_tensors
        return _turned(M, Q, dQ)

    @staticmethod
    def jvp(ctx: Any, dM: Tensor) -> Tensor:
        M, Q = ctx.saved_tensors
        return _turned(M, Q, dM)


def _turned(M: Tensor, Q: Tensor, change: Tensor) -> Tensor:
    """Q W for a change of M, or the pull of a change of Q back to M."""
    skew = Q.mT @ change
    turn: Tensor = _Lyapunov.apply(Q.mT @ M, skew - skew.mT)
    return Q @ turn


class _Lyapunov(torch.autograd.Function):
    """W with W S + S W = C, for S symmetric and positive semidefinite; 0 where both eigenvalues are."""

    generate_vmap_rule = True

    @staticmethod
    def forward(S: Tensor, C: Tensor) -> Tensor:
        s, V = torch.linalg.eigh((S + S.mT) / 2)
        sums = s[..., :, None] + s[..., None, :]
        held = sums > s.shape[-1] * torch.finfo(s.dtype).eps * sums.amax((-2, -1), keepdim=True)
        return V @ torch.where(held, V.mT @ C @ V / torch.where(held, sums, 1), 0) @ V.mT

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        S, _ = inputs
        ctx.save_for_backward(S, output)
        ctx.save_for_forward(S, output)

    @staticmethod
    @full_precision
    def backward(ctx: Any, dW: Tensor) -> tuple[Tensor, Tensor]:
        S, W = ctx.saved_tensors
        dC: Tensor = _Lyapunov.apply(S, dW)
        return -(W.mT @ dC + dC @ W.mT), dC

    @staticmethod
    def jvp(ctx: Any, dS: Tensor | None, dC: Tensor | None) -> Tensor:
        S, W = ctx.saved_tensors
        change = torch.zeros_like(W) if dC is None else dC
        change = change if dS is None else change - W @ dS - dS @ W
        turn: Tensor = _Lyapunov.apply(S, change)
        return turn


def nearest_of_rank(M: Tensor, rank: int) -> Tensor:
    """The matrix (.., m, n) of at most the given rank that is nearest to M; its derivative where s_r > s_{r+1}.

    Where those are equal there are several, and what they leave open is taken not to move.
    """
    nearest: Tensor = _LowRank.apply(M, rank)
    return nearest


class _LowRank(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(M: Tensor, rank: int) -> Tensor:
        u, s, v = torch.linalg.svd(M, full_matrices=False)
        return (u[..., :rank] * s[..., None, :rank]) @ v[..., :rank, :]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        M, ctx.rank = inputs
        ctx.save_for_backward(M)
        ctx.save_for_forward(M)

    @staticmethod
    @full_precision
    def backward(ctx: Any, dT: Tensor) -> tuple[Tensor, None]:
        (M,) = ctx.saved_tensors
        return _moved(M, ctx.rank, dT), None

    @staticmethod
    def jvp(ctx: Any, dM: Tensor, _: None) -> Tensor:
        (M,) = ctx.saved_tensors
        return _moved(M, ctx.rank, dM)


def _moved(M: Tensor, rank: int, change: Tensor) -> Tensor:
    """dT for dM, or the pull of dT back to M: as if s_j were 0, and what the s_j add."""
    u, s, v = torch.linalg.svd(M, full_matrices=False)
    (u, u_j), (s, s_j), (v, v_j) = (t.tensor_split([rank], -1) for t in (u, s, v.mT))
    left = u @ (u.mT @ change)
    moved = left + (change - left) @ v @ v.mT
    s, s_j = s[..., :, None], s_j[..., None, :]
    gap = (s - s_j) * (s + s_j)
    held = gap > torch.finfo(s.dtype).eps * s.amax((-2, -1), keepdim=True).square()
    ahead, behind = u.mT @ change @ v_j, (u_j.mT @ change @ v).mT
    share = torch.where(held, s_j / torch.where(held, gap, 1), 0)
    ahead, behind = share * (s_j * ahead + s * behind), share * (s_j * behind + s * ahead)
    return moved + u @ ahead @ v_j.mT + u_j @ behind.mT @ v.mT
