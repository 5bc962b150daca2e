"""Global least squares under noise that is correlated along rows and columns, and with the border held."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import require
from torchdls.integrators.base import Fields
from torchdls.integrators.classic.global_least_squares import GlobalLeastSquares
from torchdls.operators.local_polynomials import build_derivative

_ZERO = 1e-12  # an eigenvalue below this part of the largest one is 0: the derivative has lost that mode


class WeightedHarkerOLeary(GlobalLeastSquares):
    r"""Global least squares weighted by a covariance of the slopes, with a free border or one held at height 0.

        z = argmin  ||L_y^{-1} (D_y Z - G_y) L_x^{-T}||^2 + ||L_y^{-1} (Z D_x^T - G_x) L_x^{-T}||^2,    Z = B_y C B_x^T

    with D the derivative by local polynomials of `HarkerOLeary`, `rows` = L_y L_y^T the covariance of the noise along a
    column (one entry for each row), `columns` = L_x L_x^T that along a row, and B the identity, or for
    border="zero" the identity without its first and last column. So noise may be correlated between the pixels
    of a row or a column, or grow along an axis (diagonal matrices); a trust for each pixel by itself is no product
    of two axes and is for `LeastSquares`. With M = B^T L^{-T} L^{-1} B and K = (D B)^T L^{-T} L^{-1} D B of each axis,
    the normal equations K_y C M_x + M_y C K_x = R are diagonal in the eigenvectors of K u = s M u.

    Good for sensors whose noise is known to differ from row to row or to be correlated along them, and for pieces that
    are clamped at their border. The covariances are taken as fixed; the height is linear in the gradient.

    Takes the full rectangle: no mask, weights or anchors. On the constant: zero mean, unless the border is held.

    Args:
        rows: (H, H) symmetric positive definite, in any unit; None for the identity.
        columns: (W, W), likewise.
        border: "free", or "zero" for height 0 on the first and last row and column (at least 3 of each).
        support: samples of each local polynomial of the derivative, odd, at least 3.
        degree: of these polynomials, 1 .. support - 1; None for support - 1.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: a covariance is not symmetric positive definite, an option is out of its range, or (at the call) a
            covariance does not fit the rows or columns of the gradient.

    Source: Harker, O'Leary, "Regularized Reconstruction of a Surface from its Measured Gradient Field", Journal of
    Mathematical Imaging and Vision 51, 2015 (weighted and constrained forms; written from their equations as
    remembered, the text is not confirmed).

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> spread = torch.linspace(0.1, 10, 32)  # the lower rows are noisier
        >>> noise = torch.randn(1, 2, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> slopes = surface.gradient + 0.1 * spread[:, None] * noise
        >>> methods = torchdls.HarkerOLeary(), torchdls.WeightedHarkerOLeary(rows=spread.square().diag())
        >>> [round(float(torchdls.rmse(method(slopes), surface.height)), 2) for method in methods]
        [0.82, 0.78]
    """

    rows: Tensor | None
    columns: Tensor | None

    def __init__(
        self,
        rows: Tensor | None = None,
        columns: Tensor | None = None,
        border: Literal["free", "zero"] = "free",
        support: int = 3,
        degree: int | None = None,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(support, degree, pixel_size)
        if border not in ("free", "zero"):
            raise ValueError(f"WeightedHarkerOLeary: border={border!r} given, 'free' or 'zero' is needed")
        self.border = border
        for label, covariance in (("rows", rows), ("columns", columns)):
            if covariance is not None:
                _check_covariance(label, covariance)
            self.register_buffer(label, None if covariance is None else covariance.detach().clone())

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        gx, gy = fields.gradient.split(1, -3)
        dx, dy = fields.steps
        rows = self._axis("rows", gx.shape[-2], dy, gx)
        columns = self._axis("columns", gx.shape[-1], dx, gx)
        right = rows.slopes.mT @ gy @ columns.weighted + rows.weighted.mT @ gx @ columns.slopes
        total = rows.eigenvalues[:, None] + columns.eigenvalues
        z = rows.values @ (right / total.masked_fill(total == 0, torch.inf)) @ columns.values.mT
        return z - z.mean((-2, -1), keepdim=True) if self.border == "free" else z

    def _axis(self, label: str, n: int, step: float, like: Tensor) -> _Axis:
        covariance = getattr(self, label)
        fits = covariance is None or len(covariance) == n
        given = None if covariance is None else tuple(covariance.shape)
        require(fits, f"WeightedHarkerOLeary: {label} {given} given for {n} {label}, ({n}, {n}) is needed")
        held = self.border == "zero"
        require(n > 2 or not held, f"WeightedHarkerOLeary: border='zero' leaves nothing of {n} {label}")
        D = build_derivative(n, self.support, self._degree, step)
        B = torch.eye(n, dtype=D.dtype, device=D.device)
        L = B if covariance is None else torch.linalg.cholesky(covariance.detach().to(D))
        B = B[:, 1:-1] if held else B
        values, slopes = (torch.linalg.solve_triangular(L, x, upper=False) for x in (B, D @ B))
        back = torch.linalg.inv(torch.linalg.qr(values).R)  # M = R^T R
        s, Q = torch.linalg.eigh(back.mT @ (slopes.mT @ slopes) @ back)
        s = torch.where(s > _ZERO * s[-1], s, 0)
        U = back @ Q
        weighted = [torch.linalg.solve_triangular(L.mT, x @ U, upper=True) for x in (values, slopes)]
        return _Axis(*(t.to(like) for t in (B @ U, *weighted, s)))


class _Axis(NamedTuple):
    """B U, L^{-T} L^{-1} B U, L^{-T} L^{-1} D B U (n, k) and s (k,) of K U = M U diag(s), U^T M U = 1."""

    values: Tensor
    weighted: Tensor
    slopes: Tensor
    eigenvalues: Tensor


def _check_covariance(label: str, covariance: Tensor) -> None:
    """ValueError unless it is a symmetric positive definite matrix."""
    name, given = "WeightedHarkerOLeary", f"{label} of type {type(covariance).__name__}"
    if not isinstance(covariance, Tensor) or not covariance.is_floating_point():
        raise TypeError(f"{name}: {given} given, a floating-point tensor is needed")
    square = covariance.ndim == 2 and covariance.shape[0] == covariance.shape[1] > 0
    require(square, f"{name}: {label} {tuple(covariance.shape)} given, a square matrix is needed")
    wide = covariance.detach().double().cpu()
    finite = bool(wide.isfinite().all())
    symmetric = finite and float((wide - wide.mT).abs().max()) <= 1e-5 * float(wide.abs().max())
    definite = symmetric and int(torch.linalg.cholesky_ex(wide).info) == 0
    require(definite, f"{name}: {label} {tuple(covariance.shape)} is not symmetric positive definite")
