"""The linear solve (*), its derivative, and its preconditioner."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls.operators import GradientOperator, as_pixel_size
from torchdls.operators.edges import edge_ends, present_edges
from torchdls.solvers.cg import CGResult, LinearMap, conjugate_gradients
from torchdls.solvers.components import Gauge, free_constants
from torchdls.solvers.direct import solve_direct
from torchdls.solvers.nested_dissection import factor
from torchdls.solvers.preconditioner import preconditioner

# Steps of conjugate gradients after which a direct factor is cheaper; pixels of a batch up to which its memory (2 GB)
# is spent; steps that it then takes at most.
_PATIENCE = 60
_LARGEST = 2**22
_DIRECT_STEPS = 30


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
        residual: (N,) relative residual ||b - H z|| / ||b|| of the normal equations; 0 where a direct solve served.
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


class _Setting(NamedTuple):
    """What the solve needs besides tensors."""

    pixel_size: tuple[float, float]
    tol: float
    max_iter: int


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
    60 steps do not suffice, a direct factor by nested dissection takes over (up to 4 million pixels). On a connected
    component (of the edges with w > 0) that no anchor holds, the height has zero mean; pixels with neither edge nor
    anchor are 0. No ridge is added.

    The derivative is implicit and as exact as the solve itself: with lambda = H^{-1} dL/dz,
    dL/dv = w A lambda, dL/dw = (v - A z)(A lambda), dL/da = r lambda, dL/dr = (a - z) lambda. Memory does not grow
    with the iterations. `z0` is a guess and carries no derivative; which edges have w > 0 is taken as fixed.

    Args:
        v: (N, 2, H, W) slope on each edge, as `edge_slopes` gives it.
        w: (N, 2, H, W) trust in each edge, at least 0; None for 1 everywhere.
        anchor: (N, 1, H, W) anchor heights a; None for 0.
        anchor_weight: r, at least 0: (N, 1, H, W), or (N, 1, 1, 1) or a number for a whole surface; None for 0.
        tol: relative residual at which a surface stops.
        max_iter: limit of conjugate-gradient steps; `ConvergenceWarning` when it is reached.
        z0: (N, 1, H, W) warm start of the conjugate gradients.
        pixel_size: (dx, dy) or one number.

    Returns:
        SolveResult(height, iterations, residual, converged).

    Raises:
        ValueError: a shape does not fit, or `tol`, `max_iter` or `pixel_size` is not positive.

    Source: Simchony, Chellappa, Shao (1990) for the direct solve; Durou, Courteille (2007) for the mask.

    Example:
        >>> slopes, _ = torchdls.edge_slopes(torch.ones(1, 2, 1, 4))
        >>> torchdls.solve(slopes).height.round(decimals=3)
        tensor([[[[-1.5000, -0.5000,  0.5000,  1.5000]]]])
    """
    setting = _Setting(as_pixel_size(pixel_size), tol, max_iter)
    r = _as_weight(anchor_weight, v)
    _check(v, setting, w=w, anchor=anchor, anchor_weight=r, z0=z0)
    weighted = v if w is None else w * v
    b = _A(setting).adjoint(weighted)
    if r is not None and anchor is not None:
        b = b + r * anchor
    if w is None and (r is None or r[0].numel() == 1):
        return direct_result(solve_direct(b, r, setting.pixel_size))
    w = present_edges(v) if w is None else w.expand_as(v)
    r = torch.zeros_like(b) if r is None else r.expand_as(b)
    return SolveResult(*_Solve.apply(b, w, r, z0, None, None, setting)[:4])


def direct_result(z: Tensor) -> SolveResult:
    """What a direct solve gave, as a result of `solve`."""
    zeros = torch.zeros(z.shape[0], dtype=z.dtype, device=z.device)
    return SolveResult(z, zeros.long(), zeros, zeros == 0)


def _A(setting: _Setting) -> GradientOperator:
    return GradientOperator("forward", setting.pixel_size)


def _as_weight(r: Tensor | float | None, like: Tensor) -> Tensor | None:
    if r is None or (isinstance(r, Tensor) and r.ndim):
        return r
    return torch.as_tensor(r, dtype=like.dtype, device=like.device).expand(like.shape[0], 1, 1, 1)


def _check(v: Tensor, setting: _Setting, **fields: Tensor | None) -> None:
    if v.ndim != 4 or v.shape[1] != 2:
        raise ValueError(f"solve: v {tuple(v.shape)} given, (N, 2, H, W) is needed")
    if not setting.tol > 0 or not setting.max_iter > 0:
        raise ValueError(f"solve: tol={setting.tol!r} and max_iter={setting.max_iter!r} given, both must be positive")
    for name, field in fields.items():
        if field is None:
            continue
        channels = (1, 2) if name == "w" else (1,)
        sizes = (v.shape[2:], (1, 1)) if name == "anchor_weight" else (v.shape[2:],)
        fits = field.ndim == 4 and field.shape[0] in (1, v.shape[0])
        if not fits or field.shape[1] not in channels or field.shape[2:] not in sizes:
            raise ValueError(f"solve: {name} {tuple(field.shape)} does not fit v {tuple(v.shape)}")


class _Solve(torch.autograd.Function):
    """z = H(w, r)^+ b by conjugate gradients, with the implicit derivative dz = H^+ (db - dH z).

    It runs in the window of the pixels that have an edge or an anchor, outside of which z = 0. Besides z and how the
    solve went, the outputs hold the gauge in that window, so that the adjoint solve need not find it again.
    """

    @staticmethod
    def forward(
        b: Tensor,
        w: Tensor,
        r: Tensor,
        z0: Tensor | None,
        labels: Tensor | None,
        share: Tensor | None,
        setting: _Setting,
    ) -> tuple[Tensor, ...]:
        z = torch.zeros_like(b)
        rows, columns = _live_window(w, r)
        b, w, r = (t[..., rows, columns] for t in (b, w, r))
        z0 = None if z0 is None else z0[..., rows, columns]
        gauge = free_constants(w, r) if labels is None or share is None else Gauge(labels, share)
        x, iterations, residual, converged = _iterate(b, w, r, z0, gauge, setting)
        if not bool(converged.all()):
            _warn(residual, converged, setting)
        z[..., rows, columns] = gauge.remove(x)
        # Views, since an input may not come back as it is.
        return z, iterations, residual, converged, *(t.view_as(t) for t in gauge)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        _, w, r, *_, setting = inputs
        z, *others = output
        labels, share = others[-2:]
        ctx.mark_non_differentiable(*others)
        ctx.save_for_backward(z, w, r, labels, share)
        ctx.save_for_forward(z, w, r, labels, share)
        ctx.setting = setting

    @staticmethod
    def backward(ctx: Any, dz: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        z, w, r, labels, share = ctx.saved_tensors
        adjoint = _Solve.apply(dz, w, r, None, labels, share, ctx.setting)[0]
        a = _A(ctx.setting)
        dw = -a(adjoint) * a(z) if ctx.needs_input_grad[1] else None
        dr = -adjoint * z if ctx.needs_input_grad[2] else None
        return adjoint, dw, dr, None, None, None, None

    @staticmethod
    def jvp(ctx: Any, db: Tensor | None, dw: Tensor | None, dr: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
        z, w, r, labels, share = ctx.saved_tensors
        a = _A(ctx.setting)
        rhs = torch.zeros_like(z) if db is None else db
        if dw is not None:
            rhs = rhs - a.adjoint(dw * a(z))
        if dr is not None:
            rhs = rhs - dr * z
        return _Solve.apply(rhs, w, r, None, labels, share, ctx.setting)[0], None, None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        outputs = _Solve.apply(*fold_vmap(info.batch_size, in_dims, inputs))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0,) * len(outputs)


def _iterate(b: Tensor, w: Tensor, r: Tensor, z0: Tensor | None, gauge: Gauge, setting: _Setting) -> CGResult:
    """Conjugate gradients with the cosine preconditioner; with a direct factor where weights jump too much for that.

    The factor costs as much as `_PATIENCE` steps (measured from 128^2 to 512^2), so at worst half of the work is lost.
    """
    b = gauge.remove(gauge.remove(b))  # again: a mean left by rounding lies outside the range of H
    z0 = None if z0 is None else gauge.remove(z0)  # what it says of free constants is not for CG to mend
    anchors = _Anchors.of(w, r, gauge, setting)
    scale = None
    if anchors is not None:
        start = anchors.start(b)
        scale = (b - anchors.apply(start)).flatten(1).norm(dim=1)
        z0 = start if z0 is None else anchors.shift(z0, b)
    patience = _PATIENCE if b[0].numel() * b.shape[0] <= _LARGEST else setting.max_iter
    found = conjugate_gradients(
        _normal(w, r, setting), preconditioner(w, r, setting.pixel_size), b, z0,
        tol=setting.tol, max_iter=min(patience, setting.max_iter), project=gauge.correction(), scale=scale,
    )  # fmt: skip
    if not bool(found.converged.all()) and patience < setting.max_iter:
        rest = (~found.converged).nonzero()[:, 0]
        scale = None if scale is None else scale[rest].double()
        direct = _directly(b[rest], w[rest], r[rest], found.x[rest], gauge.select(rest), setting, scale)
        found = found.replace(rest, direct)
    return found if anchors is None else found._replace(x=anchors.shift(found.x, b))


class _Anchors(NamedTuple):
    r"""What anchors on some of the pixels demand of a solve: firm or far from 0, they drown the residuals of the rest.

    So residuals are measured against those of a start that the anchors alone suggest, and the constant c of every
    component that they hold is found from the sum of its equations, \sum_i r_i (z_i + c) = \sum_i b_i.
    """

    labels: Tensor
    r: Tensor
    diagonal: Tensor
    apply: LinearMap

    @classmethod
    def of(cls, w: Tensor, r: Tensor, gauge: Gauge, setting: _Setting) -> _Anchors | None:
        """None without anchors, or where they are on every pixel and so leave nothing to swallow."""
        scale = torch.tensor(setting.pixel_size, dtype=w.dtype, device=w.device).view(1, 2, 1, 1)
        edges = edge_ends(w / scale.square())
        some = gauge.labels.shape[1] > 0 and bool((r > 0).any())
        if not some or bool(((r > 0) | (edges == 0)).all()):
            return None
        return cls(gauge.labels, r, edges + r, _normal(w, r, setting))

    def shift(self, z: Tensor, b: Tensor) -> Tensor:
        """The height with the constants that its equations ask for."""
        rest, trust = ((t.double().flatten(1)) for t in (b - self.apply(z), self.r))
        sums, weights = (torch.zeros_like(t).scatter_add(1, self.labels, t) for t in (rest, trust))
        c = torch.where(weights > 0, sums / torch.where(weights > 0, weights, 1), 0)
        return z + c.gather(1, self.labels).view_as(z).to(z.dtype)

    def start(self, b: Tensor) -> Tensor:
        """The constants of the anchors, and firm anchors where they want to be."""
        z = self.shift(torch.zeros_like(b), b)
        firm = 2 * self.r > self.diagonal
        return z + torch.where(firm, (b - self.apply(z)) / torch.where(firm, self.diagonal, 1), 0)


def _directly(
    b: Tensor, w: Tensor, r: Tensor, x: Tensor, gauge: Gauge, setting: _Setting, norm: Tensor | None
) -> CGResult:
    """The same, preconditioned by a direct factor and in double precision; one step mostly, three where H is singular.

    In the factor alone, one pixel of every free component is held by as much as its edges weigh.
    """
    dtype, gauge = b.dtype, gauge.double()
    b, w, r, x = (t.double() for t in (b, w, r, x))
    scale = torch.tensor(setting.pixel_size, dtype=w.dtype, device=w.device).view(1, 2, 1, 1)
    held = r + torch.where(gauge.pins().view_as(r), edge_ends(w / scale.square()), 0)
    direct = factor(w, held, setting.pixel_size)
    found = conjugate_gradients(
        _normal(w, r, setting), lambda y: gauge.remove(direct.solve(y)), gauge.remove(b), x,
        tol=setting.tol, max_iter=_DIRECT_STEPS, project=gauge.correction(), scale=norm,
    )  # fmt: skip
    return found._replace(x=found.x.to(dtype), residual=found.residual.to(dtype))


def fold_vmap(size: int, in_dims: tuple[int | None, ...], inputs: tuple[Any, ...]) -> list[Any]:
    """The dimension that vmap maps over, folded into the batch of every tensor."""

    def fold(x: Any, dim: int | None) -> Any:
        if not isinstance(x, Tensor):
            return x
        x = x.unsqueeze(0).expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
        return x.flatten(0, 1)

    return [fold(x, d) for x, d in zip(inputs, in_dims, strict=True)]


def _live_window(w: Tensor, r: Tensor) -> tuple[slice, slice]:
    """The smallest rectangle that holds all pixels with an edge or an anchor, on any surface of the batch."""
    live = ((edge_ends(w) + r) > 0).any(0)[0]

    def span(hit: Tensor) -> slice:
        found = hit.nonzero()
        return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 1)

    return span(live.any(1)), span(live.any(0))


def _warn(residual: Tensor, converged: Tensor, setting: _Setting) -> None:
    warnings.warn(
        f"solve: {int((~converged).sum())} of {len(converged)} surfaces stopped after {setting.max_iter} iterations "
        f"at a relative residual of up to {float(residual.max()):.1e}, above tol={setting.tol:.1e}",
        ConvergenceWarning,
        stacklevel=5,  # the caller of `solve`
    )


def _normal(w: Tensor, r: Tensor, setting: _Setting) -> LinearMap:
    """z -> H z = A^T (w A z) + r z, edge by edge: what flows along an edge leaves one end and enters the other."""
    dx, dy = setting.pixel_size
    across, down = (w[:, :1, :, :-1] / dx**2).contiguous(), w[:, 1:, :-1] / dy**2

    def apply(z: Tensor) -> Tensor:
        result = r * z
        for weight, dim in ((across, -1), (down, -2)):
            n = z.shape[dim] - 1
            flow = (z.narrow(dim, 1, n) - z.narrow(dim, 0, n)).mul_(weight)
            result.narrow(dim, 0, n).sub_(flow)
            result.narrow(dim, 1, n).add_(flow)
        return result

    return apply
