"""The loop of every method that iterates: each surface runs until it has settled, and then leaves the batch.

A problem and a state are nested tuples of tensors whose first dimension is the batch, or 1 where all surfaces share
them; whatever else they hold is shared, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, TypeVar, cast

import torch
from torch import Tensor

from torchdls._tracing import is_concrete

P = TypeVar("P")
S = TypeVar("S")
E = TypeVar("E")
T = TypeVar("T")

# (problem, state, objective (N,), iterations made) -> state, objectives (N, m) after each of m >= 1 further iterations,
# which surfaces have settled (N,).
Advance = Callable[[P, S, Tensor, int], tuple[S, Tensor, Tensor]]


class Settled(NamedTuple, Generic[E]):
    """Where the surfaces ended: state, objectives (N, iterations + 1), iterations (N,), whether each settled (N,)."""

    state: E
    objective: Tensor
    iterations: Tensor
    converged: Tensor


class _Part(NamedTuple):
    """Surfaces of the batch that stopped together, and where."""

    surfaces: Tensor
    end: Any


def run_until_settled(
    problem: P,
    state: S,
    objective: Tensor,
    advance: Advance[P, S],
    n_iter: int,
    *,
    tol: float,
    finish: Callable[[P, S], E],
    callback: Callable[[int, Tensor], None] | None = None,
) -> Settled[E]:
    """Iterate until every surface has settled, or `n_iter` times.

    What has settled leaves the batch, so that it costs nothing more and comes out as it would alone. Where values
    cannot be looked at (inside `vmap` and other transforms), it stays and is not moved.

    Args:
        problem: the constants of the iterations.
        state: where they start.
        objective: (N,) of the start.
        advance: makes at least one iteration; see `Advance`.
        n_iter: limit of iterations.
        tol: 0 runs all iterations for all surfaces.
        finish: what is kept of a state that iterates no more.
        callback: called after each iteration as callback(iteration, objective (N,)).
    """
    look, freeze = tol > 0 and is_concrete(objective), tol > 0 and not is_concrete(objective)
    objectives, active = [objective], torch.ones_like(objective, dtype=torch.bool)
    iterations, index, parts = torch.zeros_like(active, dtype=torch.int64), None, []
    while len(objectives) <= n_iter:
        here = objectives[-1] if index is None else objectives[-1][index]
        new, found, settled = advance(problem, state, here, len(objectives) - 1)
        state = choose(active, new, state) if freeze else new
        iterations = _put(iterations, index, found.shape[1], add=True) if not freeze else iterations + active
        for value in found.unbind(1):
            value = torch.where(active, value, here) if freeze else value
            objectives.append(_put(objectives[-1], index, value))
            if callback is not None:
                callback(len(objectives) - 1, objectives[-1].detach())
        if tol == 0:
            continue
        active = active & ~settled if freeze else _put(active, index, ~settled)
        if look and bool(settled.any()):
            index = torch.arange(len(active), device=active.device) if index is None else index
            if bool(settled.all()):
                break
            parts.append(_Part(index[settled], finish(select(problem, settled), select(state, settled))))
            index, problem, state = index[~settled], select(problem, ~settled), select(state, ~settled)
    end = finish(problem, state)
    whole = end if index is None or not parts else _join([*parts, _Part(index, end)])
    return Settled(whole, torch.stack(objectives, 1), iterations, ~active)


def select(value: T, keep: Tensor) -> T:
    """Some surfaces of a batch, in nested tuples of tensors."""
    found: Any = value
    if isinstance(value, Tensor):
        found = value[keep] if len(value) == len(keep) else value
    elif isinstance(value, tuple):
        found = rebuilt(value, (select(v, keep) for v in value))
    return cast(T, found)


def choose(active: Tensor, new: T, old: T) -> T:
    """The new state where a surface is still active."""
    found: Any = new
    if isinstance(new, Tensor) and isinstance(old, Tensor) and len(new) == len(active):
        found = torch.where(active.view(-1, *[1] * (new.ndim - 1)), new, old)
    elif isinstance(new, tuple) and isinstance(old, tuple):
        found = rebuilt(new, (choose(active, n, o) for n, o in zip(new, old, strict=True)))
    return cast(T, found)


def _put(values: Tensor, index: Tensor | None, new: Tensor | int, add: bool = False) -> Tensor:
    """(N,) with other values, or some added, at the surfaces of the index (None for all)."""
    if add:
        new = (values if index is None else values[index]) + new
    assert isinstance(new, Tensor)
    return new if index is None else values.index_copy(0, index, new)


def _join(parts: list[_Part]) -> Any:
    """The ends of all surfaces, in the order in which they came."""
    order = torch.cat([part.surfaces for part in parts]).argsort()

    def together(ends: tuple[Any, ...]) -> Any:
        first = ends[0]
        if isinstance(first, Tensor):  # what all share went through the parts as it was
            return first if all(t is first for t in ends) else torch.cat(ends)[order]
        return rebuilt(first, map(together, zip(*ends, strict=True))) if isinstance(first, tuple) else first

    return together(tuple(part.end for part in parts))


def rebuilt(like: Any, parts: Iterable[Any]) -> Any:
    """A tuple, or a named tuple of the same kind, of other parts."""
    return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
