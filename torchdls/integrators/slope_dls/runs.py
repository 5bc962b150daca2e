"""One run: slopes coded by cosines and polynomials at many scales, with a threshold that falls from step to step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchdls._tracing import is_concrete, is_recorded
from torchdls.integrators.slope_dls import strips_fused
from torchdls.integrators.slope_dls.bases import PatchNoise, Places
from torchdls.integrators.slope_dls.blend import blend_by_waves, signs
from torchdls.integrators.slope_dls.coding import Coded, added, average
from torchdls.integrators.slope_dls.known import Known
from torchdls.integrators.slope_dls.waves import cautious, shrink_slow_waves
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.operators.edges import extend_edges, wrapped_edge_slopes
from torchdls.operators.modes import Boundary
from torchdls.selection import discrepancy_guard
from torchdls.solvers import solve
from torchdls.solvers.periodic import solve_periodic

PERIOD = 16.0  # pixels: the waves to shrink are longer
_LAST = (0.5, 0.4)  # thresholds of two iterations after a blend
KAPPA = 25.0  # trust in the coded slopes, as a multiple of that in the measured ones


class Grid(NamedTuple):
    """A full grid with equal trust: its steps (dx, dy), and how it ends."""

    steps: tuple[float, float]
    boundary: Boundary = "neumann"

    def slopes(self, gradient: Tensor) -> Tensor:
        """On the edges."""
        return edge_slopes(gradient)[0] if self.boundary == "neumann" else wrapped_edge_slopes(gradient)

    def differences(self, z: Tensor) -> Tensor:
        """A z, continued over the edges that are not there."""
        found = GradientOperator("forward", self.steps, self.boundary)(z)
        return extend_edges(found) if self.boundary == "neumann" else found

    def solve(self, v: Tensor) -> Tensor:
        """The height of slopes on the edges."""
        if self.boundary == "neumann":
            return solve(v, pixel_size=self.steps).height
        return solve_periodic(v, pixel_size=self.steps)

    def least_squares(self, gradient: Tensor) -> Tensor:
        """The height of slopes at the pixels."""
        return self.solve(self.slopes(gradient))


@dataclass(frozen=True)
class Run:
    """What one run does.

    Args:
        sizes: sides of the patches; those that do not fit the image are left out.
        whole: the largest square that fits is a patch too.
        tau: first and last threshold, in standard deviations of each coefficient; linear in between.
        weights: of a patch with K kept coefficients in the average: "size" is size^2 / (1 + K), the inverse variance
            of its pixels; "count" 1 / (1 + K); "equal" 1.
        turned: code the slopes along the diagonals, (p + q, p - q) / sqrt 2.
        smooth: polynomials in the bases of patches from 16 pixels on.
        n_iter: number of iterations.
    """

    sizes: tuple[int, ...] = (4, 8, 16, 32, 64)
    whole: bool = True
    tau: tuple[float, float] = (1.6, 0.3)
    weights: Literal["size", "count", "equal"] = "size"
    turned: bool = False
    smooth: bool = True
    n_iter: int = 8

    def places(self, shape: tuple[int, int], iteration: int) -> list[Places]:
        """The patches of an iteration."""
        side = min(shape)
        sizes = [s for s in self.sizes if s <= side]
        if (self.whole and side not in sizes) or not sizes:
            sizes.append(side)
        return [Places.at(iteration, shape, size, self.smooth) for size in sizes]

    def threshold(self, iteration: int) -> float:
        """tau of an iteration."""
        first, last = self.tau
        return first + (last - first) * iteration / max(1, self.n_iter - 1)

    def heights(self, gradient: Tensor, start: Tensor, noise: Tensor, grid: Grid, guard: bool) -> Iterator[Tensor]:
        """The height (N, 1, H, W) after each iteration, on a full rectangle with equal trust.

        Args:
            gradient: (N, 2, H, W).
            start: (N, 1, H, W), the least-squares height.
            noise: (N,) standard deviation of one gradient sample.
            grid: of the heights.
            guard: give back what was removed beyond the noise (`discrepancy_guard`).
        """
        v, z = grid.slopes(gradient), start
        for iteration in range(self.n_iter):
            coded = self.code(grid.differences(z), noise, grid.steps, iteration, boundary=grid.boundary)
            z = grid.solve((v + KAPPA * coded) / (1 + KAPPA))
            z = discrepancy_guard(z, start, noise, grid.steps, boundary=grid.boundary) if guard else z
            yield z

    def code(
        self,
        slopes: Tensor,
        noise: Tensor,
        steps: tuple[float, float],
        iteration: int,
        known: Known | None = None,
        boundary: Boundary = "neumann",
    ) -> Tensor:
        """The mean of all estimates of all patches, (N, 2, H, W).

        Args:
            slopes: (N, 2, H, W).
            noise: (N,) standard deviation of one gradient sample.
            steps: (dx, dy).
            iteration: from 0.
            known: where the slopes are measured; the noise then is that far from every border, and a patch weighs as
                much as it knows. Where no patch knows anything the slopes come back as they are. None: a full
                rectangle with equal trust.
            boundary: "neumann", or "periodic": patches reach around the torus.
        """
        tau, shape = self.threshold(iteration), (slopes.shape[-2], slopes.shape[-1])
        given, slopes = slopes, _turn(slopes) if self.turned else slopes
        found = None  # summed scale by scale: no more than one is held beside the sum
        for places in self.places(shape, iteration):
            level, so_far = tau * noise[:, None, None, None], None if self.turned else found
            if boundary == "periodic":
                part = self._code_around(places, slopes, level, steps, so_far)
            else:
                part = self._code(places, slopes, level, steps, known, so_far)
            found = _turned_back(part, found) if self.turned else part
        assert found is not None
        return average([found]) if known is None else average([found], given)

    def _code_around(
        self, places: Places, slopes: Tensor, level: Tensor, steps: tuple[float, float], so_far: Coded | None
    ) -> Coded:
        """On a torus: laid out flat, so that patches find all their pixels, and folded back."""
        flat, *positions = places.around()
        rows, columns = (p.to(slopes.device) for p in positions)
        noise = PatchNoise(places, steps, self.turned, "torus")
        coded = self._code_patches(flat, slopes.index_select(-2, rows).index_select(-1, columns), level, noise)

        def folded(x: Tensor) -> Tensor:
            narrow = x.new_zeros(*x.shape[:-2], places.shape[0], x.shape[-1]).index_add(-2, rows, x)
            return narrow.new_zeros(*x.shape[:-2], *places.shape).index_add(-1, columns, narrow)

        return added(Coded(*map(folded, coded)), so_far)

    def _code(
        self,
        places: Places,
        slopes: Tensor,
        level: Tensor,
        steps: tuple[float, float],
        known: Known | None,
        so_far: Coded | None = None,
    ) -> Coded:
        if known is None:
            return self._code_patches(places, slopes, level, PatchNoise(places, steps, self.turned), None, so_far)
        far, trust, level = PatchNoise(places, steps, where="far"), known.weight(places), level * known.level(places)
        if not is_concrete(trust):
            return self._code_patches(places, slopes, level, far, trust, so_far)
        part, (down, across), at = places.within((trust > 0).any(0).any(0))
        level = level[:, :, at[0], at[1]] if level[0, 0].numel() > 1 else level
        coded = self._code_patches(part, slopes[..., down, across], level, far, trust[:, :, at[0], at[1]])
        (h, w), (top, left) = places.shape, (down.start, across.start)
        padded = (functional.pad(x, (left, w - across.stop, top, h - down.stop)) for x in coded)
        return added(Coded(*padded), so_far)

    def _code_patches(
        self,
        places: Places,
        slopes: Tensor,
        level: Tensor,
        noise: PatchNoise,
        trust: Tensor | None = None,
        so_far: Coded | None = None,
    ) -> Coded:
        if strips_fused.serves(places, *(x for x in (slopes, level, trust) if x is not None)):
            return strips_fused.code(places, slopes, level, noise, trust, self.weights, so_far)
        strips, totals, weights = places.down(slopes), [], []
        for rows in places.strips(slopes.shape[0]):
            coefficients = places.across(strips[..., rows, :])
            own = level[:, :, rows] if level.shape[2] > 1 else level
            in_place = not is_recorded(coefficients, level)
            kept = _above(coefficients, own[..., None], noise.of(rows, slopes), in_place)
            coefficients = coefficients.mul_(kept) if in_place else coefficients * kept
            weight = self._weight(places.size, kept, None if trust is None else trust[:, :, rows])
            if weight is not None:
                weights.append(weight)
                weight = weight[..., None]
                coefficients = coefficients.mul_(weight) if in_place else coefficients * weight
            estimates = places.back_across(coefficients)
            if in_place:
                strips[..., rows, :] = estimates  # nobody asks for what was there any more
            else:
                totals.append(estimates)
        total = places.back_down(torch.cat(totals, -2) if totals else strips)
        weight = places.spread(torch.cat(weights, 2)) if weights else places.coverage(slopes)
        return added(Coded(total, weight), so_far)

    def _weight(self, size: int, kept: Tensor, trust: Tensor | None) -> Tensor | None:
        """(N, 2, rows, columns) of patches in the average; None for 1."""
        if self.weights == "equal":
            return trust
        weight = (size**2 if self.weights == "size" else 1) / (1 + kept.sum(0).sum(-1))
        return weight if trust is None else weight * trust


def _above(coefficients: Tensor, level: Tensor, noise: Tensor, in_place: bool) -> Tensor:
    """1 where a coefficient is above level x noise in size, else 0; without a derivative."""
    if in_place:
        return coefficients.abs().addcmul_(level, noise, value=-1).gt_(0)
    return (coefficients.detach().abs() - (level * noise).detach()).relu().sign()


FOUR = (
    Run(),
    Run(turned=True),
    Run(sizes=(8, 16, 32, 64), tau=(1.8, 0.3), weights="equal"),
    Run(sizes=(4, 8, 16), whole=False, weights="count", smooth=False),
)
QUICK = (Run(sizes=(8, 16, 32, 64), tau=(1.8, 0.3), weights="equal", n_iter=6),)
HOLED = (Run(sizes=(8, 16, 32, 64), whole=False, tau=(1.8, 0.3), weights="equal"),)
HOLED_QUICK = (replace(HOLED[0], n_iter=4),)


def smooth(
    runs: Sequence[Run],
    gradient: Tensor,
    noise: Tensor,
    grid: Grid,
    guard: bool = True,
    watch: Callable[[Tensor], None] = lambda z: None,
) -> Tensor:
    """The height of one run, or of several blended by SURE; then its slow waves shrunk, and least squares kept in mind.

    After a blend the first of the runs goes on from there for two iterations.

    Args:
        runs: one or several.
        gradient: (N, 2, H, W), full rectangles with equal trust.
        noise: (N,) standard deviation of one gradient sample.
        grid: of the heights.
        guard: `discrepancy_guard` in every iteration, and `cautious` at the end.
        watch: called with the height after each iteration of the first run.

    Returns:
        (N, 1, H, W); differentiable, with the supports of the codes, the weights of the blend and the choices of the
        shrinkage held fixed.
    """
    start, blend = blended(runs, gradient, noise, grid, guard, watch)
    height = shrink_slow_waves(blend, start, noise, grid.steps, PERIOD, grid.boundary)
    height = _polished(runs[0], height, gradient, noise, grid) if len(runs) > 1 else height
    return cautious(height, start, blend, noise, grid.steps, boundary=grid.boundary) if guard else height


def _polished(run: Run, z: Tensor, gradient: Tensor, noise: Tensor, grid: Grid) -> Tensor:
    """Two more iterations from a height whose waves, slow ones too, were seen to."""
    falling = run.tau[0] > run.tau[1]
    last = replace(run, n_iter=min(run.n_iter, len(_LAST)), tau=_LAST if falling else run.tau)
    v = grid.slopes(gradient)
    for iteration in range(last.n_iter):
        coded = last.code(grid.differences(z), noise, grid.steps, iteration, boundary=grid.boundary)
        z = grid.solve((v + KAPPA * coded) / (1 + KAPPA))
    return z


def blended(
    runs: Sequence[Run],
    gradient: Tensor,
    noise: Tensor,
    grid: Grid,
    guard: bool = True,
    watch: Callable[[Tensor], None] = lambda z: None,
) -> tuple[Tensor, Tensor]:
    """The least-squares height, and that of `smooth` before its slow waves are looked at."""
    start = grid.least_squares(gradient)
    heights = []
    for k, run in enumerate(runs):
        z = start
        for following in run.heights(gradient, start, noise, grid, guard):
            z = following
            if k == 0:
                watch(z)
        heights.append(z)
    if len(runs) == 1:
        return start, heights[0]
    return start, _blend(runs, torch.stack(heights), start, gradient, noise, grid, guard)


def _blend(
    runs: Sequence[Run],
    heights: Tensor,
    start: Tensor,
    gradient: Tensor,
    noise: Tensor,
    grid: Grid,
    guard: bool,
) -> Tensor:
    """The runs' heights as `blend_by_waves` has them, from a second round of the runs on probed data."""
    with torch.no_grad():
        n, level = signs(gradient).expand_as(gradient), noise.detach()
        step = 0.1 * level[:, None, None, None]
        step = torch.where(step > 0, step, 1)
        probed = gradient.detach() + step * n
        again = grid.least_squares(probed)
        moved = [[again, *run.heights(probed, again, level, grid, guard)][-1] for run in runs]
        changes = (torch.stack(moved) - heights.detach()) / step
        pushed = grid.least_squares(n)
    return blend_by_waves(heights, changes, start, pushed, level, grid.steps, boundary=grid.boundary)


def _turned_back(part: Coded, so_far: Coded | None) -> Coded:
    """Sums along the diagonals as those in x and y, whose components, now mixed, share one weight."""
    if strips_fused.installed_for(*part) and part.weight.shape == part.total.shape:
        return strips_fused.turned_back(part, so_far)
    weight = part.weight.mean(1, keepdim=True)
    return added(Coded(_turn(part.total / part.weight) * weight, weight), so_far)


def _turn(slopes: Tensor) -> Tensor:
    """(p + q, p - q) / sqrt 2, which is its own inverse."""
    p, q = slopes[:, :1], slopes[:, 1:]
    return torch.cat([p + q, p - q], 1) / math.sqrt(2)
