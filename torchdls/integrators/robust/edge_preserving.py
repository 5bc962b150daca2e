"""Least squares with a penalty on the slopes of the surface that lets steep ones stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import DataTerm, edges_of
from torchdls.integrators.robust.base import Robust
from torchdls.integrators.robust.convex import level, positive_or_auto
from torchdls.operators import GradientOperator
from torchdls.operators.edges import present_edges

_AUTO = 3.0  # slopes from so many deviations of the noise on stand


class Preserving(NamedTuple):
    """The data term 1/2 sum w (A z - v)^2 + lam delta^2/2 sum_e log(1 + ((A z)_e / delta)^2) over the edges with w > 0.

    Attributes:
        v: (N, 2, H, W), slopes of the edges.
        w: (N, 2, H, W), their trusts.
        delta: (N, 1, 1, 1).
        lam: strength of the penalty.
        steps: sides of a pixel.
    """

    v: Tensor
    w: Tensor
    delta: Tensor
    lam: float
    steps: tuple[float, float]

    @property
    def steady(self) -> bool:
        """Its quadratic follows the height."""
        return False

    def cost(self, z: Tensor) -> Tensor:
        """(N,) its value at z."""
        slopes = GradientOperator("forward", self.steps)(z)
        penalty = self.delta.square() * torch.log1p((slopes / self.delta).square())
        misfit = self.w * (slopes - self.v).square() + torch.where(self.w > 0, self.lam * penalty, 0)
        return misfit.flatten(1).sum(1) / 2

    def majoriser(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes and trusts: the penalty weighs lam / (1 + (A z / delta)^2), and asks for slope 0."""
        slopes = GradientOperator("forward", self.steps)(z)
        flat = torch.where(self.w > 0, self.lam / (1 + (slopes / self.delta).square()), 0)
        w = self.w + flat
        return self.w * self.v / torch.where(w > 0, w, 1), w


class EdgePreserving(Robust):
    r"""Least squares with an edge-preserving penalty on the slopes, by half-quadratic minimisation.

        min over z   1/2 \sum_e w_e ((A z)_e - v_e)^2 + lam \sum_e phi((A z)_e) + 1/2 \sum_i r_i (z_i - a_i)^2
        phi(s) = delta^2/2 log(1 + (s / delta)^2)

    with the slopes v and trusts w of `LeastSquares`. Slopes below `delta` are flattened by about 1/(1 + lam), steep
    ones stand. Each iteration is the solve (*) with the trusts of the quadratic that touches phi, so the objective
    never rises. A method to compare with: it takes the surface for flat between its edges, so planes are not exact and
    gentle relief is lost, and a wrong slope keeps its pull. It erred more than least squares on every surface that we
    tried, terraces under noise included; see `SlopeDLS` for noise, `L1` and `MumfordShah` for wrong slopes and jumps.

    The derivative is that of the iterations run, in the gradient, weights and anchors.

    Args:
        lam: strength of the penalty, at least 0; 0 is least squares.
        delta: slope from which on an edge stands, or "auto": 3 times the noise of the slopes.
        n_iter: limit of iterations.
        tol: a surface stops once an iteration changes its objective by less than `tol` of it; 0 runs all iterations.
        solve_tol: relative residual of the solves.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: Charbonnier, Blanc-Feraud, Aubert, Barlaud, "Deterministic edge-preserving regularization in computed
    imaging", IEEE Transactions on Image Processing 6, 1997; after the regularisation in the comparison of Agrawal,
    Raskar, Chellappa, ECCV 2006 (its penalty and constants are not confirmed).

    Example:
        >>> height = torchdls.EdgePreserving(lam=1.0, delta=1.0)(torch.full((1, 2, 1, 9), 0.1))  # a gentle ramp
        >>> round(float(height[..., -1] - height[..., 0]), 2)  # of 0.8: half of it is flattened away
        0.4
    """

    _slopes = ("delta",)

    def __init__(
        self,
        lam: float = 0.1,
        delta: float | Literal["auto"] = "auto",
        n_iter: int = 50,
        tol: float = 1e-5,
        *,
        solve_tol: float = 1e-6,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(n_iter=n_iter, tol=tol, solve_tol=solve_tol, pixel_size=pixel_size)
        check_numbers("EdgePreserving", lam=lam)
        if not 0 <= lam < float("inf"):
            raise ValueError(f"EdgePreserving: lam={lam!r} given, at least 0 is needed")
        self.lam, self.delta = lam, positive_or_auto("EdgePreserving", "delta", delta)

    def _data_term(self, fields: Fields) -> DataTerm:
        """Least squares and the penalty."""
        v, w = edges_of(fields)
        w = present_edges(v).expand_as(v) if w is None else w
        return Preserving(v, w, level(self.delta, _AUTO, fields)[:, 0], self.lam, fields.steps)
