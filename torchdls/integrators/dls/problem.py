"""What DLS carries through its iterations, and the cost of patches and codes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.thresholds import Threshold, penalty, total_penalty
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import DataTerm
from torchdls.operators import Patches

# Numbers that are squared at once for their sum: a norm would need no memory, but in float32 it is off by 1e-4.
_AT_ONCE = 2**20


class Problem(NamedTuple):
    """The constants of one run.

    coverage (1 or N, 1, H, W) is counted within the mask; valid (N, n, L) marks the valid pixels of the patches; data
    is the data term of the fields; lam and mu are (N,). A schedule holds a threshold for each iteration, mu the last
    of them. A run that follows another one starts from its codes.
    """

    fields: Fields
    patches: Patches
    coverage: Tensor
    valid: Tensor | None
    data: DataTerm
    noise: Tensor
    lam: Tensor
    mu: Tensor
    schedule: tuple[float, ...] | None = None
    follows: bool = False

    def at(self, iteration: int) -> Problem:
        """The problem with the threshold of an iteration, counted from 0."""
        if self.schedule is None:
            return self
        return self._replace(mu=torch.full_like(self.mu, self.schedule[iteration]))

    def changes_after(self, iteration: int) -> bool:
        """Whether a later iteration has another threshold."""
        return self.schedule is not None and len(set(self.schedule[iteration:])) > 1


class State(NamedTuple):
    """Where the iterations stand: the first height, the present one, the residual R = P - D B of the patches, D, B."""

    start: Tensor
    z: Tensor
    R: Tensor
    D: Tensor
    B: Tensor


class End(NamedTuple):
    """Where they ended: height, dictionary, codes."""

    z: Tensor
    D: Tensor
    B: Tensor


def last_state(problem: Problem, state: State) -> End:
    """What is kept of a state that iterates no more."""
    return End(state.z, state.D, state.B)


def patch_cost(R: Tensor, B: Tensor, mu: Tensor, valid: Tensor | None, rule: Threshold = "hard") -> Tensor:
    """(N,) fit and penalty of the patches; only the valid pixels of a patch count."""
    R = R if valid is None else torch.where(valid, R, 0)
    flat = R.mT.flatten(1)  # as it lies in memory
    parts = flat.split(max(1, _AT_ONCE // max(1, len(flat))), 1)
    fit = torch.stack([torch.linalg.vecdot(part, part) for part in parts]).sum(0)
    return fit + total_penalty(B, mu, rule)


def drop_costly_codes(bare: Tensor, R: Tensor, B: Tensor, mu: Tensor, rule: Threshold) -> tuple[Tensor, Tensor]:
    """Residual and codes after the first sweep; patches that are better off without codes keep their bare residual.

    That sweep also fits the heights continued beyond the mask, which the objective does not count.
    """
    pays = codes_pay(bare, R, B, mu, rule)
    return torch.where(pays, R, bare), torch.where(pays, B, 0)


def codes_pay(bare: Tensor, R: Tensor, B: Tensor, mu: Tensor, rule: Threshold) -> Tensor:
    """(N, 1, L) bool: the patches that cost less, or as much, with their codes as without."""
    cost = R.square().sum(1, keepdim=True) + penalty(B, mu[:, None, None], rule).sum(1, keepdim=True)
    return cost <= bare.square().sum(1, keepdim=True)


def support(free: Tensor) -> tuple[Tensor, Tensor]:
    """Flat positions (N, m) of the free codes of each surface, and which of the m places are used."""
    flat = free.flatten(1)
    count = flat.sum(1)
    surface, position = flat.nonzero(as_tuple=True)
    place = torch.arange(len(position), device=free.device) - (count.cumsum(0) - count)[surface]
    index = torch.zeros(len(flat), max(int(count.max()), 1), dtype=torch.int64, device=free.device)
    index[surface, place] = position
    return index, torch.arange(index.shape[1], device=free.device) < count[:, None]
