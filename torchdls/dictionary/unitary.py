"""A learner whose dictionary stays orthonormal: both of its steps are exact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.dictionary.learners import Step, check_options
from torchdls.dictionary.polar import polar_factor
from torchdls.dictionary.thresholds import Threshold, shrink


@dataclass(frozen=True)
class Unitary:
    r"""Orthonormal dictionaries: min over D, B of \sum_j ||P_j - D b_j||^2 + mu^2 ||B||_0 with D^T D = I.

        B = shrink(D^T P, mu)        D = U V^T, where P B^T = U S V^T

    Each step is the exact minimum over its variable, so a pass never raises the cost. The dictionary must be square,
    and the codes leave no patch of it out: K = n. Differentiable where no singular value of P B^T is 0, equal ones
    included; what those that are 0 leave open is taken not to move.

    Args:
        threshold: "hard", "soft" or "firm".
        bound: bound a on the codes, for heights in pixels.

    Raises:
        ValueError: an option is unknown or out of range, or (when called) the dictionary is not square.

    Source: Ravishankar, Bresler, "Closed-form solutions within sparsifying transform learning", ICASSP 2013; the
    orthogonal Procrustes problem: Schoenemann 1966.

    Example:
        >>> P, D = torch.randn(1, 4, 50, generator=torch.Generator().manual_seed(0)), torch.eye(4)[None]
        >>> R, D, B = torchdls.Unitary()(P, D, torch.zeros(1, 4, 50), mu=0.5)
        >>> torch.allclose(D.mT @ D, torch.eye(4), atol=1e-5)
        True
    """

    threshold: Threshold = "hard"
    bound: float = math.inf

    def __post_init__(self) -> None:
        check_options(self)

    @full_precision
    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass: codes, then the dictionary."""
        n, K = D.shape[-2:]
        if n != K:
            raise ValueError(f"Unitary: dictionary {tuple(D.shape)} given, a square one (N, n, n) is needed")
        P = R + D @ B
        level = torch.as_tensor(mu, dtype=R.dtype, device=R.device)
        level = level[..., None] if level.ndim else level
        B = shrink(D.mT @ P, level, self.bound, self.threshold)
        if learn:
            moment = P @ B.mT
            D = _nearest(moment if D.shape[0] == P.shape[0] else moment.sum(0, keepdim=True), D)
        return P - D @ B, D, B


def _nearest(moment: Tensor, D: Tensor) -> Tensor:
    """argmax over orthonormal X of <X, moment>; D itself where the moment is 0, which leaves X free."""
    some = (moment != 0).flatten(1).any(1)[:, None, None]
    return torch.where(some, polar_factor(torch.where(some, moment, D)), D)
