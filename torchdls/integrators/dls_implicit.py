r"""The derivative of DLS at its fixed point, with the dictionary held fixed or given.

Where the iterations have settled, z and the codes b on their support are stationary points of the cost: with
M the valid pixels of the patches and R = M (P z - D b), they solve the linear system K (z, b) = f,

    z:   A^T w A z + r z + 2 lam fold(R) = A^T w v + r a
    b:   -2 lam D^T R = 0 on the support of b                     (-2 lam mu sign(b) on the right for soft thresholds)

A code at its bound does not move; it stands on the right hand side. So the derivative is that of one symmetric solve,
d(z, b) = K^{-1} (df - dK (z, b)), whatever the number of iterations. The support is taken as fixed.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls.dictionary.thresholds import Threshold
from torchdls.integrators.dls_state import Model, support
from torchdls.operators import GradientOperator, Patches
from torchdls.solvers import ConvergenceWarning, conjugate_gradients
from torchdls.solvers.poisson import fold_vmap, preconditioner, present_edges

# The codes leave smooth heights to the data term alone; so small a part of the patches' trust stands for them in the
# preconditioner (measured: from .03 to 3e-5 the number of steps is near its least).
_LOOSE = 1e-4


class _Setting(NamedTuple):
    patches: Patches
    pixel_size: tuple[float, float]
    tol: float
    max_iter: int


def at_fixed_point(
    model: Model,
    z: Tensor,
    D: Tensor,
    B: Tensor,
    *,
    threshold: Threshold,
    bound: float,
    tol: float,
    max_iter: int = 500,
) -> tuple[Tensor, Tensor]:
    """The height and codes found, with the derivative of the fixed point in everything the model holds, and in D.

    Where K leaves the constant of the height free, the loss must not depend on it: see `remove_free_constants`.
    """
    fields, patches, valid = model.fields, model.patches, model.valid
    assert model.edges is not None
    v, w = model.edges
    w = present_edges(v) if w is None else w.expand_as(v)
    r = torch.zeros_like(z) if fields.anchor_weight is None else fields.anchor_weight.expand_as(z)
    lam = model.lam[:, None, None]
    D = D.expand(len(z), -1, -1)
    free = (B != 0) & (B.abs() < bound)
    f_z = GradientOperator("forward", fields.steps).adjoint(w * v)
    f_z = f_z if fields.anchor is None else f_z + r * fields.anchor
    f_b = torch.zeros_like(B) if threshold == "hard" else -2 * lam * model.mu[:, None, None] * B.sign() * free
    held = torch.where(free, 0, B)
    if bound < float("inf"):
        E = _inside(D @ held, valid)
        f_z = f_z + 2 * lam[..., None] * patches.adjoint(E, z.shape)
        f_b = f_b - 2 * lam * (D.mT @ E) * free
    setting = _Setting(patches, fields.steps, tol, max_iter)
    z, b = _FixedPoint.apply(f_z, f_b, w, r, lam, D, free, valid, z, B - held, setting)
    return z, b + held


class _FixedPoint(torch.autograd.Function):
    """(z, b) = K(w, r, lam, D)^{-1} f. The first call is given the solution; the calls of its derivatives solve."""

    @staticmethod
    def forward(
        f_z: Tensor,
        f_b: Tensor,
        w: Tensor,
        r: Tensor,
        lam: Tensor,
        D: Tensor,
        free: Tensor,
        valid: Tensor | None,
        z: Tensor | None,
        b: Tensor | None,
        setting: _Setting,
    ) -> tuple[Tensor, Tensor]:
        if z is not None and b is not None:
            return z.view_as(z), b.view_as(b)
        return _System(w, r, lam, D, free, valid, setting).solve(f_z, f_b)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        _, _, w, r, lam, D, free, valid, _, _, setting = inputs
        kept = (*output, w, r, lam, D, free, valid)
        ctx.save_for_backward(*kept)
        ctx.save_for_forward(*kept)
        ctx.setting = setting

    @staticmethod
    def backward(ctx: Any, dz: Tensor, db: Tensor) -> tuple[Tensor | None, ...]:
        z, b, w, r, lam, D, free, valid = ctx.saved_tensors
        x, y = _FixedPoint.apply(dz, db * free, w, r, lam, D, free, valid, None, None, ctx.setting)
        a, patches = GradientOperator("forward", ctx.setting.pixel_size), ctx.setting.patches
        dw = -a(x) * a(z) if ctx.needs_input_grad[2] else None
        dr = -x * z if ctx.needs_input_grad[3] else None
        dlam = dD = None
        if ctx.needs_input_grad[4] or ctx.needs_input_grad[5]:
            Rx, Rz = (_inside(patches.extract(t) - D @ c, valid) for t, c in ((x, y), (z, b)))
            dlam = -2 * (Rx * Rz).sum((1, 2), keepdim=True)
            dD = 2 * lam * (Rx @ b.mT + Rz @ y.mT)
        return x, y, dw, dr, dlam, dD, None, None, None, None, None

    @staticmethod
    def jvp(
        ctx: Any,
        df_z: Tensor | None,
        df_b: Tensor | None,
        dw: Tensor | None,
        dr: Tensor | None,
        dlam: Tensor | None,
        dD: Tensor | None,
        *_: Any,
    ) -> tuple[Tensor, Tensor]:
        z, b, w, r, lam, D, free, valid = ctx.saved_tensors
        a, patches = GradientOperator("forward", ctx.setting.pixel_size), ctx.setting.patches
        x = torch.zeros_like(z) if df_z is None else df_z
        y = torch.zeros_like(b) if df_b is None else df_b
        if dw is not None:
            x = x - a.adjoint(dw * a(z))
        if dr is not None:
            x = x - dr * z
        R = _inside(patches.extract(z) - D @ b, valid) if dlam is not None or dD is not None else None
        if dlam is not None and R is not None:
            x, y = x - 2 * dlam[..., None] * patches.adjoint(R, z.shape), y + 2 * dlam * (D.mT @ R)
        if dD is not None and R is not None:
            E = _inside(dD @ b, valid)
            x, y = x + 2 * lam[..., None] * patches.adjoint(E, z.shape), y + 2 * lam * (dD.mT @ R - D.mT @ E)
        return _FixedPoint.apply(x, y * free, w, r, lam, D, free, valid, None, None, ctx.setting)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        outputs = _FixedPoint.apply(*fold_vmap(info.batch_size, in_dims, inputs))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0, 0)


class _System(NamedTuple):
    """K, and its solution by conjugate gradients."""

    w: Tensor
    r: Tensor
    lam: Tensor
    D: Tensor
    free: Tensor
    valid: Tensor | None
    setting: _Setting

    def solve(self, f_z: Tensor, f_b: Tensor) -> tuple[Tensor, Tensor]:
        """K^{-1} f. Where D^T D = I and every pixel counts, the codes are eliminated exactly; else both are unknown."""
        if self.valid is None and self._orthonormal():
            return self._eliminated(f_z, f_b)
        return self._joint(f_z, f_b)

    def _orthonormal(self) -> bool:
        gram, eye = self.D.mT @ self.D, torch.eye(self.D.shape[-1], dtype=self.D.dtype, device=self.D.device)
        return bool((gram - eye).abs().max() < 100 * torch.finfo(gram.dtype).eps)

    def _eliminated(self, f_z: Tensor, f_b: Tensor) -> tuple[Tensor, Tensor]:
        """Codes b = D^T P z + f_b / 2 lam on the support: what is left is A^T w A + r + 2 lam fold(I - D S D^T) P."""
        strength = 2 * self.lam
        b0 = f_b / torch.where(strength > 0, strength, 1)
        kept = self.free.mT.to(f_z.dtype).contiguous()  # patch by patch, as the patches lie in memory

        def apply(z: Tensor) -> Tensor:
            X = self._extract(z).mT
            X.baddbmm_((X @ self.D).mul_(kept), self.D.mT, alpha=-1)
            return self._data(z) + self._fold(X.mT)

        z = self._cg(apply, self._loose(), f_z + self._fold(self.D @ b0))
        return z, b0 + ((self._extract(z).mT @ self.D).mul_(kept)).mT

    def _joint(self, f_z: Tensor, f_b: Tensor) -> tuple[Tensor, Tensor]:
        """Unknowns z and the codes on the support, side by side; block elimination with D^T D = I preconditions."""
        h, wd = f_z.shape[-2:]
        index, used = support(self.free)
        strength, loose = 2 * self.lam[..., 0], self._loose()

        def join(z: Tensor, codes: Tensor) -> Tensor:
            values = torch.where(used, codes.flatten(1).gather(1, index), 0)
            return torch.cat([z.flatten(1), values], 1)[..., None, None]

        def split(x: Tensor) -> tuple[Tensor, Tensor]:
            x = x[..., 0, 0]
            values = torch.where(used, x[:, h * wd :], 0)
            codes = torch.zeros_like(self.free, dtype=x.dtype).flatten(1).scatter_add_(1, index, values)
            return x[:, : h * wd].unflatten(1, (1, h, wd)), codes.view(self.free.shape)

        def apply(x: Tensor) -> Tensor:
            z, codes = split(x)
            R = _inside(self._extract(z) - self.D @ codes, self.valid)
            return join(self._data(z) + self._fold(R), -strength[..., None] * (self.D.mT @ R))

        def precondition(x: Tensor) -> Tensor:
            z, codes = split(x)
            codes = codes / torch.where(strength > 0, strength, 1)[..., None]
            z = loose(z + self._fold(_inside(self.D @ codes, self.valid)))
            return join(z, codes + self.D.mT @ _inside(self._extract(z), self.valid))

        return split(self._cg(apply, precondition, join(f_z, f_b)))

    def _cg(self, apply: Any, precondition: Any, b: Tensor) -> Tensor:
        result = conjugate_gradients(apply, precondition, b, None, tol=self.setting.tol, max_iter=self.setting.max_iter)
        if not bool(result.converged.all()):
            warnings.warn(
                f"DLS: the implicit derivative stopped after {self.setting.max_iter} iterations at a relative residual "
                f"of {float(result.residual.max()):.1e}, above grad_tol={self.setting.tol:.1e}",
                ConvergenceWarning,
                stacklevel=2,
            )
        return result.x

    def _loose(self) -> Any:
        inside = torch.ones_like(self.D[:, :, :1]).expand(-1, -1, self.free.shape[-1])
        coverage = self.setting.patches.adjoint(_inside(inside, self.valid), self.r.shape)
        return preconditioner(self.w, self.r + 2 * _LOOSE * self.lam[..., None] * coverage, self.setting.pixel_size)

    def _data(self, z: Tensor) -> Tensor:
        a = GradientOperator("forward", self.setting.pixel_size)
        return a.adjoint(self.w * a(z)) + self.r * z

    def _extract(self, z: Tensor) -> Tensor:
        return self.setting.patches.extract(z)

    def _fold(self, X: Tensor) -> Tensor:
        return 2 * self.lam[..., None] * self.setting.patches.adjoint(X, self.r.shape)


def _inside(X: Tensor, valid: Tensor | None) -> Tensor:
    return X if valid is None else torch.where(valid, X, 0)
