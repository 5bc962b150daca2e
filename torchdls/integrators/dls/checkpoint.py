"""DLS with a derivative that takes little memory: runs of iterations that are made again in the backward pass.

A run keeps its first height, dictionary and nonzero codes alone. Its backward pass makes it again, keeps the same of
each iteration, and goes back through them one by one; where the learner is SOUP-DIL, a sweep is undone with the memory
of a sweep. So of n iterations about 2 sqrt(n) heights and sets of nonzero codes are kept, and no residual.

A code that is 0 has come out of a threshold that passes no derivative, so that nothing is lost with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import compress
from math import isqrt
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.dictionary.learners import FixedDictionary, Learner, SoupDIL
from torchdls.dictionary.sweep_adjoint import Codes, Sweep
from torchdls.dictionary.thresholds import Threshold
from torchdls.integrators.dls.problem import Finished, Problem, State, codes_pay, merge, support
from torchdls.integrators.iterative import Callback


class Iteration(NamedTuple):
    """What DLS provides: the parts of an iteration, and its options.

    `round` makes one iteration and tells the objective after it, `settled` which surfaces a step was short for (N,),
    `step` the height from the one before and the folded residual of the patches.
    """

    round: Callable[[Problem, State, bool], tuple[State, Tensor]]
    settled: Callable[[State, State], Tensor]
    step: Callable[[Problem, Tensor, Tensor], Tensor]
    learner: Learner
    learn: bool
    n_sweeps: int
    bound: float
    threshold: Threshold
    tol: float


class Kept(NamedTuple):
    """A state without its zeros: height, dictionary, and the nonzero codes at their places (N, m).

    `R` is there before the first sweep only, and only with a mask: elsewhere it follows from the others.
    """

    z: Tensor
    D: Tensor
    values: Tensor
    R: Tensor | None
    places: Tensor
    used: Tensor

    @staticmethod
    def of(state: State, R: Tensor | None = None) -> Kept:
        """What is kept of a state, and a residual that does not follow from it."""
        places, used = support(state.B != 0)
        surfaces = torch.arange(len(places), device=places.device)[:, None]
        values = torch.where(used, state.B.flatten(1)[surfaces, places], 0)
        return Kept(state.z, state.D, values, R, places.to(torch.int32), used)

    @property
    def n_codes(self) -> list[int]:
        """How many codes of each surface are not zero."""
        return self.used.sum(1).tolist()

    def codes(self, model: Problem) -> Tensor:
        """(N, K, L) all of them."""
        rows, columns = model.patches.grid(self.z.shape)
        shape = (len(self.z), self.D.shape[-1], rows * columns)
        flat = self.values.new_zeros(len(self.z), shape[1] * shape[2])
        return flat.scatter_add(1, self.places.long(), self.values).view(shape)

    def state(self, model: Problem, start: Tensor) -> State:
        """All of it again."""
        B = self.codes(model)
        if self.R is not None:
            return State(start, self.z, self.R.mT.clone().mT, self.D, B)
        P, minus = model.patches.extract(self.z).mT, (B.mT, self.D.mT.expand(len(B), -1, -1))
        R = P.baddbmm(*minus, alpha=-1) if torch.is_grad_enabled() else P.baddbmm_(*minus, alpha=-1)
        return State(start, self.z, _inside(R.mT, model), self.D, B)

    def select(self, keep: Tensor) -> Kept:
        """The surfaces that `keep` holds."""
        parts = (t[keep] if t is not None and len(t) == len(keep) else t for t in self)
        return Kept(*parts)  # type: ignore[arg-type]

    def end(self, model: Problem) -> State:
        """Height, dictionary and codes of surfaces that have stopped; what the iterations need besides is left out."""
        return State(self.z, self.z, self.z, self.D, self.codes(model))


class Run(NamedTuple):
    """Some iterations: how they are made, from where, how many at most, and whether the first of all is among them."""

    dls: Iteration
    model: Problem
    start: Tensor
    places: Tensor
    used: Tensor
    limit: int
    first: bool

    def kept(self, z: Tensor, D: Tensor, values: Tensor, R: Tensor | None) -> Kept:
        """The state that the run sets out from."""
        return Kept(z, D, values, R, self.places, self.used)

    def iterations(self, kept: Kept) -> Iterator[tuple[State, Tensor, Tensor]]:
        """States, objectives, and which surfaces have settled; ends with the first iteration in which one does."""
        state = kept.state(self.model, self.start)
        for i in range(self.limit):
            z = state.z
            state, cost = self.dls.round(self.model, state, self.first and i == 0)
            settled = self.dls.settled(state, state._replace(z=z))
            yield state, cost, settled
            if self.dls.tol > 0 and bool(settled.any()):
                return


def run_in_legs(
    dls: Iteration, model: Problem, state: State, cost: Tensor, n_iter: int, callback: Callback | None
) -> tuple[State, Tensor, Tensor, Tensor]:
    """The iterations from `state`, whose objective is `cost` (N,).

    A run ends early where a surface settles; that surface then leaves the batch.

    Returns:
        The last state, without what iterations alone need; the objectives (N, n_iter + 1); which surfaces are still
        on their way (N,); the iterations that each took (N,).
    """
    index = torch.arange(len(cost), device=cost.device)
    start, kept = state.start.detach(), Kept.of(state, None if model.valid is None else state.R)
    costs, active, parts = [cost], torch.ones_like(cost, dtype=torch.bool), []
    taken = torch.zeros_like(index)
    del state
    while len(costs) <= n_iter and len(index):
        count = min(isqrt(n_iter - 1) + 1, n_iter + 1 - len(costs))
        kept, found, settled = advance(Run(dls, model, start, kept.places, kept.used, count, len(costs) == 1), kept)
        taken = taken.index_add(0, index, torch.full_like(index, found.shape[1]))
        for value in found.unbind(1):
            costs.append(costs[-1].index_copy(0, index, value))
            if callback is not None:
                callback(len(costs) - 1, costs[-1].detach())
        active = active.index_copy(0, index, ~settled)
        if dls.tol > 0 and bool(settled.any()):
            parts.append(Finished(index[settled], kept.select(settled).end(model.select(settled))))
            index, start, kept, model = index[~settled], start[~settled], kept.select(~settled), model.select(~settled)
    if len(index):
        parts.append(Finished(index, kept.end(model)))
    costs += [costs[-1]] * (n_iter + 1 - len(costs))
    return merge(parts), torch.stack(costs, 1), active, taken


def advance(run: Run, kept: Kept) -> tuple[Kept, Tensor, Tensor]:
    """The state after the run, the objectives (N, iterations), and which surfaces have settled (N,)."""
    tensors = kept.z, kept.D, kept.values, kept.R
    z, D, values, costs, places, used, settled = _Run.apply(run, *tensors, *_tensors(run.model))
    return Kept(z, D, values, None, places, used), costs, settled


class _Run(torch.autograd.Function):
    """A run of iterations; see the module. First derivatives only."""

    @staticmethod
    def forward(
        ctx: Any, run: Run, z: Tensor, D: Tensor, values: Tensor, R: Tensor | None, *leaves: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.run = run._replace(model=_with_tensors(run.model, (t.detach() for t in leaves)), start=run.start.detach())
        ctx.save_for_backward(z, D, values, R)
        ctx.set_materialize_grads(False)
        costs = []
        for state, cost, settled in ctx.run.iterations(run.kept(z, D, values, R)):  # noqa: B007 the last ones are used
            costs.append(cost)
        end = Kept.of(state)
        ctx.mark_non_differentiable(end.places, end.used, settled)
        return end.z, end.D.view_as(end.D), end.values, torch.stack(costs, 1), end.places, end.used, settled

    @staticmethod
    @full_precision
    def backward(ctx: Any, gz: Tensor, gD: Tensor, gv: Tensor, g_costs: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("DLS: checkpoint=True has first derivatives only; take checkpoint=False for second ones")
        run = ctx.run
        z, D, values, R = ctx.saved_tensors
        states = [run.kept(z, D, values, R)]
        states += [Kept.of(state) for state, *_ in run.iterations(states[0])]
        slopes = [torch.zeros_like(t) if g is None else g for t, g in zip(states[-1][:3], (gz, gD, gv), strict=True)]
        total: list[Tensor | None] = [None] * len(_tensors(run.model))
        g_R = None
        for i in reversed(range(len(states) - 1)):
            back = _Back(run, after=states.pop(), before=states[-1], first=run.first and i == 0)
            slopes, g_R, leaves = back.pull(slopes, None if g_costs is None else g_costs[:, i])
            total = [a if b is None else b if a is None else a + b for a, b in zip(total, leaves, strict=True)]
        return None, *slopes, g_R, *total


# Gradients in height, dictionary and codes; in the residual, if it was given; in the tensors of the model.
Pulled = tuple[list[Tensor], Tensor | None, list[Tensor | None]]


class _Back(NamedTuple):
    """The way back through one iteration."""

    run: Run
    before: Kept
    after: Kept
    first: bool

    def pull(self, slopes: list[Tensor], g_cost: Tensor | None) -> Pulled:
        """From gradients in the state after the iteration to those before it, in R if given, and in the model."""
        undo = isinstance(self.run.dls.learner, SoupDIL | FixedDictionary) and self.run.dls.n_sweeps == 1
        return self._undone(*slopes) if undo and g_cost is None else self._taped(slopes, g_cost)

    def _taped(self, slopes: list[Tensor], g_cost: Tensor | None) -> Pulled:
        """By autograd through the whole iteration, whatever its learner."""
        with torch.enable_grad():
            leaves = [_leaf(t) for t in _tensors(self.run.model)]
            model = _with_tensors(self.run.model, iter(leaves))
            z, D, values = (_leaf(t) for t in self.before[:3])
            R = None if self.before.R is None else _leaf(self.before.R)
            kept = self.before._replace(z=z, D=D, values=values, R=R)
            new, cost = self.run.dls.round(model, kept.state(model, self.run.start), self.first)
            places = self.after.places.long()
            outputs = [new.z, new.D, torch.where(self.after.used, new.B.flatten(1).gather(1, places), 0)]
            outputs, back = ([*outputs, cost], [*slopes, g_cost]) if g_cost is not None else (outputs, slopes)
            live = [o.requires_grad for o in outputs]
            outputs, back = (list(compress(t, live)) for t in (outputs, back))
            inputs = [z, D, values, *([] if R is None else [R]), *leaves]
            found = torch.autograd.grad(outputs, inputs, back, allow_unused=True)
        own = [torch.zeros_like(t) if g is None else g for t, g in zip((z, D, values), found, strict=False)]
        return own, None if R is None else found[3], list(found[3 if R is None else 4 :])

    def _undone(self, gz: Tensor, gD: Tensor, gv: Tensor) -> Pulled:
        """By undoing the sweep."""
        dls, model, patches = self.run.dls, self.run.model, self.run.model.patches
        state = self.before.state(model, self.run.start)
        codes = [Codes.of(b) for b in _rows(state.B, self._alone(state.D))]
        bare = _inside(state.R, model).clone() if self.first and model.valid is not None else None
        R, D, B = dls.learner(state.R, state.D, state.B, model.mu[:, None], dls.bound, dls.learn)
        codes_after = [Codes.of(b) for b in _rows(B, self._alone(D))]
        pays = None if bare is None else codes_pay(bare, _inside(R, model), B, model.mu, dls.threshold)
        final = _inside(R, model) if pays is None else torch.where(pays, _inside(R, model), bare)  # type: ignore[arg-type]
        del state, B, bare
        slope_z, folded, leaves = self._through_step(patches.adjoint(final, gz.shape), gz)
        del final
        gR = _inside(patches.extract(folded), model)
        passed = None if pays is None else torch.where(pays, 0, gR)
        gR = gR if pays is None else torch.where(pays, gR, 0)
        g_codes = self._of_atoms(self.after._replace(values=torch.where(self.after.used, gv, 0)), codes_after)
        gR, gD, gv, g_mu = self._through_sweep(R, gR, D, gD, g_codes, codes, codes_after)
        gR = gR if passed is None else gR + passed
        leaves[-1] = g_mu if leaves[-1] is None else leaves[-1] + g_mu
        if self.before.R is not None:
            return [slope_z, gD, gv], gR, leaves
        return [slope_z + patches.adjoint(_inside(gR, model), gz.shape), gD, gv], None, leaves

    def _through_step(self, folded: Tensor, gz: Tensor) -> tuple[Tensor, Tensor, list[Tensor | None]]:
        """Gradients in the height before the step, in the folded residual, and in the model."""
        with torch.enable_grad():
            leaves = [_leaf(t) for t in _tensors(self.run.model)]
            z, folded = _leaf(self.before.z), _leaf(folded)
            new = self.run.dls.step(_with_tensors(self.run.model, iter(leaves)), z, folded)
            found = torch.autograd.grad(new, [z, folded, *leaves], gz, allow_unused=True)
        slope_z, slope_folded = (torch.zeros_like(z) if g is None else g for g in found[:2])
        return slope_z, slope_folded, list(found[2:])

    def _alone(self, D: Tensor) -> bool:
        """Whether surfaces have dictionaries of their own; else their patches lie side by side."""
        return len(D) == len(self.run.model.mu)

    def _of_atoms(self, kept: Kept, codes: list[Codes]) -> list[list[Tensor]]:
        """The values kept, atom by atom, at the places of `codes`."""
        if len(codes) == len(kept.values) and all(c.n_codes == n for c, n in zip(codes, kept.n_codes, strict=True)):
            return [
                list(v[: c.n_codes].split([len(s) for s in c.patches])) for v, c in zip(kept.values, codes, strict=True)
            ]
        dense = _rows(kept.codes(self.run.model), self._alone(kept.D))
        return [[b[s] for b, s in zip(B, c.patches, strict=True)] for B, c in zip(dense, codes, strict=True)]

    def _as_kept(self, values: list[list[Tensor]], codes: list[Codes], length: int) -> Tensor:
        """The reverse, at the places kept before the iteration."""
        N = len(self.before.values)
        if len(codes) == N:
            kept = torch.zeros_like(self.before.values)
            for row, own in zip(kept, values, strict=True):
                joined = torch.cat(own)
                row[: len(joined)] = joined
            return kept
        dense = codes[0].spread(values[0], length).unflatten(1, (N, -1)).transpose(0, 1)
        return torch.where(self.before.used, dense.flatten(1).gather(1, self.before.places.long()), 0)

    def _through_sweep(
        self,
        R: Tensor,
        gR: Tensor,
        D1: Tensor,
        gD1: Tensor,
        g_codes: list[list[Tensor]],
        codes: list[Codes],
        codes_after: list[Codes],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients in the residual, the dictionary, the nonzero codes and mu before the sweep.

        Unless R was given, it stands for P z - D b, and its share is handed on to D and b.
        """
        dls, D, alone = self.run.dls, self.before.D, self._alone(D1)
        learner = dls.learner if isinstance(dls.learner, SoupDIL) else SoupDIL("block")
        mu, found = self.run.model.mu[:, None].expand(-1, R.shape[-1]), []
        R, pull = (t.mT if alone else t.mT.flatten(0, 1)[None] for t in (R, gR))
        mu = mu if alone else mu.flatten()[None]
        options = dls.bound, dls.threshold, learner.order, learner.unused, dls.learn
        for i in range(len(D)):
            sweep = Sweep(D[i], codes[i], D1[i], codes_after[i], mu[i], *options)
            found.append(sweep.pull(R[i], pull[i], gD1[i], g_codes[i]))
        D_slopes = torch.stack([f.D for f in found])
        values = [f.codes for f in found]
        gR = pull.reshape(gR.mT.shape).mT
        if self.before.R is None:
            gR = _inside(gR, self.run.model)
            pull = gR.mT if alone else gR.mT.flatten(0, 1)[None]
            values = [self._hand_on(D[i], codes[i], pull[i], D_slopes[i], values[i]) for i in range(len(D))]
        g_mu = torch.stack([f.mu for f in found]).view(len(gR), -1).sum(1)
        return gR, D_slopes, self._as_kept(values, codes, pull.shape[1]), g_mu

    def _hand_on(self, D: Tensor, codes: Codes, pull: Tensor, D_slopes: Tensor, values: list[Tensor]) -> list[Tensor]:
        """R = P z - D b before the sweep: what R is given goes on to D (added to `D_slopes`) and to the codes."""
        handed = []
        for i, (s, b, g) in enumerate(zip(*codes, values, strict=True)):
            D_slopes[:, i] -= pull[s].mT @ b
            handed.append(g - pull[s] @ D[:, i])
        return handed


def _rows(B: Tensor, alone: bool) -> Tensor:
    """(N, K, L) codes, or (1, K, N L) with the patches of all surfaces side by side."""
    return B if alone else B.transpose(0, 1).flatten(1)[None]


def _inside(R: Tensor, model: Problem) -> Tensor:
    return R if model.valid is None else torch.where(model.valid, R, 0)


def _leaf(t: Tensor) -> Tensor:
    return t.detach().requires_grad_()


def _tensors(value: Any) -> list[Tensor]:
    """The tensors of real numbers in nested tuples, mu of a model last."""
    if isinstance(value, Tensor):
        return [value] if value.is_floating_point() else []
    return [t for v in value for t in _tensors(v)] if isinstance(value, tuple) else []


def _with_tensors(value: Any, tensors: Iterator[Tensor]) -> Any:
    """Nested tuples with other tensors of real numbers."""
    if isinstance(value, Tensor):
        return next(tensors) if value.is_floating_point() else value
    if not isinstance(value, tuple):
        return value
    parts = [_with_tensors(v, tensors) for v in value]
    return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
