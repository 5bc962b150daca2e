"""Global least squares: integrators whose normal equations are a Sylvester equation of the two axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from torchdls._precision import full_precision
from torchdls._tracing import holds_everywhere, is_recorded
from torchdls.integrators.base import Integrator
from torchdls.integrators.classic.axis_modes import BASES, Basis, Modes, axis_modes, expand
from torchdls.integrators.fields import Fields, fit_field
from torchdls.operators.local_polynomials import derivative_matrix


class GlobalLeastSquares(Integrator):
    r"""What the methods of this module share: the equation, and its solution in the eigenvectors of the two axes.

        z = argmin  1/2 ||D_y Z - G_y||^2 + 1/2 ||Z D_x^T - G_x||^2 + lam/2 (||S_y Z||^2 + ||Z S_x^T||^2)

    over surfaces Z = B_y C B_x^T, with D the derivative by local polynomials (`derivative_matrix`) and S a power of it.
    With the symmetric eigendecompositions B^T (D^T D + lam S^T S) B = Q diag(s) Q^T of each axis and U = B Q,

        Z = U_y [ ((D_y U_y)^T G_y U_x + U_y^T G_x (D_x U_x)) / (s_y + s_x) ] U_x^T

    The U depend on the size alone and are kept, so that a solve is six products with constant matrices. A grid looks
    the same from both ends, so every column of U is even or odd, and half of its rows suffice.
    """

    accepts = frozenset()

    def __init__(self, support: int, degree: int | None, pixel_size: float | Sequence[float]) -> None:
        super().__init__(pixel_size=pixel_size)
        name = type(self).__name__
        if not isinstance(support, int) or support < 3 or support % 2 == 0:
            raise ValueError(f"{name}: support={support!r} given, an odd integer of at least 3 is needed")
        if degree is not None and (not isinstance(degree, int) or not 1 <= degree < support):
            raise ValueError(
                f"{name}: degree={degree!r} given, an integer from 1 to support - 1 = {support - 1} is needed"
            )
        self.support = support
        self.degree = degree
        self._degree = support - 1 if degree is None else degree

    def _modes_of(self, n: int, step: float, dim: int, like: Tensor) -> Modes:
        """The eigenvectors of the rows (dim -2) or columns (dim -1), n of them; what a subclass may choose."""
        return axis_modes(n, step, dim, self.support, self._degree, "cosine", n, 0.0, 1, like=like)

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        gx, gy = fields.gradient.split(1, -3)
        h, w = gx.shape[-2:]
        dx, dy = fields.steps
        rows = self._modes_of(h, dy, -2, gx)
        columns = self._modes_of(w, dx, -1, gx)
        right = columns.project(rows.project_slopes(gy)) + rows.project(columns.project_slopes(gx))
        return expand(right, rows, columns)


class HarkerOLeary(GlobalLeastSquares):
    r"""Global least squares with derivatives by local polynomials.

        z = argmin  ||D_y Z - G_y||^2 + ||Z D_x^T - G_x||^2

    Slopes are compared at the pixels where they are measured, not half way between them, and polynomial surfaces of
    degree up to support - 1 (quadratics by default) are reproduced exactly. The Sylvester equation
    D_y^T D_y Z + Z D_x^T D_x = D_y^T G_y + G_x D_x is solved by two symmetric eigendecompositions, kept per size.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean.

    Args:
        support: samples of each local polynomial, odd, at least 3. More give a higher order of accuracy, O(h^degree),
            and, since D is nearly blind to the fastest oscillations, more noise in them.
        degree: of the polynomials, 1 .. support - 1; None for support - 1. A lower degree smooths, but takes some
            oscillations for flat, such as stripes at degree 1; these are left out of the solution.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: `support` is not an odd integer of at least 3, `degree` does not fit it, or `pixel_size` is not
            positive.

    Source: Harker, O'Leary, "Least Squares Surface Reconstruction from Measured Gradient Fields", CVPR 2008.

    Example:
        >>> slopes = torch.ones(1, 2, 16, 16)  # of a plane
        >>> height = torchdls.HarkerOLeary()(slopes)
        >>> round(float(height[0, 0, -1, -1] - height[0, 0, 0, 0]), 2)
        30.0
    """

    def __init__(
        self, support: int = 3, degree: int | None = None, *, pixel_size: float | Sequence[float] = 1.0
    ) -> None:
        super().__init__(support, degree, pixel_size)


class SpectralRegularization(GlobalLeastSquares):
    r"""Global least squares over the first modes of an orthogonal basis (the SR of the paper).

        z = argmin  ||D_y Z - G_y||^2 + ||Z D_x^T - G_x||^2     over Z = B_y C B_x^T

    with B the first orthonormal cosines or polynomials of each axis. What faster modes the noise has is left out, and
    so is what the surface has of them: creases ripple. With all modes it is `HarkerOLeary`. A plane is exact in the
    polynomial basis (two modes or more), not in a truncated cosine basis.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean.

    Args:
        modes: per axis, an integer, or a part of the pixels as a float in (0, 1]; or a pair (rows, columns) of them.
        basis: "cosine" or "polynomial".
        support: samples of each local polynomial of the derivative, odd, at least 3.
        degree: of these polynomials, 1 .. support - 1; None for support - 1.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of its range, or (at the call) there are more modes than pixels.

    Source: Harker, O'Leary, "Regularized Reconstruction of a Surface from its Measured Gradient Field", Journal of
    Mathematical Imaging and Vision 51, 2015.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> noisy = torchdls.add_noise(surface.gradient, 0, torch.Generator().manual_seed(0))
        >>> methods = torchdls.HarkerOLeary(), torchdls.SpectralRegularization(modes=0.25)
        >>> [round(float(torchdls.rmse(method(noisy), surface.height)), 2) for method in methods]
        [0.45, 0.23]
    """

    def __init__(
        self,
        modes: float | tuple[float, float] = 0.25,
        basis: Basis = "cosine",
        support: int = 3,
        degree: int | None = None,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(support, degree, pixel_size)
        pair = tuple(modes) if isinstance(modes, Sequence) else (modes, modes)
        if len(pair) != 2 or not all(_is_count(m) for m in pair):
            wanted = "an integer of at least 1, a float in (0, 1], or a pair (rows, columns) of them"
            raise ValueError(f"SpectralRegularization: modes={modes!r} given, {wanted} is needed")
        if basis not in BASES:
            raise ValueError(f"SpectralRegularization: basis={basis!r} is unknown; choose from {', '.join(BASES)}")
        self.modes = pair
        self.basis = basis

    def _modes_of(self, n: int, step: float, dim: int, like: Tensor) -> Modes:
        """The eigenvectors of an axis of n pixels within the span of its first modes."""
        asked = self.modes[2 + dim]
        count = asked if isinstance(asked, int) else max(1, round(asked * n))
        if count > n:
            sides = f"{n} {('rows', 'columns')[2 + dim]}"
            raise ValueError(f"SpectralRegularization: modes={asked} given for {sides}, at most as many are possible")
        return axis_modes(n, step, dim, self.support, self._degree, self.basis, count, 0.0, 1, like=like)


class TikhonovRegularization(GlobalLeastSquares):
    r"""Global least squares with a penalty on the surface, its slopes or its second derivatives.

        z = argmin  ||D_y Z - G_y||^2 + ||Z D_x^T - G_x||^2 + lam (||S_y (Z - Z0)||^2 + ||(Z - Z0) S_x^T||^2)

    with S = D^order, and Z0 a prior surface, 0 if none is given. Heights are counted in pixels, so that `lam` means the
    same at every scale. `lam` is the lambda^2 of the source.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors; the prior is an argument of the call.
    On the constant: zero mean, or the mean of the prior.

    Args:
        lam: strength of the penalty, at least 0: a number, or a tensor with one element. An `nn.Parameter` is trained
            with the module; its first and second derivatives are exact.
        order: of the derivative that is penalised: 0 (heights), 1 (slopes) or 2 (second derivatives). Order 0 pulls
            the surface down and order 1 flattens it by 1/(1 + lam), planes included; order 2 leaves planes exact.
        support: samples of each local polynomial of the derivative, odd, at least 3.
        degree: of these polynomials, 1 .. support - 1; None for support - 1.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of its range.

    Source: Harker, O'Leary (2015), as in `SpectralRegularization`.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> noisy = torchdls.add_noise(surface.gradient, 0, torch.Generator().manual_seed(0))
        >>> methods = torchdls.HarkerOLeary(), torchdls.TikhonovRegularization(lam=0.5)
        >>> [round(float(torchdls.rmse(method(noisy), surface.height)), 2) for method in methods]
        [0.45, 0.39]
    """

    lam: float | Tensor

    def __init__(
        self,
        lam: float | Tensor = 0.05,
        order: int = 2,
        support: int = 3,
        degree: int | None = None,
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(support, degree, pixel_size)
        single = isinstance(lam, int | float) or (isinstance(lam, Tensor) and lam.numel() == 1)
        if not single or not 0 <= _number(lam) < float("inf"):
            raise ValueError(f"TikhonovRegularization: lam={lam!r} given, one number of at least 0 is needed")
        if not isinstance(order, int) or order not in (0, 1, 2):
            raise ValueError(f"TikhonovRegularization: order={order!r} given, 0, 1 or 2 is needed")
        if isinstance(lam, Tensor) and not isinstance(lam, nn.Parameter):
            self.register_buffer("lam", lam.detach().clone())
        else:
            self.lam = lam
        self.order = order

    def _modes_of(self, n: int, step: float, dim: int, like: Tensor) -> Modes:
        """The eigenvectors of D^T D + lam S^T S."""
        lam = _number(self.lam)
        return axis_modes(n, step, dim, self.support, self._degree, "cosine", n, lam, self.order, like=like)

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels.

        The modes belong to one value of lam. Where its derivative is asked for, the change d of lam enters by the
        series z - d H^-1 R z + d^2 (H^-1 R)^2 z, with H the system at d = 0 and R z the derivative of the penalty.
        """
        z = super()._integrate(fields)
        if not isinstance(self.lam, Tensor) or not is_recorded(self.lam):
            return z
        (h, w), (dx, dy) = z.shape[-2:], fields.steps
        rows, columns = self._modes_of(h, dy, -2, z), self._modes_of(w, dx, -1, z)

        def change(x: Tensor) -> Tensor:
            slope_x, slope_y = self._powers(x, fields.steps)
            return expand(rows.project(columns.project(slope_x + slope_y)), rows, columns)

        d = (self.lam - self.lam.detach()).to(z).reshape(())
        first = change(z)
        return z - d * first + d.square() * change(first)

    @full_precision
    def forward(
        self,
        gradient: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
        prior: Tensor | None = None,
    ) -> Tensor:
        """Integrate as every integrator does, near a prior surface.

        Args:
            gradient: (N, 2, H, W) or (2, H, W), float32 or float64.
            mask: not taken, as the weight and the anchors are not.
            weight: not taken.
            anchor: not taken.
            anchor_weight: not taken.
            prior: (N, 1, H, W) or (1, H, W), the surface Z0 in the unit of `pixel_size`, or None for 0.

        Returns:
            Height (N, 1, H, W), or (1, H, W) for a single field.

        Raises:
            TypeError: an argument is not a tensor.
            ValueError: a shape, dtype or device does not fit, a value is not finite, or an argument is not taken.
        """
        if prior is None:
            return super().forward(gradient, mask, weight, anchor, anchor_weight)
        fields = self._check_fields(gradient, mask, weight, anchor, anchor_weight)
        z0 = self._prior(prior, gradient) / self._unit
        rest = fields._replace(gradient=fields.gradient - self._slopes(z0, fields.steps))
        height = self._finite((z0 + self._integrate(rest)) * self._unit)
        return height if gradient.ndim == 4 else height[0]

    if TYPE_CHECKING:

        def __call__(
            self,
            gradient: Tensor,
            mask: Tensor | None = None,
            weight: Tensor | None = None,
            anchor: Tensor | None = None,
            anchor_weight: Tensor | float | None = None,
            prior: Tensor | None = None,
        ) -> Tensor:
            """As `forward`."""

    def _prior(self, prior: Tensor, gradient: Tensor) -> Tensor:
        name = type(self).__name__
        fitted = cast(Tensor, fit_field(name, "prior", prior, gradient, channels=(1,)))
        if not holds_everywhere(fitted.isfinite()):
            raise ValueError(f"{name}: prior {tuple(prior.shape)} is not finite")
        return fitted

    def _slopes(self, z: Tensor, steps: tuple[float, float]) -> Tensor:
        """(N, 2, H, W) slopes Z D_x^T and D_y Z."""
        (h, w), (dx, dy) = z.shape[-2:], steps
        columns = derivative_matrix(w, self.support, self._degree, dx, like=z)
        rows = derivative_matrix(h, self.support, self._degree, dy, like=z)
        return torch.cat([z @ columns.mT, rows @ z], -3)

    def _powers(self, z: Tensor, steps: tuple[float, float]) -> tuple[Tensor, Tensor]:
        """Z S_x^T S_x and S_y^T S_y Z."""
        (h, w), (dx, dy) = z.shape[-2:], steps
        columns = derivative_matrix(w, self.support, self._degree, dx, like=z).matrix_power(self.order)
        rows = derivative_matrix(h, self.support, self._degree, dy, like=z).matrix_power(self.order)
        return z @ columns.mT @ columns, rows.mT @ (rows @ z)


def _is_count(modes: object) -> bool:
    if isinstance(modes, bool):
        return False
    return (isinstance(modes, int) and modes >= 1) or (isinstance(modes, float) and 0 < modes <= 1)


def _number(lam: float | Tensor) -> float:
    return float(lam.detach() if isinstance(lam, Tensor) else lam)
