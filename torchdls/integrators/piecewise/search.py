"""The search for the jumps of a field: energy, starts, and the steps that lead from them. Nothing is differentiated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.integrators.fields import Fields
from torchdls.integrators.piecewise.measured import Measured
from torchdls.integrators.piecewise.pieces import pieces_of, tied_pieces
from torchdls.integrators.piecewise.prior import continued, features, log_odds
from torchdls.integrators.robust import Bilateral
from torchdls.integrators.settling import select
from torchdls.operators import GradientOperator, edge_ends
from torchdls.solvers.nested_dissection import factor

_RANGE = 100.0  # pixels over which jumps are spread evenly
_LEAST = 1e-12  # weight that a cut edge keeps
_HOLD = 1e-9  # weight of the present height, as part of the largest of the edges: what nothing holds stays
_DAMPING = 0.3  # share of the coupled odds
_JUMP = 2.0  # pixels from which a jump has an order
_CLEARLY = 2.0  # log odds from which one order is likelier
_CUT = 0.5  # probability from which an edge counts as cut
_FEW = 4  # edges cut below which a surface does not jump
_LIKELY = 0.1  # probability from which an edge may be cut
_LOOSE = 0.1  # share of the pixels without a tie above which a surface is not believed
_DISORDER = 0.2  # share of jumps in the wrong order from which a surface is not believed


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
        noise: (N,) of the normals that came, in radians.
        fields: slopes as they came, and anchors.
    """

    m: Measured
    phi: Tensor
    noise: Tensor
    fields: Fields

    @classmethod
    def of(cls, m: Measured, noise: Tensor, fields: Fields) -> Problem:
        """The problem of what was measured on slopes without noise, with the fields that came."""
        return cls(m, features(m), noise, fields)

    def slopes(self, y: Tensor) -> Tensor:
        """(N, 2, H, W) those of a depth, 0 where there is no edge."""
        return torch.where(self.m.live, GradientOperator("forward", self.fields.steps)(y), 0)

    def jumps(self, y: Tensor) -> Tensor:
        """(N, 2, H, W) how much more a depth grows along the edges than measured."""
        return self.slopes(y) - self.m.v

    def solve(self, w: Tensor, v: Tensor | None = None, y: Tensor | None = None) -> Tensor:
        """The minimum of sum w (A y - v)^2 and of the anchors; what is loose is held at y, or at 0."""
        return self.minimum(w * self.m.trust, self.m.v if v is None else v, y)

    def minimum(self, w: Tensor, v: Tensor, y: Tensor | None = None) -> Tensor:
        """As `solve`, with weights that hold the trusts."""
        b = w * (v if y is None else v - self.slopes(y))
        anchor, pull, steps = self.fields.anchor, self.fields.anchor_weight, self.fields.steps
        b = GradientOperator("forward", steps).adjoint(b)
        r = torch.where(edge_ends(w) > 0, _HOLD * _per_surface(w.flatten(1).amax(1)), 0)
        if anchor is not None and pull is not None:
            b = b + pull * (anchor if y is None else anchor - y)
            r = r + pull
        x = factor(w, r, steps).solve(b)
        return x if y is None else y + x


def _per_surface(x: Tensor) -> Tensor:
    """(N,) as (N, 1, 1, 1)."""
    return x[:, None, None, None]


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
    return cost.of(r) * bent * (_per_surface(problem.m.scale.flatten(1).amin(1)) / s).square()


def robust(problem: Problem, y: Tensor, cost: Costs, widths: Iterable[float]) -> Tensor:
    """One reweighted solve for each factor of the scale."""
    for widen in widths:
        y = problem.solve(robust_weights(problem, y, cost, widen), y=y)
    return y


def coupled(problem: Problem, y: Tensor, widths: Iterable[float] = (4, 2, 1), each: int = 2) -> Tensor:
    """Graduated steps whose costs are those of contours that go on, seen at the present height."""
    for widen in widths:
        cost = costs(problem, odds(problem, y, widen), widen)
        y = robust(problem, y, cost, [widen] * each)
    return y


def opened(problem: Problem, likely: float = 0.02) -> Tensor:
    """Least squares with weight (1 + (P / likely)^2)^-2: every edge that may be cut, whichever way, is nearly so."""
    p = odds(problem).sigmoid().sum(1)
    return problem.solve((1 + (p / likely).square()).square().reciprocal().clamp(min=1e-6))


def bilateral(problem: Problem, n_iter: int = 50, tol: float = 1e-4) -> Tensor:
    """`Bilateral`, every solve direct, on the slopes as they came: coding takes from a rim which side is smooth."""
    term = Bilateral()._data_term(problem.fields)
    v, w = term.terms.quadratic(term.facing.expand_as(term.terms.live))
    y = problem.minimum(w, v)
    cost, moves = term.cost(y), torch.ones_like(problem.noise, dtype=torch.bool)
    for _ in range(n_iter):
        v, w = term.majoriser(y)
        y = torch.where(_per_surface(moves), problem.minimum(w, v, y), y)
        before, cost = cost, term.cost(y)
        moves = moves & ((before - cost).abs() > tol * cost)
        if not bool(moves.any()):
            break
    return y


def posterior(problem: Problem, y: Tensor) -> Tensor:
    """(N, 2, H, W) probability that an edge is cut at y, 0 where there is none.

    The odds of its side being nearer, with the contours around, times what the jump r itself says: density 1 / range if
    cut, s / (pi (s^2 + r^2)) if not.
    """
    r, s = problem.jumps(y), problem.m.scale
    i, j = odds(problem, y).unbind(1)
    likelihood = (math.pi * (s.square() + r.square()) / (s * _RANGE)).log()
    return torch.where(problem.m.live, (torch.where(r > 0, i, j) + likelihood).sigmoid(), 0)


def out_of_order(problem: Problem, y: Tensor) -> Tensor:
    """(N,) share of the jumps above two pixels whose other side was likelier to be nearer, by a factor of e^2."""
    r = problem.jumps(y)
    i, j = odds(problem).unbind(1)
    cut = problem.m.live & (r.abs() > _JUMP) & (r.abs() > problem.m.scale)
    wrong = cut & (torch.where(r > 0, j - i, i - j) > _CLEARLY)
    return wrong.flatten(1).sum(1) / cut.flatten(1).sum(1).clamp(min=1)


class Found(NamedTuple):
    """What the search found.

    Attributes:
        y: (N, 1, H, W) depth.
        weight: (N, 2, H, W) of the edges, but for the trusts.
        doubtful: (N,) bool, whether the jumps are not believed, so that y is that from `Bilateral`.
        cut: (N, 2, H, W) probability of a cut.
        smooth: (N,) bool, whether nothing is cut.
        pieces: (N, 1, H, W) int64, as `pieces_of` gives them.
        tied: (N, K) bool, as `tied_pieces` gives it.
    """

    y: Tensor
    weight: Tensor
    doubtful: Tensor
    cut: Tensor
    smooth: Tensor
    pieces: Tensor
    tied: Tensor


def search(problem: Problem) -> Found:
    """The start with all open, the steps from it, and those from `Bilateral` where the first cannot be believed.

    Where all that may be cut starts open, jumps are found best, but what hangs together by nothing lies anywhere. So it
    is not believed where more than a tenth of the pixels are in pieces without a tie, or many jumps contradict the
    order of the sides that the normals tell: there the one-sided trusts are the safer guess. The energy does not tell,
    being lower for the first in any case. Under noise more steps are of use. Where the surface jumps, the first start
    tells always.
    """
    if bool(problem.m.live.any()):
        bold = coupled(problem, opened(problem))
        bold = _where(problem.noise > 0, problem, bold, lambda part, y: coupled(part, y, (1, 1, 1)))
    else:
        bold = torch.zeros_like(problem.m.v[:, :1])
    cut = posterior(problem, bold)
    smooth = (cut > _CUT).flatten(1).sum(1) < _FEW
    pieces, tied = _fallen_apart(problem, (cut > _CUT) & ~smooth[:, None, None, None])
    doubtful = (out_of_order(problem, bold) >= _DISORDER) | (_loose(pieces, tied) > _LOOSE)
    y = _where(doubtful, problem, bold, lambda part, _: _safe(part))
    weight = robust_weights(problem, y, costs(problem, odds(problem, y)))
    return Found(y, weight, doubtful, cut, smooth, pieces, tied)


def _fallen_apart(problem: Problem, cut: Tensor) -> tuple[Tensor, Tensor]:
    """The pieces into which cuts (N, 2, H, W) part the surface, and which of them are tied."""
    mask, live, pull = problem.fields.mask, problem.m.live, problem.fields.anchor_weight
    size = cut[:, :1]
    inside = torch.ones_like(size) if mask is None else mask.expand_as(size)
    anchored = torch.zeros_like(size) if pull is None else (pull > 0).expand_as(size) & inside
    pieces = pieces_of(cut, odds(problem).sigmoid().sum(1) > _LIKELY, live, inside)
    return pieces, tied_pieces(pieces, live, anchored)


def _loose(pieces: Tensor, tied: Tensor) -> Tensor:
    """(N,) share of the pixels that are in pieces without a tie."""
    flat = pieces.flatten(1)
    held = torch.cat([torch.ones_like(tied[:, :1]), tied], 1).gather(1, flat)
    return (~held).sum(1) / (flat > 0).sum(1).clamp(min=1)


def _safe(problem: Problem) -> Tensor:
    return robust(problem, bilateral(problem), costs(problem, odds(problem)), [1.0] * 6)


def _where(chosen: Tensor, problem: Problem, y: Tensor, steps: Callable[[Problem, Tensor], Tensor]) -> Tensor:
    """The depths y, for the surfaces chosen, (N,) bool, replaced by what steps make of them."""
    if not bool(chosen.any()):
        return y
    return y.index_copy(0, chosen.nonzero().flatten(), steps(select(problem, chosen), y[chosen]))
