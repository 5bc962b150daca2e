"""Preconditioned conjugate gradients for a batch of symmetric systems, each with its own steps and its own stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

LinearMap = Callable[[Tensor], Tensor]


class CGResult(NamedTuple):
    """Solution (N, ...), and per system the iterations, the relative residual, and whether it met `tol`."""

    x: Tensor
    iterations: Tensor
    residual: Tensor
    converged: Tensor

    def replace(self, systems: Tensor, other: CGResult) -> CGResult:
        """With what was found for some of the systems since; their iterations add up."""
        other = other._replace(iterations=self.iterations[systems] + other.iterations)
        return CGResult(*(own.index_copy(0, systems, new) for own, new in zip(self, other, strict=True)))


def conjugate_gradients(
    apply: LinearMap,
    precondition: LinearMap,
    b: Tensor,
    x0: Tensor | None,
    *,
    tol: float,
    max_iter: int,
    project: LinearMap | None = None,
    deflate: LinearMap | None = None,
    scale: Tensor | None = None,
) -> CGResult:
    """Solve H x = b for every system of the batch.

    Args:
        apply: x -> H x, symmetric positive semidefinite on each system; b must lie in its range. What it returns must
            be a tensor of its own, as x is overwritten.
        precondition: an approximate inverse, symmetric positive definite on that range.
        b: (N, ...) right-hand sides.
        x0: (N, ...) warm start, or None for 0.
        tol: a system stops once ||r|| <= tol scale, with r the residual of the recursion (free of rounding in x).
        max_iter: limit of iterations.
        project: orthogonal projection on the range of a singular H. Rounding leaves it, and a preconditioner that does
            not commute with it would take what is outside for progress. It may overwrite its argument.
        deflate: oblique projection v -> v - H e (e^T v) / (e^T H e) along directions e that the caller solves for; b
            must have no part along them, and x is right up to them.
        scale: (N,) what residuals are measured by; None for ||b||.

    A system that has stopped is frozen: its result does not depend on its neighbours in the batch. None ends at a
    residual above ten times the smallest that it has seen, nor above that of 0.
    """
    norm = _norm(b)
    scale = norm if scale is None else scale
    goal = tol * scale
    if x0 is None:
        x, r = torch.zeros_like(b), b.clone()
    else:  # where b = 0 the solution is 0, which no iteration from elsewhere would meet
        x = torch.where(_each(norm, b) > 0, x0, 0)
        r = b - apply(x)
        r = r if project is None else project(r)  # a guess outside the range of H brings a residual that is too
        worse = _norm(r) > norm  # than no guess at all
        x, r = torch.where(_each(worse, b), 0, x), torch.where(_each(worse, b), b, r)
    best, least = x.clone(), _norm(r)  # a copy of the best iterate, but for a factor of ten
    lowest = least
    active = least > goal
    iterations = torch.zeros(b.shape[0], dtype=torch.int64, device=b.device)
    p, rho = torch.zeros_like(b), torch.ones_like(goal)
    for _ in range(max_iter):
        if not bool(active.any()):
            break
        y = precondition(r)
        rho_new = _dot(r, y)
        p.mul_(_ratio(rho_new, rho, iterations > 0, p)).add_(y)  # in place: new memory costs as much as the arithmetic
        q = apply(p) if deflate is None else deflate(apply(p))
        step = _ratio(rho_new, _dot(p, q), active, p)
        x.addcmul_(p, step)
        r.addcmul_(q, step, value=-1)
        r = r if project is None else project(r)
        rho = rho_new
        iterations += active
        now = _norm(r)
        active = active & ~(now <= goal)  # NaN goes on, to end as not converged
        lowest = torch.fmin(now, lowest)
        much = active & (now < 0.1 * least)  # a copy for each factor of ten costs little
        if bool(much.any()):
            best, least = torch.where(_each(much, x), x, best), torch.where(much, now, least)
    final = _norm(r)
    lost = ~(final <= 10 * lowest) | ~(final <= norm)  # by rounding, or as the system is not what it should be: NaN too
    if bool(lost.any()):
        x = torch.where(_each(lost, x), best, x)
        final = torch.where(lost, least, final)
    return CGResult(x, iterations, final / torch.where(scale > 0, scale, 1), ~active & ~lost)


def _each(systems: Tensor, like: Tensor) -> Tensor:
    """(N,) to stand beside the systems of `like`."""
    return systems.view(-1, *[1] * (like.ndim - 1))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).flatten(1).sum(1)


def _norm(a: Tensor) -> Tensor:
    return a.flatten(1).norm(dim=1)


def _ratio(a: Tensor, b: Tensor, where: Tensor, like: Tensor) -> Tensor:
    """a / b where `where` holds and b is not 0, else 0; shaped to scale the systems of `like`."""
    good = where & (b != 0)
    return _each(torch.where(good, a / torch.where(good, b, 1), 0), like)
