r"""One iteration of DLS, with the equations of the paper by their labels.

min over z, B, D   1/2 ||A z - v||^2 + lam ( \sum_j ||P_j z - D b_j||^2 + mu^2 ||B||_0 )

(dbupdate)    codes and atoms for the height                   `update_codes_and_atoms`
(nupdate)     the height for the codes and atoms               `update_height`
(nproxupdate) the same by proximal gradient steps              `proximal_steps`
(nprox), (znormal)  the proximal map, as a diagonal solve      `proximal_map`
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.learners import Learner
from torchdls.dictionary.thresholds import Threshold
from torchdls.integrators.base import Integrator
from torchdls.integrators.data_term import anchored_cost
from torchdls.integrators.dls.options import Exact, Proximal
from torchdls.integrators.dls.problem import Problem, State, drop_costly_codes, patch_cost
from torchdls.integrators.dls.settings import Learn
from torchdls.operators import GradientOperator
from torchdls.solvers import harmonic_extension, solve
from torchdls.solvers.periodic import solve_periodic


class Settings(NamedTuple):
    """How the iterations are made: the options of DLS, besides those that are constants of a problem."""

    data_term: Integrator
    learner: Learner
    learn: Learn
    height_step: Exact | Proximal
    tol: float

    @property
    def threshold(self) -> Threshold:
        """The rule by which the learner makes codes sparse."""
        rule: Threshold = getattr(self.learner, "threshold", "hard")
        return rule

    @property
    def bound(self) -> float:
        """The bound of the codes."""
        return float(getattr(self.learner, "bound", math.inf))


def start(problem: Problem, D: Tensor, settings: Settings, B: Tensor | None = None) -> State:
    """The height of the data term alone, and no codes: the patches are the residual. Or given codes B."""
    z = settings.data_term._integrate(problem.fields)
    if B is not None:
        R = problem.patches.extract(z) - D @ B
        # An invalid pixel of a patch is filled by its approximation, so that no residual is there.
        return State(z, z, R if problem.valid is None else torch.where(problem.valid, R, 0), D, B)
    if problem.valid is None:
        R = problem.patches.extract(z)
    else:
        live = problem.valid.any(1, keepdim=True)
        R = torch.where(live, problem.patches.extract(_extend(problem, z, live, settings)), 0)
    return State(z, z, R, D, R.new_zeros(R.shape[0], D.shape[-1], R.shape[-1]))


def _extend(problem: Problem, z: Tensor, live: Tensor, settings: Settings) -> Tensor:
    """The height continued over the patches that hold a valid pixel."""
    fields = problem.fields
    assert fields.mask is not None
    assert problem.valid is not None
    reach = problem.patches.adjoint(live.expand(problem.valid.shape).to(z.dtype), z.shape) > 0
    tol = settings.height_step.tol if isinstance(settings.height_step, Exact) else Exact.tol
    return harmonic_extension(z, fields.mask, reach, tol=tol, pixel_size=fields.steps)


def iterate(problem: Problem, state: State, settings: Settings, iteration: int) -> State:
    """One iteration, counted from 0: codes and atoms for the height, then the height for them."""
    problem = problem.at(iteration)
    bare = iteration == 0 and not problem.follows
    R, D, B = update_codes_and_atoms(problem, state, settings, first=bare)
    z = update_height(problem, state.z, problem.patches.adjoint(R, state.z.shape), settings)
    return State(state.start, z, problem.patches.extract_onto(R, z - state.z), D, B)


def update_codes_and_atoms(
    problem: Problem, state: State, settings: Settings, first: bool
) -> tuple[Tensor, Tensor, Tensor]:
    r"""(dbupdate): R = P - D B, D and B after one pass of the learner.

    min over D, B   \sum_j ||P_j z - D b_j||^2 + mu^2 ||B||_0,   ||d_i|| = 1, |b_ji| <= a
    """
    valid = problem.valid
    bare = torch.where(valid, state.R, 0) if first and valid is not None else None
    R, D, B = settings.learner(state.R, state.D, state.B, problem.mu[:, None], settings.learn != "fixed")
    # Filling the invalid pixels of a patch by its approximation D b means: no residual there.
    R = R if valid is None else torch.where(valid, R, 0)
    if bare is not None:
        R, B = drop_costly_codes(bare, R, B, problem.mu, settings.threshold)
    return R, D, B


def update_height(problem: Problem, z: Tensor, folded: Tensor, settings: Settings) -> Tensor:
    r"""(nupdate): the height for given patches D B = P - R, with R folded, from the height z before.

        min over z   1/2 ||A z - v||^2 + lam \sum_j ||P_j z - D b_j||^2
                   = 1/2 ||A z - v||^2 + 1/2 \sum_i weight_i z_i^2 - \sum_i pull_i z_i + const

    with weight = 2 lam c (c patches hold a pixel), pull = 2 lam fold(D B), and anchors added to both.
    """
    fields = problem.fields
    v, w = problem.data.majoriser(z)
    strength = 2 * problem.lam[:, None, None, None]
    weight = strength * problem.coverage
    pull = weight * z - strength * folded  # = 2 lam fold(D B), as fold(P) = coverage z
    if fields.anchor is not None and fields.anchor_weight is not None:
        weight, pull = weight + fields.anchor_weight, pull + fields.anchor_weight * fields.anchor
    if isinstance(settings.height_step, Exact):
        if fields.boundary == "periodic":
            return solve_periodic(v, pull / torch.where(weight > 0, weight, 1), weight, fields.steps)
        anchor, tol = pull / torch.where(weight > 0, weight, 1), settings.height_step.tol
        return solve(v, w, anchor, weight, tol=tol, z0=z.detach(), pixel_size=fields.steps).height
    a = GradientOperator("forward", fields.steps, fields.boundary)
    return proximal_steps(z, v, w, weight, pull, a, settings.height_step)


def proximal_steps(
    z: Tensor, v: Tensor, w: Tensor | None, weight: Tensor, pull: Tensor, a: GradientOperator, how: Proximal
) -> Tensor:
    """(nproxupdate): z <- prox_{tau g}(z - tau grad f(z)), with f = 1/2 ||A z - v||^2 and tau = 1/||A||^2.

    Accelerated steps start from z ahead of where the last step ended (Nesterov).
    """
    stiffest = z.new_ones(()) if w is None else w.amax((-3, -2, -1), keepdim=True).clamp(min=1)
    tau = 1 / (a.norm_bound**2 * stiffest)
    ahead, pace = z, 1.0
    for _ in range(how.steps):
        misfit = a(ahead) - v
        old, z = z, proximal_map(ahead - tau * a.adjoint(misfit if w is None else w * misfit), tau, weight, pull)
        pace, before = (1 + math.sqrt(1 + 4 * pace**2)) / 2, pace
        ahead = z + (before - 1) / pace * (z - old) if how.accelerated else z
    return z


def proximal_map(moved: Tensor, tau: Tensor, weight: Tensor, pull: Tensor) -> Tensor:
    r"""(nprox): argmin over z of 1/2 ||z - moved||^2 + tau lam \sum_j ||P_j z - D b_j||^2.

    Its normal equation (znormal), (I + 2 tau lam \sum_j P_j^T P_j) z = moved + 2 tau lam \sum_j P_j^T D b_j, is
    diagonal.
    """
    return (moved + tau * pull) / (1 + tau * weight)


def objective(problem: Problem, state: State, settings: Settings, iteration: int = -1) -> Tensor:
    """(N,) value of the cost with the threshold of an iteration, for heights in pixels."""
    z, mu = state.z, problem.at(iteration).mu
    patches = patch_cost(state.R, state.B, mu, problem.valid, settings.threshold)
    return anchored_cost(problem.data, problem.fields, z) + problem.lam * patches


def settled(problem: Problem, new: State, old: Tensor, settings: Settings, iteration: int) -> Tensor:
    """(N,) bool: the step from the height `old` was short, and mu will not change any more.

    With one dictionary for all, a surface has settled once all have.
    """
    step, way = (z.flatten(1).norm(dim=1) for z in (new.z - old, new.z - new.start))
    short = step <= settings.tol * way
    if problem.changes_after(iteration):
        return torch.zeros_like(short)
    return short.all().expand_as(short) if settings.learn == "shared" else short
