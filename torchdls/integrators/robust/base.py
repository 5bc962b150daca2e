"""The loop that the robust methods share: around the solve (*), stopping each surface on its own objective."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import DataTerm, anchored_cost, edges_of
from torchdls.integrators.fields import normalize_fields
from torchdls.integrators.iterative import Callback, Iterative
from torchdls.integrators.settling import run_until_settled
from torchdls.solvers import solve

Estimate = tuple[Tensor, ...]  # the height first, then whatever else an iteration hands to the next; all (N, ...)


class RobustResult(NamedTuple):
    """What `solve` of a robust integrator returns; always batched.

    Attributes:
        height: (N, 1, H, W).
        objective: (N, iterations + 1), from the start on, for heights in pixels; constant once a surface has stopped.
            Of slopes beyond 2^30 or below 2^-30 (float64: 250) it is that of the same slopes brought to order 1.
        iterations: (N,) the iterations each surface took.
        converged: (N,) bool, whether it met `tol` within them.

    Example:
        >>> result = torchdls.Huber().solve(torchdls.SURFACES["peaks"](16).gradient)
        >>> result.height.shape, bool(result.converged)
        (torch.Size([1, 1, 16, 16]), True)
        >>> result.objective.shape[1] == int(result.iterations) + 1
        True
    """

    height: Tensor
    objective: Tensor
    iterations: Tensor
    converged: Tensor


class _Problem(NamedTuple):
    """What an iteration needs besides the estimate; the rounding of the objective is (N,)."""

    fields: Fields
    data: DataTerm
    rounding: Tensor


class Robust(Iterative[RobustResult]):
    """An integrator that repeats the solve (*) until its own objective settles, surface by surface.

    A subclass provides its `_data_term`. Its majoriser makes it a data term of DLS; solving for the minimum of the
    majoriser again and again is also the default iteration (`_advance`), in which the objective never rises.

    The derivative is that of the iterations run (unrolled, each solve by its implicit rule), in every input that is a
    floating-point tensor; nothing is detached. The graph holds some fields per iteration.

    Args:
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its objective by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves.
        pixel_size: (dx, dy) or one number; heights come out in its unit.
    """

    _steady = False

    # Options that are slopes when they are numbers; with such a number, slopes are not brought to order 1.
    _slopes: tuple[str, ...] = ()

    def __init__(
        self, *, n_iter: int, tol: float, solve_tol: float = 1e-6, pixel_size: float | Sequence[float] = 1.0
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        name = type(self).__name__
        if not isinstance(n_iter, int) or n_iter < 0:
            raise ValueError(f"{name}: n_iter={n_iter!r} given, an integer of at least 0 is needed")
        check_numbers(name, tol=tol, solve_tol=solve_tol)
        if not tol >= 0 or not solve_tol > 0:
            raise ValueError(f"{name}: tol={tol!r} must be at least 0, solve_tol={solve_tol!r} positive")
        self.n_iter, self.tol, self.solve_tol = n_iter, tol, solve_tol

    @abstractmethod
    def _data_term(self, fields: Fields) -> DataTerm:
        """The data term of checked fields."""

    def _to_pixel_size(self, result: RobustResult) -> RobustResult:
        """The height in the unit of `pixel_size`."""
        return result._replace(height=result.height * self._unit)

    def _iterate(self, fields: Fields, callback: Callback | None = None) -> RobustResult:
        """The iterations, each surface until its objective settles."""
        fields, unit = normalize_fields(fields, all(isinstance(getattr(self, name), str) for name in self._slopes))
        trust = unit.trust.flatten()
        data = self._data_term(fields)
        begin = self._begin(fields, data)
        flat = anchored_cost(data, fields, torch.zeros_like(begin[0])).detach()
        start = anchored_cost(data, fields, begin[0])

        def advance(problem: _Problem, old: Estimate, before: Tensor, _: int) -> tuple[Estimate, Tensor, Tensor]:
            fields, data, rounding = problem
            new = self._advance(fields, data, old)
            cost = anchored_cost(data, fields, new[0])
            change = (cost - before).abs() + self._gap(data, new)
            return new, cost[:, None], ~(change > self.tol * cost + rounding)

        problem = _Problem(fields, data, 10 * torch.finfo(flat.dtype).eps * flat)
        tell = None if callback is None else lambda iteration, cost: callback(iteration, cost * trust)
        height, objective, *how = run_until_settled(
            problem, begin, start, advance, self.n_iter, tol=self.tol, finish=_height, callback=tell
        )
        return RobustResult(height * unit.slope, objective * trust[:, None], *how)

    def _begin(self, fields: Fields, data: DataTerm) -> Estimate:
        """Where to start: the least-squares surface."""
        v, w = edges_of(fields)
        return (self._surface(fields, v, w, fields.anchor_weight),)

    def _advance(self, fields: Fields, data: DataTerm, state: Estimate) -> Estimate:
        """One iteration: the minimum of the quadratic that majorises the objective around the height."""
        v, w = data.majoriser(state[0])
        return (self._surface(fields, v, w, fields.anchor_weight, state[0]),)

    def _gap(self, data: DataTerm, state: Estimate) -> Tensor | float:
        """(N,) how far the cost at the height may be from what the iteration itself believes."""
        return 0.0

    def _surface(
        self, fields: Fields, v: Tensor, w: Tensor | None, anchor_weight: Tensor | None, z0: Tensor | None = None
    ) -> Tensor:
        """The height that (*) gives for these slopes and trusts and the anchors of the fields."""
        guess = None if z0 is None else z0.detach()
        return solve(v, w, fields.anchor, anchor_weight, tol=self.solve_tol, z0=guess, pixel_size=fields.steps).height


def _height(_: _Problem, estimate: Estimate) -> Tensor:
    """What is kept of an estimate that iterates no more."""
    return estimate[0]
