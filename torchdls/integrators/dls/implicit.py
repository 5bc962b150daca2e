r"""The derivative of DLS at its fixed point, with the dictionary held fixed or given.

Where the iterations have settled, z and the codes b on their support are stationary points of the cost: with
M the valid pixels of the patches and R = M (P z - D b), they solve the linear system K (z, b) = f,

    z:   A^T w A z + r z + 2 lam fold(R) = A^T w v + r a
    b:   -2 lam D^T R = 0 on the support of b                     (-2 lam mu sign(b) on the right for soft thresholds)

A code at its bound does not move; it stands on the right hand side. So the derivative is that of one symmetric solve,
d(z, b) = K^{-1} (df - dK (z, b)), whatever the number of iterations. The support is taken as fixed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls._tracing import in_plain_autograd, is_recorded, only_shapes
from torchdls.dictionary.thresholds import Threshold
from torchdls.integrators.dls.problem import Problem
from torchdls.operators import GradientOperator, Patches
from torchdls.operators.edges import present_edges
from torchdls.solvers import ConvergenceWarning, conjugate_gradients
from torchdls.solvers.cg import LinearMap
from torchdls.solvers.poisson import fold_vmap
from torchdls.solvers.preconditioner import preconditioner

# The codes leave smooth heights to the data term alone; so small a part of the patches' trust stands for them in the
# preconditioner (measured: from .03 to 3e-5 the number of steps is near its least).
_LOOSE = 1e-4

# Patches whose small systems are set up at a time.
_CHUNK = 4096


class _Setting(NamedTuple):
    """What the solve needs besides tensors; `codes` tells whether the codes are asked for, or the height alone."""

    patches: Patches
    pixel_size: tuple[float, float]
    tol: float
    max_iter: int
    codes: bool = True


def implicit_derivative(
    model: Problem,
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
    v, w = model.data.majoriser(z)
    w = present_edges(v) if w is None else w.expand_as(v)
    r = torch.zeros_like(z) if fields.anchor_weight is None else fields.anchor_weight.expand_as(z)
    lam = model.lam[:, None, None]
    D = D.expand(len(z), -1, -1)
    free = (B != 0) & (B.abs() < bound)
    f_z = GradientOperator("forward", fields.steps).adjoint(w * v)
    f_z = f_z if fields.anchor is None else f_z + r * fields.anchor
    f_b = None if threshold == "hard" else -2 * lam * model.mu[:, None, None] * B.sign() * free
    setting = _Setting(patches, fields.steps, tol, max_iter)
    if math.isinf(bound):
        found: tuple[Tensor, Tensor] = _FixedPoint.apply(f_z, f_b, w, r, lam, D, free, valid, z, B, setting)
        return found
    held = torch.where(free, 0, B)
    E = _inside(D @ held, valid)
    f_z = f_z + 2 * lam[..., None] * patches.adjoint(E, z.shape)
    f_b = (0 if f_b is None else f_b) - 2 * lam * (D.mT @ E) * free
    z, b = _FixedPoint.apply(f_z, f_b, w, r, lam, D, free, valid, z, B - held, setting)
    return z, b + held


class _FixedPoint(torch.autograd.Function):
    """(z, b) = K(w, r, lam, D)^{-1} f. The first call is given the solution; the calls of its derivatives solve.

    None for f_b is 0. Codes are found where they are needed alone; elsewhere zeros that take no memory stand for them.
    """

    @staticmethod
    def forward(
        f_z: Tensor,
        f_b: Tensor | None,
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
        if only_shapes(f_z):
            return torch.empty_like(f_z), f_z.new_empty(free.shape)
        return _System(w, r, lam, D, free, valid, setting).solve(f_z, f_b)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        _, _, w, r, lam, D, free, valid, _, _, setting = inputs
        kept = (*output, w, r, lam, D, free, valid)
        ctx.save_for_backward(*kept)
        ctx.save_for_forward(*kept)
        ctx.setting = setting
        ctx.set_materialize_grads(False)

    @staticmethod
    @full_precision
    def backward(ctx: Any, dz: Tensor | None, db: Tensor | None) -> tuple[Tensor | None, ...]:
        z, b, w, r, lam, D, free, valid = ctx.saved_tensors
        dz, db = torch.zeros_like(z) if dz is None else dz, None if db is None else db * free
        kept = [t for t in (dz, db, z, b, w, r, lam, D) if t is not None]
        wanted = any(ctx.needs_input_grad[i] for i in (1, 4, 5))
        # Inside a transform of functions, outer levels may want what this one does not.
        setting = ctx.setting._replace(
            codes=wanted or db is not None or (is_recorded(*kept) and not in_plain_autograd(*kept))
        )
        x, y = _FixedPoint.apply(dz, db, w, r, lam, D, free, valid, None, None, setting)
        a, patches = GradientOperator("forward", ctx.setting.pixel_size), ctx.setting.patches
        dw = -a(x) * a(z) if ctx.needs_input_grad[2] else None
        dr = -x * z if ctx.needs_input_grad[3] else None
        dlam = dD = None
        if ctx.needs_input_grad[4] or ctx.needs_input_grad[5]:
            Rx, Rz = (_inside(patches.extract(t) - D @ c, valid) for t, c in ((x, y), (z, b)))
            dlam = -2 * (Rx * Rz).sum((1, 2), keepdim=True)
            dD = 2 * lam * (Rx @ b.mT + Rz @ y.mT)
        return x, y if ctx.needs_input_grad[1] else None, dw, dr, dlam, dD, None, None, None, None, None

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
        y = df_b
        if dw is not None:
            x = x - a.adjoint(dw * a(z))
        if dr is not None:
            x = x - dr * z
        R = _inside(patches.extract(z) - D @ b, valid) if dlam is not None or dD is not None else None
        if dlam is not None and R is not None:
            x, y = (
                x - 2 * dlam[..., None] * patches.adjoint(R, z.shape),
                (0 if y is None else y) + 2 * dlam * (D.mT @ R),
            )
        if dD is not None and R is not None:
            E = _inside(dD @ b, valid)
            x = x + 2 * lam[..., None] * patches.adjoint(E, z.shape)
            y = (0 if y is None else y) + 2 * lam * (dD.mT @ R - D.mT @ E)
        y = None if y is None else y * free
        return _FixedPoint.apply(x, y, w, r, lam, D, free, valid, None, None, ctx.setting)

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

    def solve(self, f_z: Tensor, f_b: Tensor | None) -> tuple[Tensor, Tensor]:
        """K^{-1} f, the codes eliminated patch by patch.

        With X = M P z, the codes of a patch are b = G^{-1} (D^T X + f_b / 2 lam) on its support, G = D^T M D there.
        What is left for the height is A^T w A z + r z + 2 lam fold(X - M D b).
        """
        codes_of = self._codes_of()
        parts = [slice(i, i + _CHUNK) for i in range(0, self.free.shape[-1], _CHUNK)]

        def less_codes(X: Tensor) -> Tensor:
            """X - M D G^{-1} D^T X, folded."""
            X = X.mT  # patch by patch, as they lie in memory
            for part in parts:
                X[:, part].baddbmm_(codes_of(X[:, part] @ self.D, part), self.D.mT, alpha=-1)
            return self._fold(_inside(X.mT, self.valid))

        def codes(x: Tensor) -> Tensor:
            """G^{-1} x of all patches (N, L, K), written to x."""
            for part in parts:
                x[:, part] = codes_of(x[:, part].clone(), part)
            return x

        b0 = None
        if f_b is not None:
            strength = 2 * self.lam
            b0 = (f_b / torch.where(strength > 0, strength, 1)).mT
            f_z = f_z + self._fold(
                _inside(self.D @ codes(b0.clone(memory_format=torch.contiguous_format)).mT, self.valid)
            )
        z = self._cg(lambda z: self._data(z) + less_codes(self._patches(z)), f_z)
        if not self.setting.codes:
            return z, z.new_zeros(()).expand(self.free.shape)
        x = self._patches(z).mT @ self.D
        return z, codes(x if b0 is None else x.add_(b0)).mT

    def _codes_of(self) -> Callable[[Tensor, slice], Tensor]:
        """The map from D^T X (N, l, K) to G^{-1} D^T X on the support of some patches; it overwrites its argument."""
        free = self.free.mT.contiguous()
        gram = self.D.mT @ self.D
        eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
        if self.valid is None and bool((gram - eye).abs().max() < 100 * torch.finfo(gram.dtype).eps):
            return lambda x, part: x.mul_(free[:, part])
        size = max(int(free.sum(-1).max()), 1)
        places = torch.cat([f.to(torch.uint8).topk(size, -1).indices for f in free.split(_CHUNK, 1)], 1)
        used = free.gather(2, places)
        inverse = torch.cat([self._inverse_grams(*c) for c in self._chunks(places, used)], 1)

        def solve(x: Tensor, part: slice) -> Tensor:
            here, live = places[:, part], used[:, part]
            codes = (inverse[:, part] @ torch.where(live, x.gather(2, here), 0)[..., None])[..., 0]
            return x.zero_().scatter_(2, here, torch.where(live, codes, 0))

        return solve

    def _chunks(self, places: Tensor, used: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
        valid = (
            [None] * len(range(0, places.shape[1], _CHUNK)) if self.valid is None else self.valid.mT.split(_CHUNK, 1)
        )
        return zip(places.split(_CHUNK, 1), used.split(_CHUNK, 1), valid, strict=True)

    def _inverse_grams(self, places: Tensor, used: Tensor, valid: Tensor | None) -> Tensor:
        """(N, l, s, s) inverses of G over the s places of l patches; a ridge of sqrt(eps) for dependent atoms."""
        surfaces = torch.arange(len(places), device=places.device)[:, None, None]
        atoms = self.D.mT[surfaces, places] * used[..., None]
        atoms = atoms if valid is None else atoms * valid[:, :, None]
        ridge = torch.where(used, torch.finfo(atoms.dtype).eps ** 0.5, 1)
        return torch.cholesky_inverse(torch.linalg.cholesky(atoms @ atoms.mT + torch.diag_embed(ridge)))

    def _patches(self, z: Tensor) -> Tensor:
        return _inside(self.setting.patches.extract(z), self.valid)

    def _cg(self, apply: LinearMap, b: Tensor) -> Tensor:
        result = conjugate_gradients(
            apply, self._loose(), b, None, tol=self.setting.tol, max_iter=self.setting.max_iter
        )
        if not bool(result.converged.all()):
            warnings.warn(
                f"DLS: the implicit derivative stopped after {self.setting.max_iter} iterations at a relative residual "
                f"of {float(result.residual.max()):.1e}, above tol={self.setting.tol:.1e} of Implicit",
                ConvergenceWarning,
                stacklevel=2,
            )
        return result.x

    def _loose(self) -> LinearMap:
        inside = torch.ones_like(self.D[:, :, :1]).expand(-1, -1, self.free.shape[-1])
        coverage = self.setting.patches.adjoint(_inside(inside, self.valid), self.r.shape)
        return preconditioner(self.w, self.r + 2 * _LOOSE * self.lam[..., None] * coverage, self.setting.pixel_size)

    def _data(self, z: Tensor) -> Tensor:
        a = GradientOperator("forward", self.setting.pixel_size)
        return a.adjoint(self.w * a(z)) + self.r * z

    def _fold(self, X: Tensor) -> Tensor:
        return 2 * self.lam[..., None] * self.setting.patches.adjoint(X, self.r.shape)


def _inside(X: Tensor, valid: Tensor | None) -> Tensor:
    return X if valid is None else torch.where(valid, X, 0)
