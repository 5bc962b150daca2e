"""Convex robust data terms, minimised by ADMM: total variation, L1 and Huber."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, cast

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls._tracing import holds_everywhere
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import DataTerm
from torchdls.integrators.robust.base import Estimate, Robust
from torchdls.integrators.robust.residuals import Terms, sample_noise

_RELAX = 1.8  # over-relaxation of ADMM
_HUBER = 1.345  # in units of the noise: 95 % as precise as least squares where the noise is normal


class Penalty(NamedTuple):
    r"""The data term strength/M \sum t phi(|r|), linear beyond a corner and quadratic below.

        phi(n) = n - corner/2   for n >= corner,      n^2/(2 corner)   for n <= corner

    Attributes:
        terms: the residuals r, their trusts t and their number M per pixel and direction.
        strength: (N, 1, 1, 1, 1).
        corner: (N, 1, 1, 1, 1), in units of slope.
    """

    terms: Terms
    strength: Tensor
    corner: Tensor

    @property
    def steady(self) -> bool:
        """Its quadratic follows the height."""
        return False

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z."""
        return self.cost_of(self.terms.residual(z))

    def cost_of(self, r: Tensor) -> Tensor:
        """(N,) its value for residuals r."""
        n, corner = self.terms.size(r), self.corner
        phi = torch.where(n < corner, n.square() / (2 * torch.where(corner > 0, corner, 1)), n - corner / 2)
        return self.terms.total(self.strength * self.terms.trust * phi)

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes and trusts: every residual weighs strength t / max(|r|, corner)."""
        if not holds_everywhere(self.corner > 0):
            raise ValueError("smoothing=0 leaves a corner that no quadratic majorises; a data term needs smoothing > 0")
        return self.terms.quadratic(self.strength / torch.maximum(self.terms.size(self.terms.residual(z)), self.corner))

    def shrink(self, x: Tensor, step: Tensor) -> Tensor:
        """Proximal step: argmin_d step t phi(|d|) + 1/2 |d - x|^2, for every residual."""
        return shrink(x, self.terms.size(x), step * self.terms.trust, self.corner)


def shrink(x: Tensor, n: Tensor, step: Tensor, corner: Tensor) -> Tensor:
    """argmin_d step phi(|d|) + 1/2 |d - x|^2 for the phi of `Penalty`, with n = |x|."""
    inner = corner + step
    beyond = n > inner
    near = torch.where(inner > 0, corner / torch.where(inner > 0, inner, 1), 1)
    return x * torch.where(beyond, 1 - step / torch.where(beyond, n, 1), near)


class Convex(Robust):
    r"""ADMM on a `Penalty`: the residuals d = r(z) are split off, with multipliers u.

        z <- the solve (*) for the slopes g + d - u, each edge trusted by the share of its residuals that are live
        d <- shrink(r + u)        u <- u + r - d        with r = 1.8 r(z) - .8 d

    The trusts of the solve never change: on a full rectangle it is direct. The step (a slope) is the mean residual
    of least squares. A surface stops once an iteration changes its objective, and the cost of d differs from that of
    r(z), by less than `tol` in all.
    """

    def _begin(self, fields: Fields, data: DataTerm) -> Estimate:
        (z,) = super()._begin(fields, data)
        terms = cast(Penalty, data).terms
        r = terms.residual(z)
        number = terms.live.any(2, keepdim=True) if terms.joint else terms.live
        step = terms.size(r).flatten(1).sum(1) / number.flatten(1).sum(1).clamp(min=1)
        return z, r, torch.zeros_like(r), torch.where(step > 0, step, 1)[:, None, None, None]

    def _advance(self, fields: Fields, data: DataTerm, state: Estimate) -> Estimate:
        z, d, u, step = state
        penalty = cast(Penalty, data)
        terms, r = penalty.terms, fields.anchor_weight
        measured = terms.gather(torch.where(terms.live, terms.slopes + d - u, 0))
        w = None if terms.plain else terms.gather(terms.live.to(z.dtype))
        v = measured if w is None else measured / torch.where(w > 0, w, 1)
        z = self._surface(fields, v, w, None if r is None else r * step / penalty.strength[:, 0], z)
        x = _RELAX * terms.residual(z) + (1 - _RELAX) * d + u
        d = penalty.shrink(x, step[..., None])
        return z, d, x - d, step

    def _gap(self, data: DataTerm, state: Estimate) -> Tensor | float:
        penalty = cast(Penalty, data)
        return (penalty.cost(state[0]) - penalty.cost_of(state[1])).abs()


class _Linear(Convex):
    """What TotalVariation and L1 share: a corner at `smoothing` times the noise."""

    _joint: bool

    def __init__(
        self,
        smoothing: float = 0.1,
        n_iter: int = 100,
        tol: float = 1e-5,
        *,
        solve_tol: float = 1e-6,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(n_iter=n_iter, tol=tol, solve_tol=solve_tol, pixel_size=pixel_size)
        check_numbers(type(self).__name__, smoothing=smoothing)
        if not 0 <= smoothing < float("inf"):
            raise ValueError(f"{type(self).__name__}: smoothing={smoothing!r} given, at least 0 is needed")
        self.smoothing = smoothing

    def _data_term(self, fields: Fields) -> Penalty:
        """The penalty of the residuals, rounded at `smoothing` times the noise."""
        noise = sample_noise(fields)[..., None]
        return Penalty(Terms.of(fields, joint=self._joint), noise, self.smoothing * noise)


class TotalVariation(_Linear):
    r"""Total variation of the residual field, isotropic: edges stay sharp and outliers do no harm.

        min over z   sigma/4 \sum_s \sum_i t_i |(A_s z)_i - g_i|  + 1/2 \sum_i r_i (z_i - a_i)^2

    with s the four pairs of one-sided stencils (ahead or behind along x, ahead or behind along y), |.| the length of
    the two residuals of a pixel (of one where the other has no edge or no weight), and t the weight, or the mean of its
    two channels. The length is rounded below
    `smoothing` times the noise, which makes it a data term of DLS, and ADMM fast. The noise level sigma (the scale of
    the differences between neighbouring slopes) gives the sum the unit of least squares, so that anchors and DLS's
    `lam` mean about the same with both. ADMM splits the residuals off; each iteration is one solve with constant
    trusts.

    The derivative is that of the iterations run, in the gradient, weights and anchors; nothing is detached. It
    exists almost everywhere.

    Args:
        smoothing: corner of the length in units of the noise; 0 for none (not as a data term of DLS).
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its objective by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves (direct on a full rectangle).
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: Queau, Durou, "Edge-preserving integration of a normal field: weighted least squares, TV and L1
    approaches", SSVM 2015.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spoilt = surface.gradient.clone()
        >>> spoilt[..., 10, 20] += 9.0  # one wild sample
        >>> methods = torchdls.LeastSquares(), torchdls.TotalVariation()
        >>> [round(float(torchdls.rmse(method(spoilt), surface.height)), 2) for method in methods]
        [0.24, 0.03]
    """

    _joint = True


class L1(_Linear):
    r"""Least absolute residuals: outliers do no harm.

        min over z   sigma/2 \sum_i \sum_{x, y} t_i ( |(A z)_ahead - g_i| + |(A z)_behind - g_i| )
                     + 1/2 \sum_i r_i (z_i - a_i)^2

    Every slope speaks of the edge ahead of its pixel and of the one behind, so an edge is measured from both ends and
    one wrong end does not spoil it. Each magnitude is rounded below `smoothing` times the noise; the noise level
    sigma and the iteration are those of `TotalVariation`, and so is the derivative.

    Args:
        smoothing: corner of the magnitudes in units of the noise; 0 for none (not as a data term of DLS).
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its objective by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves (direct on a full rectangle).
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: Queau, Durou, "Edge-preserving integration of a normal field: weighted least squares, TV and L1
    approaches", SSVM 2015.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spoilt = surface.gradient.clone()
        >>> spoilt[..., 10, 20] += 9.0  # one wild sample
        >>> methods = torchdls.LeastSquares(), torchdls.L1()
        >>> [round(float(torchdls.rmse(method(spoilt), surface.height)), 2) for method in methods]
        [0.24, 0.03]
    """

    _joint = False
    _reads_edges = True


class Huber(Convex):
    r"""Huber's penalty: least squares for small residuals, least absolute ones beyond `delta`.

        min over z   1/2 \sum_i \sum_{x, y} t_i ( rho((A z)_ahead - g_i) + rho((A z)_behind - g_i) )
                     + 1/2 \sum_i r_i (z_i - a_i)^2
        rho(r) = r^2/2   for |r| <= delta,      delta |r| - delta^2/2   beyond

    over the same residuals as `L1`, by the same iteration, with the same derivative.

    Args:
        delta: the corner, in units of slope, or "auto": 1.345 times the noise of the slopes.
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its objective by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves (direct on a full rectangle).
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35, 1964.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spoilt = surface.gradient.clone()
        >>> spoilt[..., 10, 20] += 9.0  # one wild sample
        >>> methods = torchdls.LeastSquares(), torchdls.Huber()
        >>> [round(float(torchdls.rmse(method(spoilt), surface.height)), 2) for method in methods]
        [0.24, 0.02]
    """

    _slopes = ("delta",)
    _reads_edges = True

    def __init__(
        self,
        delta: float | Literal["auto"] = "auto",
        n_iter: int = 100,
        tol: float = 1e-5,
        *,
        solve_tol: float = 1e-6,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(n_iter=n_iter, tol=tol, solve_tol=solve_tol, pixel_size=pixel_size)
        self.delta = positive_or_auto("Huber", "delta", delta)

    def _data_term(self, fields: Fields) -> Penalty:
        """Huber's penalty of the residuals."""
        corner = level(self.delta, _HUBER, fields)
        return Penalty(Terms.of(fields, joint=False), corner, corner)


def positive_or_auto(method: str, name: str, value: float | str) -> float | str:
    """The value, if it is "auto" or a positive number; else ValueError."""
    if value != "auto" and not (isinstance(value, int | float) and 0 < value < float("inf")):
        raise ValueError(f"{method}: {name}={value!r} given, 'auto' or a positive number is needed")
    return value


def level(value: float | str, factor: float, fields: Fields) -> Tensor:
    """(N, 1, 1, 1, 1) a slope: the number itself, or for "auto" `factor` times the noise of the field."""
    if isinstance(value, str):
        return factor * sample_noise(fields)[..., None]
    return fields.gradient.new_full((fields.gradient.shape[0], 1, 1, 1, 1), value)
