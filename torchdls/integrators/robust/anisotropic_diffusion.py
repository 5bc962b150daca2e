"""Anisotropic diffusion: a tensor per pixel says in which direction its slopes are trusted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, cast

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from torchdls._checks import check_numbers
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import DataTerm
from torchdls.integrators.robust.base import Estimate, Robust
from torchdls.integrators.robust.convex import positive_or_auto
from torchdls.integrators.robust.residuals import Terms
from torchdls.operators import GradientOperator

_WEICKERT = 3.315  # makes the flux fall from the contrast on
_BLUR = (0.1065, 0.7870, 0.1065)  # Gaussian of half a pixel


class Tensors(NamedTuple):
    """The data term 1/8 sum t r^T T r over the residual vectors r of the four one-sided stencils.

    Attributes:
        terms: the residuals and their trusts.
        diagonal: (N, 1, 2, H, W), T_xx and T_yy.
        mixed: (N, 1, 1, H, W), T_xy.
    """

    terms: Terms
    diagonal: Tensor
    mixed: Tensor

    def applied(self, r: Tensor) -> Tensor:
        """T r."""
        return self.diagonal * r + self.mixed * r.flip(2)

    def energy(self, r: Tensor) -> Tensor:
        """(N,) the data term for residuals r."""
        return self.terms.total(self.terms.trust * r * self.applied(r)) / 2

    @property
    def steady(self) -> bool:
        """Its quadratic follows the height."""
        return False

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z."""
        return self.energy(self.terms.residual(z))

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes and trusts: the diagonal tensor T_xx + |T_xy|, T_yy + |T_xy| is nowhere below T."""
        terms, above = self.terms, self.diagonal + self.mixed.abs()
        r = terms.residual(z)
        trust = torch.where(terms.live, above * terms.trust, 0)
        w = terms.gather(trust)
        some = w > 0
        moment = terms.gather(torch.where(terms.live, terms.trust * (above * r - self.applied(r)), 0))
        shift = moment + terms.gather(trust * terms.slopes)
        return torch.where(some, shift / torch.where(some, w, 1), 0), w


class AnisotropicDiffusion(Robust):
    r"""Least squares with a diffusion tensor per pixel, which trusts slopes less across steep edges than along them.

        min over z   1/8 \sum_s \sum_i t_i r_si^T T_i r_si + 1/2 \sum_i r_i (z_i - a_i)^2,     r_si = (A_s z)_i - g_i

    the Poisson equation div(T grad z) = div(T g), over the four one-sided stencils s of `TotalVariation`. T has the
    eigenvectors of the blurred g g^T: eigenvalue 1 along edges, and across them, with q the difference of its
    eigenvalues,

        1 - (1 - beta) exp(-3.315 (contrast^2 / q)^4)

    Each iteration minimises a majoriser with diagonal tensors, by the solve (*); successive steps are made conjugate,
    which is the method of conjugate gradients with (*) as its preconditioner. The objective never rises.

    The derivative is that of the iterations run, in the gradient (tensors included), weights and anchors.

    Args:
        beta: least trust across an edge, above 0 and at most 1.
        contrast: slope from which on a pixel is an edge, or "auto": the root mean square slope of the field.
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its objective by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: Agrawal, Raskar, Chellappa, "What is the range of surface reconstructions from a gradient field?", ECCV
    2006; Weickert (1998) for the diffusivity.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spoilt = surface.gradient.clone()
        >>> spoilt[..., 10, 20] += 9.0  # one wild sample
        >>> methods = torchdls.LeastSquares(), torchdls.AnisotropicDiffusion()
        >>> [round(float(torchdls.rmse(method(spoilt), surface.height)), 2) for method in methods]
        [0.24, 0.1]
    """

    _slopes = ("contrast",)

    def __init__(
        self,
        beta: float = 0.02,
        contrast: float | Literal["auto"] = "auto",
        n_iter: int = 50,
        tol: float = 1e-6,
        *,
        solve_tol: float = 1e-6,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(n_iter=n_iter, tol=tol, solve_tol=solve_tol, pixel_size=pixel_size)
        check_numbers("AnisotropicDiffusion", beta=beta)
        if not 0 < beta <= 1:
            raise ValueError(f"AnisotropicDiffusion: beta={beta!r} given, above 0 and at most 1 is needed")
        self.beta = beta
        self.contrast = positive_or_auto("AnisotropicDiffusion", "contrast", contrast)

    def _data_term(self, fields: Fields) -> Tensors:
        """The tensors of the field, bound to its residuals."""
        g = fields.gradient
        trusted = torch.ones_like(g, dtype=torch.bool) if fields.weight is None else (fields.weight > 0).expand_as(g)
        trusted = trusted if fields.mask is None else trusted & fields.mask
        g, inside = torch.where(trusted, g, 0), trusted.any(1, keepdim=True).to(g.dtype)
        x, y = g[:, :1], g[:, 1:]
        share = _blurred(inside).clamp(min=torch.finfo(g.dtype).tiny)
        xx, yy, xy = (_blurred(product) / share for product in (x * x, y * y, x * y))
        if isinstance(self.contrast, str):
            squared = (xx + yy).mul(inside).sum((-3, -2, -1), keepdim=True) / inside.sum(
                (-3, -2, -1), keepdim=True
            ).clamp(min=1)
        else:
            most = torch.finfo(g.dtype).max ** 0.5 / 2
            squared = g.new_full((1, 1, 1, 1), min(self.contrast, most) ** 2)
        q2 = (xx - yy).square() + 4 * xy.square()
        steep = q2 > (1e-2 * squared).square()  # below, the exponential is 0 to the last digit
        q = torch.where(steep, q2, 1).sqrt()
        loss = torch.where(steep, (1 - self.beta) * torch.exp(-_WEICKERT * (squared / q) ** 4), 0)
        tilt = (xx - yy) / q
        diagonal = torch.cat([1 - loss * (1 + tilt) / 2, 1 - loss * (1 - tilt) / 2], 1)
        return Tensors(Terms.of(fields, joint=True), diagonal[:, None], (-loss * xy / q)[:, None])

    def _begin(self, fields: Fields, data: DataTerm) -> Estimate:
        (z,) = super()._begin(fields, data)
        return z, torch.zeros_like(z), torch.ones_like(z[:, :, :1, :1])

    def _advance(self, fields: Fields, data: DataTerm, state: Estimate) -> Estimate:
        z, direction, before = state
        tensors = cast(Tensors, data)
        v, w = tensors.majoriser(z)
        step = self._surface(fields, v, w, fields.anchor_weight, z) - z
        slopes = GradientOperator("forward", fields.steps)

        def fall_along(d: Tensor) -> Tensor:
            """What the objective loses, to first order, by a move along d."""
            fall = (w * slopes(step) * slopes(d)).sum((-3, -2, -1)) + _anchored(fields, step, d)
            return fall[:, None, None, None]

        fall, some = fall_along(step), before > 0
        direction = step + torch.where(some, fall / torch.where(some, before, 1), 0) * direction
        along = fall_along(direction)  # the same, until rounding is all that is left of the steps: begin anew then
        conjugate = (along - fall).abs() <= 0.5 * fall
        direction, along = torch.where(conjugate, direction, step), torch.where(conjugate, along, fall)
        rise = 2 * tensors.energy(tensors.terms.difference(direction)) + _anchored(fields, direction, direction)
        rise = rise[:, None, None, None]
        steep = rise > 0
        return z + torch.where(steep, along / torch.where(steep, rise, 1), 0) * direction, direction, fall


def _anchored(fields: Fields, y: Tensor, z: Tensor) -> Tensor | float:
    """(N,) sum of r y z."""
    return 0.0 if fields.anchor_weight is None else (fields.anchor_weight * y * z).sum((-3, -2, -1))


def _blurred(x: Tensor) -> Tensor:
    """(N, 1, H, W) smoothed by a Gaussian, zero beyond the border."""
    kernel = torch.tensor(_BLUR, dtype=x.dtype, device=x.device)
    x = conv2d(x, kernel.view(1, 1, 1, 3), padding=(0, 1))
    return conv2d(x, kernel.view(1, 1, 3, 1), padding=(1, 0))
