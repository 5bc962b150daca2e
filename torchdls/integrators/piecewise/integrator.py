"""Piecewise: surfaces that jump, in pieces, with nothing to tune."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls._tracing import is_concrete
from torchdls.dictionary.normals import code_normals, curl_noise
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import Quadratic
from torchdls.integrators.iterative import Callback, Iterative
from torchdls.integrators.piecewise.measured import GRAZING, believed, filled, follows_tilt, measure
from torchdls.integrators.piecewise.search import Problem, search
from torchdls.integrators.slope_dls import SlopeDLS
from torchdls.operators import edge_slopes, present_edges
from torchdls.solvers import solve
from torchdls.solvers.poisson import fold_vmap

_NOISY = math.radians(0.9)  # noise of the normals, per tangential component, from which they are coded
_LEFT = 0.4  # share of the noise that the coder leaves
_HELD = 1e-8  # weight of the jumps found, as part of the largest of the edges


class PiecewiseResult(NamedTuple):
    """What `Piecewise.solve` returns; always batched.

    Attributes:
        height: (N, 1, H, W).
        jump: (N, 2, H, W) probability that the surface jumps across the edge to the next column, and to the next row;
            0 where there is no edge.
        pieces: (N, 1, H, W) int64, what is left once jumps are cut: 1 for the largest, 2 for the next, .. ; 0 outside
            the mask.
        tied: (N, K) bool for K pieces: False for a piece whose contour jumps all around and which no anchor holds. Its
            height is a guess.
        smooth: (N,) bool, whether no evidence of jumps was found. The height is then that of `SlopeDLS`, or that of the
            last solve where noise is larger on steep slopes, as that of normals is.
        noise: (N,) of the normals, in radians per tangential component.

    Example:
        >>> result = torchdls.Piecewise().solve(torchdls.SURFACES["peaks"](24).gradient)
        >>> result.pieces.unique().tolist(), result.tied.tolist(), result.smooth.tolist()
        ([1], [[True]], [True])
    """

    height: Tensor
    jump: Tensor
    pieces: Tensor
    tied: Tensor
    smooth: Tensor
    noise: Tensor

    @property
    def iterations(self) -> Tensor:
        """(N,) 1: the search is a fixed number of solves."""
        return torch.ones_like(self.noise, dtype=torch.int64)

    @property
    def converged(self) -> Tensor:
        """(N,) True."""
        return torch.ones_like(self.noise, dtype=torch.bool)


class Piecewise(Iterative[PiecewiseResult]):
    r"""Surfaces that jump, as the views of things before others do, with nothing to tune.

        z = argmin  \sum_e w_e ((A z)_e - v_e)^2 + k \sum_e ((A z)_e - d_e)^2 + anchors,      k = 1e-8 max w

    with slopes v = `edge_slopes` and weights w and jumps d that a search finds first, in depths y that grow away from
    the viewer (by pixels: y = -z, or focal length times log depth):

    1. Noise of the normals is read from the curl of the slopes; where it exceeds 0.9 degrees, the search goes by coded
       normals (`denoise_normals`). The last solve then goes by those that came, linear in their noise, which averages
       out: coding shrinks what is steep. Only where step 4 takes `Bilateral` does it stay with the coded ones.
    2. Every edge gets two probabilities of being cut, one for either side being nearer: a logistic regression on the
       angles at which the two normals meet and graze, fitted once on rendered scenes and calibrated on others. So a cut
       has a cost, c = log((1 - P) / P) + log(range / s) - 1, with s the residual that curvature and noise leave.
    3. The energy \sum_e c_e r^2 / (r^2 + s^2), r = A y - v and c that of the side that r makes nearer, is lowered by
       reweighted solves from least squares with all open that may be cut, with s falling from 4 s to s and costs that
       fall where contours go on; under noise by more of them. What is found tells where the surface jumps, and into
       which pieces it falls.
    4. It is not believed where a fifth of its jumps are clearly in the less likely order, or a tenth of the pixels in
       pieces that nothing ties, which lie anywhere: the height is then that of six reweighted solves from `Bilateral`.

    Where no jump is found, the height is that of `SlopeDLS`, on a field that does not jump; but that of the last solve
    where the noise is found to be one of normals, which makes steep slopes much worse than flat ones. A piece whose
    contour jumps all around has no tie in the slopes: its height is a guess, the result says so (`tied`), and an anchor
    sets it right.

    The derivative is that of the last solve, with w and d (and so the jumps) held fixed.

    The gradient of log depth needs the focal length, by which slopes are brought to pixels and which tells that depths
    grow away; without one, heights grow towards the viewer. The rule has a scale, one pixel: the method does not scale
    with the slopes. The work is some 10 to 15 direct factors, or 30 to 70 where step 4 takes `Bilateral`, in float64;
    memory as in `solve`.

    Args:
        focal_length: of the camera in pixels, where the gradient is that of log depth; None for heights.
        noise: None to read it from the curl, and to code the normals of the slopes: give slopes as they came. Or, where
            they are those of normals that `denoise_normals` has coded, the `sigma` that it found; 0 for slopes without
            noise.
        solve_tol: relative residual of the last solve and of its derivative.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: bilateral trusts after Cao, Santo, Shi, Okura, Matsushita (ECCV 2022); graduated robust estimation after
    Black, Rangarajan (1996).

    Example:
        >>> x = torch.arange(32.0).expand(32, 32)
        >>> block = (x > 8) & (x.mT > 8) & (x.mT < 24)
        >>> slopes = torch.stack([0.5 * block, torch.zeros(32, 32)])[None]  # a ramp, hinged at its left
        >>> true = torch.where(block, (x - 8) / 2, 0.0)[None, None]
        >>> methods = torchdls.LeastSquares(), torchdls.Piecewise()
        >>> [round(float(torchdls.rmse(method(slopes), true)), 1) for method in methods]
        [2.7, 0.1]
    """

    _steady = True

    def __init__(
        self,
        focal_length: float | None = None,
        *,
        noise: float | None = None,
        solve_tol: float = 1e-8,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        given = {"focal_length": focal_length, "noise": noise}
        check_numbers("Piecewise", solve_tol=solve_tol, **{name: x for name, x in given.items() if x is not None})
        if focal_length is not None and not 0 < focal_length < float("inf"):
            raise ValueError(f"Piecewise: focal_length={focal_length!r} given, a positive number or None is needed")
        if noise is not None and not 0 <= noise < 1:
            raise ValueError(f"Piecewise: noise={noise!r} given, radians from 0 to below 1 or None are needed")
        if not solve_tol > 0:
            raise ValueError(f"Piecewise: solve_tol={solve_tol!r} given, a positive number is needed")
        self.focal_length, self.noise, self.solve_tol = focal_length, noise, solve_tol

    def _to_pixel_size(self, result: PiecewiseResult) -> PiecewiseResult:
        """The height in the unit of `pixel_size`."""
        return result._replace(height=result.height * self._unit)

    def _data_term(self, fields: Fields) -> Quadratic:
        """One quadratic, once the search has found which edges hold and by how much the others jump."""
        v, w, steps, _ = self._held(fields)[0]
        return Quadratic(v.to(fields.gradient.dtype), None if w is None else w.to(fields.gradient.dtype), steps)

    @property
    def _scale(self) -> float:
        """By which the gradient becomes that of a depth in pixels."""
        return -1.0 if self.focal_length is None else self.focal_length

    def _held(self, fields: Fields) -> tuple[Quadratic, Tensor, tuple[Tensor, ...]]:
        """The last quadratic, in float64; the noise; cuts, which surfaces have none, pieces, and which are tied."""
        scale = self._scale
        raw = scale * filled(fields.gradient.double(), fields)
        coded, noise = self._coded(fields, raw)
        w, d, doubtful, *found = _Search.apply(
            coded, raw, fields.mask, fields.weight, fields.anchor, fields.anchor_weight, noise, scale, fields.steps
        )
        v = self._told(fields, coded, raw, d, torch.where(doubtful, 0, noise))
        return self._joined(fields, v / scale, w, d / scale), noise, tuple(found)

    def _iterate(self, fields: Fields, callback: Callback | None = None) -> PiecewiseResult:
        """The search, the last solve, and what it says of pieces."""
        (v, w, steps, _), noise, (cut, smooth, pieces, tied) = self._held(fields)
        anchor, r = (None if f is None else f.double() for f in (fields.anchor, fields.anchor_weight))
        height = solve(v, w, anchor, r, tol=self.solve_tol, pixel_size=steps).height.to(fields.gradient.dtype)
        even = smooth & ~((noise > 0) & follows_tilt(self._scale * fields.gradient, _inside(fields)))
        if not is_concrete(even) or bool(even.any()):
            height = torch.where(even[:, None, None, None], SlopeDLS()._integrate(fields), height)
        return PiecewiseResult(height, cut.to(height.dtype), pieces, tied, smooth, noise.to(height.dtype))

    def _coded(self, fields: Fields, p: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes of the depth in pixels without noise (N, 2, H, W), and what noise their normals had (N,)."""
        if self.noise is not None:
            return p, p.new_full((len(p),), self.noise)
        n = _facing(p)
        inside = _inside(fields)
        noise = curl_noise((p * n).detach(), n.detach(), inside)
        noisy = noise > _NOISY
        noise = torch.where(noisy, noise, 0)
        if is_concrete(noisy) and not bool(noisy.any()):
            return p, noise
        unit = code_normals(torch.where(inside, torch.cat([p * n, n], 1), 0), inside, noise)
        facing = unit[:, 2:].clamp(min=GRAZING)
        coded = torch.where(inside, unit[:, :2] / torch.where(inside, facing, 1), p)
        return torch.where(noisy[:, None, None, None], coded, p), noise

    def _told(self, fields: Fields, coded: Tensor, raw: Tensor, d: Tensor, noise: Tensor) -> Tensor:
        """(N, 2, H, W) what the pixels say of the slope of every edge, in depths.

        Without noise the mean of both ends. With noise, by normals (b, n) as they came and slopes d of the surface that
        was found from coded ones, d + mean (b - n d) h with h = m / (m^2 + noise^2), m the coded n: linear in the
        noise, which so averages out, while coding shrinks what is steep.
        """
        weight = None if fields.weight is None else fields.weight.double()
        v, _ = edge_slopes(believed(coded), fields.mask, weight)
        if self.noise is not None or (is_concrete(noise) and not bool((noise > 0).any())):
            return v
        n, m = (_facing(p) for p in (raw, coded.detach()))
        m = m.clamp(min=GRAZING)
        h = m / (m.square() + noise[:, None, None, None].square())
        b, _ = edge_slopes(h * n * raw, fields.mask, weight)
        share, _ = edge_slopes((h * n).expand_as(raw), fields.mask, weight)
        return torch.where(noise[:, None, None, None] > 0, d + b - share * d, v)

    def _joined(self, fields: Fields, v: Tensor, w: Tensor, d: Tensor) -> Quadratic:
        """Of slopes v of the edges, held to jumps d where edges are cut."""
        weight = None if fields.weight is None else fields.weight.double()
        _, trust = edge_slopes(fields.gradient.double(), fields.mask, weight)
        trust = present_edges(v) if trust is None else trust
        w, hold = w * trust, (trust > 0) * _HELD * (w * trust).detach().flatten(1).amax(1)[:, None, None, None]
        total = w + hold
        return Quadratic((w * v + hold * d) / torch.where(total > 0, total, 1), total, fields.steps)


def _inside(fields: Fields) -> Tensor:
    """(N, 1, H, W) bool, where slopes are told."""
    size = fields.gradient[:, :1]
    inside = torch.ones_like(size, dtype=torch.bool) if fields.mask is None else fields.mask.expand_as(size)
    return inside if fields.weight is None else inside & (fields.weight > 0).all(1, keepdim=True)


def _facing(p: Tensor) -> Tensor:
    """(N, 1, H, W) cosine between normal and line of sight."""
    return (1 + p.square().sum(1, keepdim=True)).rsqrt()


class _Search(torch.autograd.Function):
    """Weights, slopes and cuts (N, 2, H, W) of the depth found; nothing of it has a derivative.

    Returns:
        weights and slopes; (N,) whether jumps are doubtful; probability of a cut; (N,) whether none was found;
        pieces (N, 1, H, W); tied (N, K).
    """

    @staticmethod
    def forward(
        p: Tensor,
        raw: Tensor,
        mask: Tensor | None,
        weight: Tensor | None,
        anchor: Tensor | None,
        anchor_weight: Tensor | None,
        noise: Tensor,
        scale: float,
        steps: tuple[float, float],
    ) -> tuple[Tensor, ...]:
        double = (None if f is None else f.double() for f in (weight, anchor, anchor_weight))
        weight, anchor, anchor_weight = double
        anchor = None if anchor is None else scale * anchor
        pull = None if anchor_weight is None else anchor_weight / scale**2
        fields = Fields(raw, mask, weight, anchor, pull, steps)
        problem = Problem.of(measure(p, fields, _LEFT * noise), noise, fields)
        y, w, doubtful, *found = search(problem)
        return w, problem.slopes(y), doubtful, *found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[None, ...]:
        return (None,) * 9

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, ...]:
        return (None,) * 7

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        outputs = _Search.apply(*fold_vmap(info.batch_size, in_dims, inputs))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0,) * len(outputs)
