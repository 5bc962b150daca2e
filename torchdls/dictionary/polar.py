r"""The nearest orthonormal matrix, with a derivative that exists where singular values are equal.

For M = Q S with Q^T Q = I and S symmetric, no singular value 0, the polar factor Q is a smooth function of M:

    dQ = Q W,     W S + S W = Q^T dM - dM^T Q

In the eigenvectors of S this divides by sums s_i + s_j of singular values, never by their differences, as a derivative
through the SVD would. The map from dM to dQ is its own adjoint, so that the same line serves in both directions.
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
