"""The linear solve (*), its derivative, and its preconditioner."""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_numbers, check_together, check_whole
from torchdls._precision import full_precision
from torchdls._tracing import all_finite, is_concrete, only_shapes
from torchdls.operators import GradientOperator, as_pixel_size
from torchdls.operators.edges import edge_ends, present_edges
from torchdls.solvers.cg import CGResult, conjugate_gradients
from torchdls.solvers.components import Gauge, free_constants
from torchdls.solvers.direct import solve_direct
from torchdls.solvers.folding import fold_vmap as fold_vmap
from torchdls.solvers.normal_equations import STEEP, WEAK, Setting, directly, normal, slopes_of, spread, squares, steep
from torchdls.solvers.preconditioner import preconditioner
from torchdls.solvers.units import Problem, normalize_problem, plane_of, unit_of

# Steps of conjugate gradients after which a direct factor is cheaper; pixels of a batch up to which its memory (2 GB)
# is spent.
_PATIENCE = 60
_LARGEST = 2**22

# Spread of weights (see `spread`) up to which single precision keeps 1e-5 of the relief; its rounding grows with it.
_SINGLE = 100.0

# Where every pixel is held, those held by so many times the weight of their edges are met by the start.
_FIRM = 100.0


class ConvergenceWarning(UserWarning):
    """An iterative solve reached its limit of iterations before its tolerance.

    Example:
        >>> import warnings
        >>> slopes, mask = torchdls.SURFACES["peaks"](16).gradient, torch.ones(1, 1, 16, 16, dtype=torch.bool).triu()
        >>> with warnings.catch_warnings(action="ignore", category=torchdls.ConvergenceWarning):
        ...     torchdls.LeastSquares(max_iter=1)(slopes, mask).shape
        torch.Size([1, 1, 16, 16])
    """


class SolveResult(NamedTuple):
    """How a solve went.

    Attributes:
        height: (N, 1, H, W).
        iterations: (N,) conjugate-gradient steps taken; 0 where a direct solve served.
        residual: (N,) relative residual ||b - H z|| / ||b|| of the normal equations, once the best plane, the constants
            that anchors ask for and the heights of firm anchors are taken out of b, and every component is brought to
            one scale, times how far the weights of edges are apart; 0 where a direct solve served.
        converged: (N,) bool, whether the residual met the tolerance.

    Example:
        >>> slopes, _ = torchdls.edge_slopes(torch.ones(2, 2, 4, 5))
        >>> result = torchdls.solve(slopes)
        >>> result.height.shape, result.iterations.tolist()
        (torch.Size([2, 1, 4, 5]), [0, 0])
    """

    height: Tensor
    iterations: Tensor
    residual: Tensor
    converged: Tensor


@full_precision
def solve(
    v: Tensor,
    w: Tensor | None = None,
    anchor: Tensor | None = None,
    anchor_weight: Tensor | float | None = None,
    *,
    tol: float = 1e-6,
    max_iter: int = 500,
    z0: Tensor | None = None,
    pixel_size: float | tuple[float, float] = 1.0,
) -> SolveResult:
    r"""The one linear solve around which every integrator is built.

        z = argmin_z  1/2 \sum_e w_e ((A z)_e - v_e)^2  +  1/2 \sum_i r_i (z_i - a_i)^2
        (*)

    with A the forward differences, so H z = A^T (w v) + r a with H = A^T diag(w) A + diag(r).

    Where w is None and r is one number per surface, H is diagonal in the cosine basis and the solve is direct.
    Otherwise conjugate gradients run, preconditioned by such a direct solve; where weights jump by so many orders that
    60 steps do not suffice, or they are more than 1e4 apart, a direct factor by nested dissection takes over (up to 4
    million pixels; then `tol` is an error of heights, and weights may be 1e30 apart, see docs/reliability.md). On a
    connected component (of the edges with w > 0) that no anchor holds, the height has zero mean; pixels with neither
    edge nor anchor are 0. No ridge is added.

    Weights, anchors and slopes may have any scale: each component is solved in units of its own (powers of two, so
    nothing is rounded), less the plane that fits it best and the mean of its anchors. Neither firm anchors nor those
    far from 0 nor weak ones (down to 1e-300 of the edges) nor a steeper component swallow the tolerance of the rest.
    Weights of anchors above 2^60 times the largest edge weight (2^40 in float32) act as that.

    The derivative is implicit and as exact as the solve itself: with lambda = H^{-1} dL/dz,
    dL/dv = w A lambda, dL/dw = (v - A z)(A lambda), dL/da = r lambda, dL/dr = (a - z) lambda. Memory does not grow
    with the iterations. `z0` is a guess and carries no derivative; which edges have w > 0 is taken as fixed.

    Args:
        v: (N, 2, H, W) slope on each edge, as `edge_slopes` gives it.
        w: (N, 2, H, W) trust in each edge, at least 0; None for 1 everywhere. Edges that leave the rectangle (the
            last column of the first channel, the last row of the second) are not there.
        anchor: (N, 1, H, W) anchor heights a; None for 0.
        anchor_weight: r, at least 0: (N, 1, H, W), or (N, 1, 1, 1) or a number for a whole surface; None for 0.
        tol: where a surface stops: the relative residual times how far the weights of edges are apart, which is about
            the error of the height by its relief. Over 384 masked problems (48^2 and 128^2; disks, holes, a sieve and
            corridors; pixels 1:1 to 1:1000; weights up to four orders apart; smooth slopes and pure noise) at
            tol = 1e-4 and 1e-6 the error is at most 3 tol on a disk of square pixels, and 22 tol (a sieve). For
            derivatives that are to pass `torch.autograd.gradcheck`, ask for 1e-12 in float64.
        max_iter: limit of conjugate-gradient steps; `ConvergenceWarning` when it is reached.
        z0: (N, 1, H, W) warm start of the conjugate gradients.
        pixel_size: (dx, dy) or one number.

    Returns:
        SolveResult(height, iterations, residual, converged).

    Raises:
        TypeError: v is not float32 or float64, or another tensor of another dtype.
        ValueError: a shape does not fit, `tol`, `max_iter` or `pixel_size` is not positive, or the height is not
            finite.
        TypeError: v, w, anchor, anchor_weight and z0 are not tensors of one dtype, float32 or float64.

    Source: Simchony, Chellappa, Shao (1990) for the direct solve; Durou, Courteille (2007) for the mask.

    Example:
        >>> slopes, _ = torchdls.edge_slopes(torch.ones(1, 2, 1, 4))
        >>> torchdls.solve(slopes).height.round(decimals=3)
        tensor([[[[-1.5000, -0.5000,  0.5000,  1.5000]]]])
    """
    setting = Setting(as_pixel_size(pixel_size), tol, max_iter)
    given = {"w": w, "anchor": anchor, "z0": z0}
    check_together("solve", v=v, **{name: t for name, t in given.items() if t is not None})
    r = _as_weight(anchor_weight, v)
    _check(v, setting, w=w, anchor=anchor, anchor_weight=r, z0=z0)
    if w is None and (r is None or r[0].numel() == 1):
        return _finite(direct_result(_on_rectangle(v, anchor, r, setting.pixel_size)))
    present = present_edges(v)
    w = present if w is None else torch.where(present > 0, w, 0)
    r = None if r is None else r.expand_as(v[:, :1])
    if only_shapes(v):
        return _shapes_alone(v, w, anchor, r)
    problem = Problem(v, w, anchor, r, z0, setting.pixel_size)
    if v.dtype == torch.float64 or not is_concrete(w) or not _needs_double(problem, setting):
        return _finite(_in_general(problem, setting))
    found = _in_general(problem.double(), setting)
    return _finite(
        found._replace(
            height=found.height.to(v.dtype), residual=found.residual.clamp(max=torch.finfo(v.dtype).max).to(v.dtype)
        )
    )


def _needs_double(problem: Problem, setting: Setting) -> bool:
    """Whether rounding in single precision would be more than 1e-5 of some surface."""
    v, w, _, r, *_ = problem
    if v.numel() > 2 * _LARGEST:
        return bool(steep(w, setting).any())
    w = w.detach()
    return bool((spread(w, torch.zeros_like(w[:, :1]) if r is None else r.detach(), setting) > _SINGLE).any())


def _finite(result: SolveResult) -> SolveResult:
    """The result, if the numbers of its dtype reach so far."""
    if not all_finite(result.height):
        raise ValueError(
            f"solve: the height is not finite: slopes, weights or anchors are not, or beyond {result.height.dtype}"
        )
    return result


def _on_rectangle(v: Tensor, anchor: Tensor | None, r: Tensor | None, pixel_size: tuple[float, float]) -> Tensor:
    """The direct solve. The mean of the height is that of the anchors however weak they are, so it is set apart."""
    b = GradientOperator("forward", pixel_size).adjoint(v)
    if r is None or anchor is None:
        return solve_direct(b, r, pixel_size)
    sides = zip(v.shape[:-3:-1], pixel_size, strict=True)
    least = torch.finfo(v.dtype).eps * min((math.pi / n / d) ** 2 for n, d in sides)
    mean = anchor.mean((-2, -1), keepdim=True)
    b = b + r * (anchor - mean)
    weak = (r > 0) & (r < least)  # they bend nothing, and what rounding makes of the mean would be divided by them
    z = solve_direct(b - b.mean((-2, -1), keepdim=True), r + torch.where(weak, least, 0), pixel_size)
    return z - z.mean((-2, -1), keepdim=True) + torch.where(r > 0, mean, 0)


def _in_general(problem: Problem, setting: Setting) -> SolveResult:
    """The iterative solve, on numbers of order 1 and without the plane and constants that could drown the rest."""
    problem, unit = normalize_problem(problem)
    v, w, anchor, r, z0, pixel_size = problem
    setting = setting._replace(pixel_size=pixel_size)
    slope, level, lift, *found = _Levels.apply(v, w, anchor, r, setting)
    if r is None:
        r = pull = torch.zeros_like(v[:, :1])
    else:
        pull = r * -level if anchor is None else r * (anchor - level)
    z, _, *told = _Solve.apply(v - slope, pull, w, r, None if z0 is None else z0 - level, *found, setting)
    return SolveResult((z + lift) * unit, *told)


def _shapes_alone(v: Tensor, w: Tensor, anchor: Tensor | None, r: Tensor | None) -> SolveResult:
    """A result for tensors without values, linked to all of them: the iterations could not tell when to stop."""
    z = GradientOperator().adjoint(w * v)
    if r is not None:
        z = z + (r if anchor is None else r * anchor)
    return direct_result(z)


def direct_result(z: Tensor) -> SolveResult:
    """What a direct solve gave, as a result of `solve`."""
    n, device = z.shape[0], z.device
    steps, residual = torch.zeros(n, dtype=torch.int64, device=device), torch.zeros(n, dtype=z.dtype, device=device)
    return SolveResult(z, steps, residual, torch.ones(n, dtype=torch.bool, device=device))


def _as_weight(r: Tensor | float | None, like: Tensor) -> Tensor | None:
    if r is None:
        return r
    if isinstance(r, Tensor) and r.ndim:
        check_together("solve", v=like, anchor_weight=r)
        return r
    if not isinstance(r, Tensor):
        check_numbers("solve", anchor_weight=r)
    return torch.as_tensor(r, dtype=like.dtype, device=like.device).expand(like.shape[0], 1, 1, 1)


def _check(v: Tensor, setting: Setting, **fields: Tensor | None) -> None:
    if v.ndim != 4 or v.shape[1] != 2 or 0 in v.shape:
        raise ValueError(f"solve: v {tuple(v.shape)} given, (N, 2, H, W) is needed")
    check_numbers("solve", tol=setting.tol)
    check_whole("solve", max_iter=setting.max_iter)
    if not setting.tol > 0 or not setting.max_iter > 0:
        raise ValueError(f"solve: tol={setting.tol!r} and max_iter={setting.max_iter!r} given, both must be positive")
    for name, field in fields.items():
        if field is None:
            continue
        check_alike("solve", name, field, v.dtype)
        channels = (1, 2) if name == "w" else (1,)
        sizes = (v.shape[2:], (1, 1)) if name == "anchor_weight" else (v.shape[2:],)
        fits = field.ndim == 4 and field.shape[0] in (1, v.shape[0])
        if not fits or field.shape[1] not in channels or field.shape[2:] not in sizes:
            raise ValueError(f"solve: {name} {tuple(field.shape)} does not fit v {tuple(v.shape)}")


class _Levels(torch.autograd.Function):
    """The gauge of a problem, and the plane and constant that are taken out of each component of it.

    None of it needs a derivative: which weights are 0 is fixed, and heights do not depend on planes and constants.

    Returns:
        The slopes of the planes (N, 2, H, W) or (N, 2, 1, 1); what anchors and heights lose (N, 1, H, W); what heights
        get back, the same but for the mean of free components; first and last row and column of the window (N, 4);
        labels, share and pull of the gauge.
    """

    @staticmethod
    def forward(v: Tensor, w: Tensor, anchor: Tensor | None, r: Tensor | None, setting: Setting) -> tuple[Tensor, ...]:
        size = (w.shape[-2], w.shape[-1])
        alive = edge_ends(w) > 0 if r is None else edge_ends(w) + r > 0
        bounds = _live_window(alive)
        rows, columns = _slices(bounds)
        cut = w[..., rows, columns], None if r is None else r[..., rows, columns]
        gauge = free_constants(*cut, least=WEAK).embed(rows, columns, size)
        slope = torch.cat([gauge.mean(v[:, i : i + 1], w[:, i : i + 1]) for i in (0, 1)], 1)
        plane = plane_of(slope, size, setting.pixel_size)
        level, lift = plane, gauge.remove(plane)
        if r is not None:
            constant = gauge.mean(-plane if anchor is None else anchor - plane, r)
            level, lift = level + constant, lift + constant
        level, lift = torch.where(alive, level, 0), torch.where(alive, lift, 0)
        return slope, level, lift, bounds.expand(len(w), -1), *gauge

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[None, ...]:
        return (None,) * 5

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, ...]:
        return (None,) * 7

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        outputs = _Levels.apply(*fold_vmap(info.batch_size, in_dims, inputs))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0,) * len(outputs)


class _Solve(torch.autograd.Function):
    """z = H(w, r)^+ (A^T (w u) + s) and m = u - A z; implicitly dz = H^+ (A^T (w du + dw m) + ds - dr z).

    The sum of s is 0 over components that anchors hold: what asks for their constants is kept apart
    (`Gauge.constants`), as it may be larger than all the rest by many orders.
    It runs in the window of the pixels that have an edge or an anchor, outside of which z = 0.
    """

    @staticmethod
    def forward(
        u: Tensor,
        s: Tensor,
        w: Tensor,
        r: Tensor,
        z0: Tensor | None,
        bounds: Tensor,
        labels: Tensor,
        share: Tensor,
        pull: Tensor,
        setting: Setting,
    ) -> tuple[Tensor, ...]:
        z, m, size = torch.zeros_like(s), u.clone(), (s.shape[-2], s.shape[-1])
        rows, columns = _slices(bounds)
        gauge = Gauge(labels, share, pull).window(rows, columns, size)
        z0 = None if z0 is None else z0[..., rows, columns]
        u, s, w, r = (t[..., rows, columns] for t in (u, s, w, r))
        (x, iterations, residual, converged), misfit = _iterate(u, s, w, r, z0, gauge, setting)
        if not bool(converged.all()):
            _warn(residual, converged, setting)
        z[..., rows, columns], m[..., rows, columns] = x, misfit
        return z, m, iterations, residual, converged

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        _, _, w, r, _, *found, setting = inputs
        z, m, *told = output
        ctx.mark_non_differentiable(*told)
        ctx.save_for_backward(z, m, w, r, *found)
        ctx.save_for_forward(z, m, w, r, *found)
        ctx.setting = setting

    @staticmethod
    @full_precision
    def backward(ctx: Any, dz: Tensor, dm: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        z, m, w, r, bounds, *gauge = ctx.saved_tensors
        constants = Gauge(*gauge).constants(dz, r)
        pull = dz - r * constants - slopes_of(ctx.setting).adjoint(dm)
        bent, fall, *_ = _Solve.apply(torch.zeros_like(m), pull, w, r, None, bounds, *gauge, ctx.setting)
        adjoint = bent + constants
        dw = -fall * m if ctx.needs_input_grad[2] else None
        dr = -adjoint * z if ctx.needs_input_grad[3] else None
        return dm - w * fall, adjoint, dw, dr, None, None, None, None, None, None

    @staticmethod
    def jvp(
        ctx: Any, du: Tensor | None, ds: Tensor | None, dw: Tensor | None, dr: Tensor | None, *_: Any
    ) -> tuple[Tensor | None, ...]:
        z, m, w, r, bounds, *gauge = ctx.saved_tensors
        slope = torch.zeros_like(m) if du is None else du
        pull = torch.zeros_like(z) if ds is None else ds
        if dr is not None:
            pull = pull - dr * z
        constants = Gauge(*gauge).constants(pull, r)
        pull = pull - r * constants
        if dw is not None:
            pull = pull + slopes_of(ctx.setting).adjoint(dw * m)
        bent, left, *_ = _Solve.apply(slope, pull, w, r, None, bounds, *gauge, ctx.setting)
        return bent + constants, left, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        outputs = _Solve.apply(*fold_vmap(info.batch_size, in_dims, inputs))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0,) * len(outputs)


def _iterate(
    u: Tensor, s: Tensor, w: Tensor, r: Tensor, z0: Tensor | None, gauge: Gauge, setting: Setting
) -> tuple[CGResult, Tensor]:
    """Conjugate gradients with the cosine preconditioner; a direct factor where weights jump too much for that.

    The factor costs as much as `_PATIENCE` steps (measured from 128^2 to 512^2), so at worst half of the work is lost.
    """
    patience = _PATIENCE if s.numel() <= _LARGEST else setting.max_iter
    apart = steep(w, setting) & (patience < setting.max_iter)
    if bool(apart.all()):
        return directly(u, s, w, r, gauge, setting)
    found = _by_gradients(u, s, w, r, z0, gauge, setting._replace(max_iter=min(patience, setting.max_iter)), apart)
    misfit = u - slopes_of(setting)(found.x)
    if patience < setting.max_iter and not bool((found.converged & ~apart).all()):
        rest = (apart | ~found.converged).nonzero()[:, 0]
        other, their = directly(u[rest], s[rest], w[rest], r[rest], gauge.select(rest), setting)
        found, misfit = found.replace(rest, other), misfit.index_copy(0, rest, their)
    return found, misfit


def _by_gradients(
    u: Tensor, s: Tensor, w: Tensor, r: Tensor, z0: Tensor | None, gauge: Gauge, setting: Setting, apart: Tensor
) -> CGResult:
    """Preconditioned conjugate gradients, on the surfaces that are not `apart`.

    Anchors that are firm are met by the start, so that residuals are measured by what they leave open.
    """
    b = slopes_of(setting).adjoint(w * u) + s
    b = gauge.balance(gauge.balance(b))  # again: a mean left by rounding lies outside the range of H
    if gauge.share.shape[1] == 0:  # every live pixel is held; the adjoint may ask for a height of the others too
        b = torch.where(edge_ends(w) + r > 0, b, 0)
    edges = edge_ends(w / squares(w, setting))
    if gauge.labels.shape[1]:
        trust = unit_of(gauge.greatest(torch.where(gauge.greatest(edges) > 0, edges, r)))
        b, w, r, edges = (t / trust for t in (b, w, r, edges))
    apply, start, unit = normal(w, r, setting), None, None
    firm = r > (edges if gauge.pull.shape[1] else _FIRM * edges)
    if gauge.pull.shape[1] or bool(firm.any()):
        start = torch.where(firm, b / torch.where(firm, edges + r, 1), 0)
        b = gauge.balance(b - apply(start))
        z0 = None if z0 is None else z0 - start
    z0 = None if z0 is None else gauge.settle(z0)  # what it says of free constants is not for CG to mend
    if gauge.labels.shape[1]:
        unit = _unit_of_components(b, gauge)
        b, z0 = b / unit, None if z0 is None else z0 / unit
    precondition = preconditioner(w, r, setting.pixel_size, weak=bool(gauge.pull.shape[1]))
    b = torch.where(apart.view(-1, 1, 1, 1), 0, b) if bool(apart.any()) else b
    found = conjugate_gradients(
        apply, (lambda b: gauge.settle(precondition(b))) if gauge.pull.shape[1] else precondition, b, z0,
        tol=setting.tol, max_iter=setting.max_iter, project=gauge.correction(),
        deflate=gauge.deflation(), scale=b.flatten(1).norm(dim=1) / spread(w, r, setting),
    )  # fmt: skip
    x = found.x if unit is None else found.x * unit
    if gauge.share.shape[1] == 0:  # weak anchors everywhere leave a constant that residuals hardly see
        part, whole = (t.sum((-2, -1), keepdim=True, dtype=torch.double) for t in (b - r * x, r))
        x = torch.where(edges + r > 0, x + (part / torch.where(whole > 0, whole, 1)).to(x.dtype), 0)
    return found._replace(x=gauge.settle(x if start is None else x + start))


def _unit_of_components(b: Tensor, gauge: Gauge) -> Tensor:
    """(N, 1, H, W): what brings the residuals b to a norm of order 1 on every component.

    Components do not touch, so each has a scale of its own; with one scale, the tolerance of the largest would swallow
    the others.
    """
    largest = unit_of(gauge.greatest(b.abs()))
    norm = unit_of(gauge.sums((b / largest).square().flatten(1)).sqrt())
    return largest * norm.view_as(b)


def _live_window(alive: Tensor) -> Tensor:
    """First and last row, first and last column (1, 4) of the smallest rectangle with all live pixels of the batch."""
    alive = alive.any(0)[0]
    ends = []
    for hit in (alive.any(1), alive.any(0)):
        found = hit.nonzero()
        ends += [int(found[0]), int(found[-1])] if len(found) else [0, 0]
    return torch.tensor([ends], device=alive.device)


def _slices(bounds: Tensor) -> tuple[slice, slice]:
    """The window of the whole batch."""
    top, bottom, left, right = bounds[0].tolist()
    return slice(top, bottom + 1), slice(left, right + 1)


def _warn(residual: Tensor, converged: Tensor, setting: Setting) -> None:
    warnings.warn(
        f"solve: {int((~converged).sum())} of {len(converged)} surfaces stopped after {setting.max_iter} iterations "
        f"at a relative residual (error, for weights {STEEP:.0e} apart) of up to {float(residual.max()):.1e}, "
        f"where tol={setting.tol:.1e} is asked for",
        ConvergenceWarning,
        stacklevel=7,  # the caller of `solve`
    )
