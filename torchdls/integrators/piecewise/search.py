"""The search for the jumps of a field: energy, starts, and the steps that lead from them. Nothing is differentiated."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.integrators.fields import Fields
from torchdls.integrators.piecewise.measured import Measured
from torchdls.integrators.piecewise.prior import continued, features, log_odds
from torchdls.operators import GradientOperator, edge_ends
from torchdls.solvers.nested_dissection import factor

_RANGE = 100.0  # pixels over which jumps are spread evenly
_LEAST = 1e-12  # weight that a cut edge keeps
_HOLD = 1e-9  # weight of the present height, as part of the largest of the edges: what nothing holds stays
_DAMPING = 0.3  # share of the coupled odds


class Costs(NamedTuple):
    """What a cut costs in nats, (N, 2, H, W), where i is nearer (the jump r = A y - v is positive) and where j is."""

    i: Tensor
    j: Tensor

    def of(self, r: Tensor) -> Tensor:
        """Of the jumps r."""
        return torch.where(r > 0, self.i, self.j)


class Problem(NamedTuple):
    """A field in depths of pixels, in float64.

    Attributes:
        m: the ends.
        phi: features.
        noise: (N,) of the normals in radians.
        anchor: (N, 1, H, W) depths and their weights, or None.
        anchor_weight: likewise.
        steps: sides of a pixel.
    """

    m: Measured
    phi: Tensor
    noise: Tensor
    anchor: Tensor | None
    anchor_weight: Tensor | None
    steps: tuple[float, float]

    @classmethod
    def of(cls, m: Measured, noise: Tensor, fields: Fields) -> Problem:
        """The problem of what was measured."""
        return cls(m, features(m), noise, fields.anchor, fields.anchor_weight, fields.steps)

    def slopes(self, y: Tensor) -> Tensor:
        """(N, 2, H, W) those of a height, 0 where there is no edge."""
        return torch.where(self.m.live, GradientOperator("forward", self.steps)(y), 0)

    def jumps(self, y: Tensor) -> Tensor:
        """(N, 2, H, W) how much more a depth grows along the edges than measured."""
        return self.slopes(y) - self.m.v

    def solve(self, w: Tensor, v: Tensor | None = None, y: Tensor | None = None) -> Tensor:
        """The minimum of sum w (A y - v)^2 and of the anchors, what is loose held where it is (y)."""
        v = self.m.v if v is None else v
        w = w * self.m.trust
        hold = _HOLD * largest(w)
        alive = edge_ends(w) > 0
        a = GradientOperator("forward", self.steps)
        b = w * (v if y is None else v - self.slopes(y))
        b, r = a.adjoint(b), torch.where(alive, hold, 0)
        if self.anchor_weight is not None:
            pull = self.anchor_weight if self.anchor is None else self.anchor_weight * 1.0
            b = b + pull * (self.anchor - (0 if y is None else y))
            r = r + pull
        found = factor(w, r, self.steps)
        x = found.solve(b)
        return x if y is None else y + x


def largest(x: Tensor) -> Tensor:
    """(N, 1, 1, 1) of each surface."""
    return x.flatten(1).amax(1)[:, None, None, None]


def odds(problem: Problem, y: Tensor | None = None, widen: float = 1.0) -> Tensor:
    """(N, 2, 2, H, W) log odds of a cut; with what is cut around at y, damped."""
    alone = log_odds(problem.phi, problem.noise)
    if y is None:
        return alone
    around = continued(cut_probability(problem, y, widen), problem.m.live)
    return (1 - _DAMPING) * alone + _DAMPING * log_odds(problem.phi, problem.noise, around)


def cut_probability(problem: Problem, y: Tensor, widen: float = 1.0) -> Tensor:
    """(N, 2, H, W), r^2 / (r^2 + s^2)."""
    square = problem.jumps(y).square()
    return square / (square + (widen * problem.m.scale).square())


def costs(problem: Problem, log_odds_: Tensor, widen: float = 1.0) -> Costs:
    """What a cut costs: minus its log probability, and what placing it anywhere in the range costs."""
    p = log_odds_.sigmoid().clamp(1e-6, 1 - 1e-3)
    none = (1 - p.sum(1, keepdim=True)).clamp(min=1e-3)
    spread = math.log(_RANGE) - (widen * problem.m.scale).log()[:, None] - 1
    return Costs(*((none / p).log() + spread).clamp(0.2, 12).unbind(1))


def energy(problem: Problem, y: Tensor, cost: Costs) -> Tensor:
    """(N,) sum of cost r^2 / (r^2 + s^2)."""
    r = problem.jumps(y)
    return (problem.m.live * cost.of(r) * r.square() / (r.square() + problem.m.scale.square())).flatten(1).sum(1)


def robust_weights(problem: Problem, y: Tensor, cost: Costs, widen: float = 1.0) -> Tensor:
    """(N, 2, H, W) weights of the quadratic that touches the energy of scales `widen` s at y."""
    r = problem.jumps(y)
    s = widen * problem.m.scale
    bent = (s.square() / (s.square() + r.square())).square().clamp(min=_LEAST)
    return cost.of(r) * bent * (problem.m.scale.flatten(1).amin(1)[:, None, None, None] / s).square()


def robust(problem: Problem, y: Tensor, cost: Costs, widths: Iterable[float]) -> Tensor:
    """One reweighted solve for each factor of the scale."""
    for widen in widths:
        y = problem.solve(robust_weights(problem, y, cost, widen), y=y)
    return y


def coupled(problem: Problem, y: Tensor, widths: Iterable[float] = (8, 4, 2, 1.4, 1, 1), each: int = 2) -> Tensor:
    """Graduated steps whose costs are those of contours that go on, seen at the present height."""
    for widen in widths:
        cost = costs(problem, odds(problem, y, widen), widen)
        y = robust(problem, y, cost, [widen] * each)
    return y


def convex(problem: Problem, n_iter: int = 10) -> Tensor:
    """The least sum of (1 - P) |r|, P of the side that would be nearer, by reweighted solves."""
    p = odds(problem).sigmoid().clamp(1e-4, 1 - 1e-3)
    keep = Costs(*(1 - p).unbind(1))
    y = problem.solve(torch.minimum(keep.i, keep.j))
    for k in range(n_iter):
        e = 0.02 ** (k / (n_iter - 1))
        r = problem.jumps(y)
        y = problem.solve(keep.of(r) / (r.square() + e * e).sqrt(), y=y)
    return y


def bilateral(problem: Problem, n_iter: int = 20, k: float = 2.0) -> Tensor:
    """One-sided trusts, as in `Bilateral`."""
    m = problem.m
    square = m.facing.square()
    side = torch.full_like(square, 0.5)
    y: Tensor | None = None
    for _ in range(n_iter):
        w = side * square
        total = w.sum(1)
        v = (w * m.slopes).sum(1) / total.clamp(min=1e-30)
        y = problem.solve(total.clamp(min=1e-8), v, y)
        d = problem.slopes(y).square()
        before = torch.stack([torch.nn.functional.pad(d[:, 0, :, :-1], (1, 0)), torch.nn.functional.pad(d[:, 1, :-1], (0, 0, 1, 0))], 1)
        after = torch.stack([torch.nn.functional.pad(d[:, 0, :, 1:], (0, 1)), torch.nn.functional.pad(d[:, 1, 1:], (0, 0, 0, 1))], 1)
        side = torch.sigmoid(k * square * (torch.stack([before, after], 1) - d[:, None]))
    assert y is not None
    return y
