"""Surfaces with holes, unequal weights or anchors: runs with what is known there, blended by predicted risk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdls._tracing import is_concrete
from torchdls.integrators.fields import Fields
from torchdls.integrators.slope_dls.blend import signs, sure_weights
from torchdls.integrators.slope_dls.coding import Noise
from torchdls.integrators.slope_dls.known import Known
from torchdls.integrators.slope_dls.runs import KAPPA, Run
from torchdls.integrators.slope_dls.waves import cautious
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.operators.edges import edge_ends, extend_edges
from torchdls.solvers import harmonic_extension, solve

_NORM = 0.25  # of the risk, see `sure_weights`
_FILLED = 1e3  # times the tolerance of the solves, for the extension from which runs begin: they improve it themselves


def _nothing(z: Tensor) -> None:
    """Watches nothing."""


def smooth_holed(
    runs: Sequence[Run],
    fields: Fields,
    noise: Noise,
    tol: float,
    guard: bool = True,
    watch: Callable[[Tensor], None] = _nothing,
) -> Tensor:
    r"""The height by one run or several, blended with least squares by Stein's unbiased estimate of the risk.

    The noise of a coefficient is taken as far from every border, for the mean trust in a patch, and a patch weighs as
    much as it knows (`Known`). The blend needs no such approximation: least squares is linear here too, so that one
    probe n, random signs over the square root of the trust, tells its noise. The risk of

        z_ls + sum_m w_m (z_m - z_ls)   is estimated in the norm   sum_k S_k^-1/4 |dct2(error, 0 outside the mask)_k|^2

    with S as on the whole rectangle: any other weights would do as well, these set coarse against fine. At last least
    squares is returned where hardly any noise was found (`cautious`, its risk by the same probe).

    Args:
        runs: one or several.
        fields: checked input of an integrator.
        noise: of it.
        tol: relative residual of the solves.
        guard: blend one run too, and be cautious.
        watch: called with the height of least squares and after each iteration of the first run.

    Returns:
        (N, 1, H, W); differentiable, with choices held fixed.
    """
    here = _Surface(fields, noise.trust, tol)
    start = here.integrate(here.slopes)
    watch(start)
    heights = []
    for k, run in enumerate(runs):
        heights.append(here.run(run, start, noise.level, watch if k == 0 else _nothing))
    if len(runs) == 1 and not guard:
        return heights[0]
    with torch.no_grad():
        level, n = noise.level.detach(), _probe(fields, noise)
        moved = here.height_change(n)
        step = 0.1 * level[:, None, None, None]
        step = torch.where(step > 0, step, 1)
        there = _Surface(fields._replace(gradient=fields.gradient.detach() + step * n), noise.trust, tol)
        again = there.integrate(there.slopes, start)
        ends = [there.run(run, again, level) for run in runs]
        changes = torch.stack([(end - z) / step for end, z in zip(ends, heights, strict=True)])
        weights = sure_weights(torch.stack(heights), changes, start, moved, level, fields.steps, _NORM)
    blend = start + (weights.mT[:, :, None, None, None] * (torch.stack(heights) - start)).sum(0)
    return cautious(blend, start, blend, noise.level, fields.steps, moved) if guard else blend


@dataclass(frozen=True)
class _Surface:
    """Measured slopes and what the solves need of them."""

    fields: Fields
    noise_trust: Tensor | None
    tol: float

    @property
    def slopes(self) -> Tensor:
        """On the edges."""
        return edge_slopes(*self.fields[:3])[0]

    def integrate(self, slopes: Tensor, z0: Tensor | None = None) -> Tensor:
        """The solve, from a guess."""
        _, mask, weight, anchor, r, steps, *_ = self.fields
        w = edge_slopes(self.fields.gradient, mask, weight)[1]
        guess = None if z0 is None else z0.detach()
        return solve(slopes, w, anchor, r, tol=self.tol, z0=guess, pixel_size=steps).height

    def height_change(self, change: Tensor) -> Tensor:
        """What a change of the gradient does to the height of least squares."""
        anchor = None if self.fields.anchor is None else torch.zeros_like(self.fields.anchor)
        moved = _Surface(self.fields._replace(gradient=change, anchor=anchor), None, self.tol)
        return moved.integrate(moved.slopes)

    def run(self, run: Run, start: Tensor, level: Tensor, watch: Callable[[Tensor], None] = _nothing) -> Tensor:
        """The height after all iterations of a run."""
        v, w = edge_slopes(*self.fields[:3])
        valid, coded = continued(start, w, self.fields.steps, _FILLED * self.tol, max(run.sizes))
        valid = torch.ones_like(v, dtype=torch.bool) if valid is None else valid
        known = Known(valid.to(v), None if self.noise_trust is None else extend_edges(self.noise_trust))
        a, z = GradientOperator("forward", self.fields.steps), start
        for iteration in range(run.n_iter):
            seen = torch.where(valid, extend_edges(a(z)), coded)
            coded = run.code(seen, level, self.fields.steps, iteration, known)
            z = self.integrate((v + KAPPA * coded) / (1 + KAPPA), z)
            watch(z)
        return z


def continued(
    z: Tensor, w: Tensor | None, steps: tuple[float, float], tol: float, reach: int | None = None
) -> tuple[Tensor | None, Tensor]:
    """The edges whose slopes are measured, and slopes for the others: those of the harmonic extension.

    It goes `reach` pixels beyond the window of the measured ones (None: everywhere), where the largest patches end that
    hold one of them.
    """
    if w is None:
        return None, z
    held = edge_ends(w) > 0
    if not is_concrete(held) or not bool(held.all()):
        region = None if reach is None else _around(held, reach)
        z = harmonic_extension(z, held, region, tol=tol, pixel_size=steps)
    return extend_edges(w) > 0, extend_edges(GradientOperator("forward", steps)(z))


def _around(held: Tensor, reach: int) -> Tensor:
    """(N, 1, H, W) bool: the window of the held pixels of each surface, so many pixels larger on every side."""
    near = []
    for dim in (-1, -2):
        hit = held.any(dim, keepdim=True)
        at = torch.arange(hit.numel() // len(hit), device=held.device).view(hit.shape[1:])
        first = torch.where(hit, at, at.numel()).amin((-2, -1), keepdim=True)
        last = torch.where(hit, at, -1).amax((-2, -1), keepdim=True)
        near.append((at >= first - reach) & (at <= last + reach))
    return near[0] & near[1]


def _probe(fields: Fields, noise: Noise) -> Tensor:
    """Random signs with the relative noise of each sample."""
    n = signs(fields.gradient).expand_as(fields.gradient)
    if noise.pixels is not None:
        n = n * torch.where(noise.pixels > 0, torch.where(noise.pixels > 0, noise.pixels, 1).rsqrt(), 0)
    return n if fields.mask is None else torch.where(fields.mask, n, 0)
