"""An iteration of DLS that leaves little behind for the backward pass: it is run again there."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchdls.integrators.dls_state import Model, State, support

Round = Callable[[Model, State], tuple[State, Tensor]]


def checkpointed(iterate: Round, model: Model, state: State) -> tuple[State, Tensor]:
    """`iterate(model, state)`, of which only the height, the dictionary and the nonzero codes are kept.

    A code that is 0 has come out of a threshold that passes no derivative, so that nothing is lost with it. Before the
    first sweep there are no codes, and the residual itself is kept.
    """
    places, used = support(state.B != 0)
    surfaces = torch.arange(len(places), device=places.device)[:, None]
    codes = torch.where(used, state.B.flatten(1)[surfaces, places], 0)  # `gather` would keep all codes for its backward
    index, shape = places.to(torch.int32), state.B.shape

    def run(start: Tensor, z: Tensor, D: Tensor, codes: Tensor, R: Tensor | None = None) -> tuple[State, Tensor]:
        B = codes.new_zeros(shape).flatten(1).scatter_add(1, index.long(), codes).view(shape)
        if R is None:
            R = model.patches.extract(z) - D @ B
            R = R if model.valid is None else torch.where(model.valid, R, 0)
        return iterate(model, State(start, z, R, D, B))

    kept = state.start, state.z, state.D, codes, *(() if bool(used.any()) else (state.R,))
    found: tuple[State, Tensor] = checkpoint(run, *kept, use_reentrant=False, preserve_rng_state=False)
    return found
