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
from torchdls.dictionary.learners import FixedDictionary, SoupDIL
from torchdls.dictionary.sweep_adjoint import Codes, Sweep
from torchdls.integrators.dls.iteration import Settings, iterate, objective, settled, update_height
from torchdls.integrators.dls.problem import End, Problem, State, codes_pay, support
from torchdls.integrators.settling import Settled, rebuilt, run_until_settled


class Kept(NamedTuple):
    """A state without its zeros: first height, height, dictionary, and the nonzero codes at their places (N, m).

    `R` is there before the first sweep only, and only with a mask: elsewhere it follows from the others.
    """

    start: Tensor
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
        return Kept(state.start.detach(), state.z, state.D, values, R, places.to(torch.int32), used)

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

    def state(self, model: Problem) -> State:
        """All of it again."""
        B = self.codes(model)
        if self.R is not None:
            return State(self.start, self.z, self.R.mT.clone().mT, self.D, B)
        P, minus = model.patches.extract(self.z).mT, (B.mT, self.D.mT.expand(len(B), -1, -1))
        R = P.baddbmm(*minus, alpha=-1) if torch.is_grad_enabled() else P.baddbmm_(*minus, alpha=-1)
        return State(self.start, self.z, _inside(R.mT, model), self.D, B)


class Run(NamedTuple):
    """Some iterations: how they are made, from where, how many at most, and how many were made before them."""

    settings: Settings
    model: Problem
    start: Tensor
    places: Tensor
    used: Tensor
    limit: int
    made: int

    def kept(self, z: Tensor, D: Tensor, values: Tensor, R: Tensor | None) -> Kept:
        """The state that the run sets out from."""
        return Kept(self.start, z, D, values, R, self.places, self.used)

    def iterations(self, kept: Kept) -> Iterator[tuple[State, Tensor, Tensor]]:
        """States, objectives, and which surfaces have settled; ends with the first iteration in which one does."""
        state = kept.state(self.model)
        for iteration in range(self.made, self.made + self.limit):
            z = state.z
            state = iterate(self.model, state, self.settings, iteration)
            done = settled(self.model, state, z, self.settings, iteration)
            yield state, objective(self.model, state, self.settings, iteration), done
            if self.settings.tol > 0 and bool(done.any()):
                return


def run_in_legs(
    model: Problem,
    state: State,
    cost: Tensor,
    settings: Settings,
    n_iter: int,
    callback: Callable[[int, Tensor], None] | None,
) -> Settled[End]:
    """The iterations from `state`, whose objective is `cost` (N,), in legs that each keep their first state alone.

    A leg ends early where a surface settles; that surface then leaves the batch.
    """
    leg = isqrt(max(n_iter - 1, 0)) + 1

    def advance(model: Problem, kept: Kept, _: Tensor, made: int) -> tuple[Kept, Tensor, Tensor]:
        run = Run(settings, model, kept.start, kept.places, kept.used, min(leg, n_iter - made), made)
        tensors = kept.z, kept.D, kept.values, kept.R
        z, D, values, costs, places, used, done = _Run.apply(run, *tensors, *_tensors(run.model))
        return Kept(kept.start, z, D, values, None, places, used), costs, done

    def end(model: Problem, kept: Kept) -> End:
        return End(kept.z, kept.D, kept.codes(model))

    kept = Kept.of(state, None if model.valid is None else state.R)
    return run_until_settled(model, kept, cost, advance, n_iter, tol=settings.tol, finish=end, callback=callback)


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
        for state, cost, done in ctx.run.iterations(run.kept(z, D, values, R)):  # noqa: B007 the last ones are used
            costs.append(cost)
        end = Kept.of(state)
        ctx.mark_non_differentiable(end.places, end.used, done)
        return end.z, end.D.view_as(end.D), end.values, torch.stack(costs, 1), end.places, end.used, done

    @staticmethod
    @full_precision
    def backward(ctx: Any, gz: Tensor, gD: Tensor, gv: Tensor, g_costs: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("DLS: Unroll(checkpoint=True) has first derivatives only; take Unroll() for second ones")
        run = ctx.run
        z, D, values, R = ctx.saved_tensors
        states = [run.kept(z, D, values, R)]
        states += [Kept.of(state) for state, *_ in run.iterations(states[0])]
        end = states[-1]
        found = zip((end.z, end.D, end.values), (gz, gD, gv), strict=True)
        slopes = [torch.zeros_like(t) if g is None else g for t, g in found]
        total: list[Tensor | None] = [None] * len(_tensors(run.model))
        g_R = None
        for i in reversed(range(len(states) - 1)):
            back = _Back(run, after=states.pop(), before=states[-1], iteration=run.made + i)
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
    iteration: int

    @property
    def first(self) -> bool:
        """Whether it is the first of all."""
        return self.iteration == 0

    @property
    def model(self) -> Problem:
        """The problem with the threshold of this iteration."""
        return self.run.model.at(self.iteration)

    def pull(self, slopes: list[Tensor], g_cost: Tensor | None) -> Pulled:
        """From gradients in the state after the iteration to those before it, in R if given, and in the model."""
        learner = self.run.settings.learner
        undo = isinstance(learner, SoupDIL | FixedDictionary) and learner.n_sweeps == 1
        return self._undone(*slopes) if undo and g_cost is None else self._taped(slopes, g_cost)

    def _taped(self, slopes: list[Tensor], g_cost: Tensor | None) -> Pulled:
        """By autograd through the whole iteration, whatever its learner."""
        with torch.enable_grad():
            leaves = [_leaf(t) for t in _tensors(self.run.model)]
            model = _with_tensors(self.run.model, iter(leaves))
            z, D, values = (_leaf(t) for t in (self.before.z, self.before.D, self.before.values))
            R = None if self.before.R is None else _leaf(self.before.R)
            kept = self.before._replace(z=z, D=D, values=values, R=R)
            new = iterate(model, kept.state(model), self.run.settings, self.iteration)
            cost = objective(model, new, self.run.settings, self.iteration)
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
        settings, model, patches = self.run.settings, self.model, self.model.patches
        state = self.before.state(model)
        codes = [Codes.of(b) for b in _rows(state.B, self._alone(state.D))]
        bare = _inside(state.R, model).clone() if self.first and model.valid is not None else None
        R, D, B = settings.learner(state.R, state.D, state.B, model.mu[:, None], settings.learn != "fixed")
        codes_after = [Codes.of(b) for b in _rows(B, self._alone(D))]
        pays = None if bare is None else codes_pay(bare, _inside(R, model), B, model.mu, settings.threshold)
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
            new = update_height(_with_tensors(self.run.model, iter(leaves)), z, folded, self.run.settings)
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
        settings, D, alone = self.run.settings, self.before.D, self._alone(D1)
        learner = settings.learner if isinstance(settings.learner, SoupDIL) else SoupDIL("block")
        mu, found = self.model.mu[:, None].expand(-1, R.shape[-1]), []
        R, pull = (t.mT if alone else t.mT.flatten(0, 1)[None] for t in (R, gR))
        mu = mu if alone else mu.flatten()[None]
        options = settings.bound, settings.threshold, learner.order, learner.unused, settings.learn != "fixed"
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
    return rebuilt(value, [_with_tensors(v, tensors) for v in value])
