"""What DLS carries through its iterations, and how converged surfaces leave the batch."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.thresholds import Threshold, penalty, total_penalty
from torchdls.integrators.base import Fields
from torchdls.operators import Patches

# Numbers that are squared at once for their sum: a norm would need no memory, but in float32 it is off by 1e-4.
_AT_ONCE = 2**20


class Problem(NamedTuple):
    """The constants of one run.

    coverage (1 or N, 1, H, W) is counted within the mask; valid (N, n, L) marks the valid pixels of the patches; edges
    are (v, w) where the data term keeps them, whatever the height.
    """

    fields: Fields
    patches: Patches
    coverage: Tensor
    valid: Tensor | None
    edges: tuple[Tensor, Tensor | None] | None
    noise: Tensor
    lam: Tensor
    mu: Tensor

    def select(self, keep: Tensor) -> Problem:
        """The model of some surfaces of the batch; what all share stays as it is."""
        return Problem(*(_select(value, keep) for value in self))


class State(NamedTuple):
    """Where the iterations stand: the first height, the present one, the residual R = P - D B of the patches, D, B."""

    start: Tensor
    z: Tensor
    R: Tensor
    D: Tensor
    B: Tensor

    def select(self, keep: Tensor) -> State:
        """The state of some surfaces of the batch."""
        return State(*(_select(value, keep) for value in self))

    def choose(self, active: Tensor, new: State) -> State:
        """The new state where a surface is still active."""
        pairs = zip(self, new, strict=True)
        return State(*(n if len(n) < len(active) else torch.where(_over(active, n), n, o) for o, n in pairs))


class Finished(NamedTuple):
    """Surfaces of the batch that stopped at the same iteration, and where."""

    surfaces: Tensor
    state: State


def _select(value: Any, keep: Tensor) -> Any:
    """The surfaces where `keep` holds, in a tensor or in a tuple of them."""
    if isinstance(value, Tensor):
        return value[keep] if len(value) == len(keep) else value
    if isinstance(value, Fields):
        return Fields(*(_select(v, keep) for v in value))
    return tuple(_select(v, keep) for v in value) if isinstance(value, tuple) else value


def _over(active: Tensor, t: Tensor) -> Tensor:
    return active.view(-1, *[1] * (t.ndim - 1))


def merge(parts: list[Finished]) -> State:
    """All surfaces in the order in which they came."""
    if len(parts) == 1:
        return parts[0].state
    order = torch.cat([p.surfaces for p in parts]).argsort()
    columns = zip(*(p.state for p in parts), strict=True)
    # A dictionary that all share went through the parts as it was.
    return State(*(c[0] if all(t is c[0] for t in c) else torch.cat(c)[order] for c in columns))


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
