"""Robust statistics of masked samples."""

from __future__ import annotations

import torch
from torch import Tensor

NORMAL_MEDIAN = 0.6744897501960817  # median magnitude of a standard normal variable


def masked_median(x: Tensor, live: Tensor) -> Tensor:
    """(N,) lower median of the live numbers of each row of x (N, n), 0 where there is none; differentiable."""
    some = live.any(1, keepdim=True)
    ends = torch.where(some, x.new_full((), torch.nan), 0)  # a number for the rows that have none
    return torch.cat([torch.where(live, x, torch.nan), ends], 1).nanmedian(1).values


def midpoint_median(x: Tensor, live: Tensor) -> Tensor:
    """Median of the live numbers of the last dimension, at least one: for an even count, the mean of the middle two."""
    ordered, count = torch.where(live, x, torch.inf).sort(-1).values, live.sum(-1, keepdim=True)
    middle = torch.cat([(count - 1) // 2, count // 2], -1)
    return ordered.gather(-1, middle).mean(-1)
