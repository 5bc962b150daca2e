"""SlopeDLS: sparse coding of the slopes, at several scales, with thresholds that the noise alone decides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor, nn

from torchdls._tracing import visible
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import edge_cost
from torchdls.integrators.fields import even, largest
from torchdls.integrators.iterative import Callback, Iterative
from torchdls.integrators.slope_dls.coding import Aggregate, Noise, SlopeScale, average
from torchdls.integrators.slope_dls.outliers import replace_outliers
from torchdls.noise import noise_level
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.operators.edges import edge_ends, extend_edges
from torchdls.selection import discrepancy_guard, probe, sure_guard
from torchdls.solvers import harmonic_extension, solve

Guard = Literal["discrepancy", "sure"]

_KAPPA = 25.0  # trust in the coded slopes, as a multiple of that in the measured ones


class SlopeDLSResult(NamedTuple):
    """What `SlopeDLS.solve` returns; always batched.

    Attributes:
        height: (N, 1, H, W).
        dictionary: (N, 2n, K) learned atoms of the smallest patches, the slope in x above that in y; None if
            nothing is learned.
        codes: (N, K, L) of the last iteration, in the unit of the slopes, or None likewise.
        misfit: (N, n_iter + 1), 1/2 sum_e w_e ((A z)_e - v_e)^2 of least squares and after each iteration.
        noise: (N,) standard deviation of one gradient sample of weight 1.
        confidence: (N, 1, H, W): 0 where `robust` replaced a sample, else 1; 0 outside the mask.
    """

    height: Tensor
    dictionary: Tensor | None
    codes: Tensor | None
    misfit: Tensor
    noise: Tensor
    confidence: Tensor


class SlopeDLS(Iterative[SlopeDLSResult]):
    r"""Dictionary learning on the slopes at several scales, with nothing to tune.

    The noise of the data is white in the slopes, and integration colours it in a known way. So the slopes are what is
    coded sparsely, and every atom gets the threshold that its own noise asks for. From the least-squares height on,
    each iteration

    1. cuts the slopes A z into overlapping patches of several sizes. Those of the smallest size hold both components
       and go through one sweep of SOUP-DIL, which learns their dictionary; the larger ones, which see slowly varying
       slopes, keep those cosine coefficients that exceed tau sigma s_k, with s_k the noise of coefficient k in the
       projected slopes for white noise of level 1 (`cosine_noise`);
    2. averages the estimates of all patches to slopes u;
    3. integrates them, by the solve (*): z = argmin 1/2 sum_e w_e ((A z)_e - v'_e)^2 + anchors, with
       v' = (v + 25 u) / 26;
    4. gives back, in every band of frequencies, what was removed beyond the noise (`discrepancy_guard`).

    The grid of the larger patches shifts from one iteration to the next; that of the smallest stays, and its codes go
    on from those of the last sweep. The number of iterations is early stopping and part of the recipe.

    With a mask, slopes outside are filled by the last estimate u (at first by those of the harmonic extension).
    Weights are inverse relative variances: each patch is coded in units of its own noise. Step 4 then is left out for
    the surfaces of the batch that have holes, unequal weights or anchors, where the spectrum of the noise is not known
    exactly.

    Differentiable by unrolling, with the supports of the codes held fixed. Heights, weights and
    thresholds refer to heights in pixels, so they mean the same at every pixel size.

    Args:
        patch_sizes: sides of the patches, the smallest first; those that do not fit the image are left out.
        tau: threshold in standard deviations of the noise of an atom. Below 1, since every iteration thresholds again;
            1.2 with 9 iterations is as good in noise and quicker, but blurs smooth surfaces above 30 dB.
        n_iter: number of iterations.
        learn: learn the dictionary of the smallest patches; False codes them by cosines too, in a third of the time.
        sigma: standard deviation of one gradient sample of weight 1: a number, (N,), or a map (N, 1, H, W), which takes
            the place of the weights in the coding. None estimates it with `noise_level`.
        guard: "discrepancy" (step 4); "sure" adds at the end a blend with least squares by Stein's unbiased risk
            estimate, from a second run on probed data (twice the time); None for neither.
        robust: look for grossly wrong samples first and replace them (`replace_outliers`); for a few percent of them.
        aggregate: weights of the patches in the average: "mean", or "sparsity", 1 / (1 + number of coefficients).
        z_tol: relative residual of the heights where no direct solve serves.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is unknown or out of range, or `sigma` does not fit the gradient.

    Source: an extension of Wagenmaker, Moore, Nadakuditi (ICIP 2017); the noise of transform coefficients after Donoho,
    Johnstone (1994), the shifts after Coifman, Donoho (1995), "Translation-invariant de-noising".
    """

    sigma: float | Tensor | None

    def __init__(
        self,
        patch_sizes: Sequence[int] = (8, 24, 48),
        tau: float = 0.8,
        n_iter: int = 16,
        learn: bool = True,
        *,
        sigma: float | Tensor | None = None,
        guard: Guard | None = "discrepancy",
        robust: bool = False,
        aggregate: Aggregate = "mean",
        z_tol: float = 1e-5,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        self.patch_sizes = tuple(patch_sizes)
        if not self.patch_sizes or not all(isinstance(s, int) and s >= 2 for s in self.patch_sizes):
            raise ValueError(f"SlopeDLS: patch_sizes={patch_sizes!r} given, integers of at least 2 are needed")
        if not isinstance(n_iter, int) or n_iter < 0:
            raise ValueError(f"SlopeDLS: n_iter={n_iter!r} given, an integer of at least 0 is needed")
        if not tau >= 0 or not z_tol > 0:
            raise ValueError(f"SlopeDLS: tau={tau!r} must not be negative, z_tol={z_tol!r} must be positive")
        if guard not in ("discrepancy", "sure", None) or aggregate not in ("mean", "sparsity"):
            known = "guard: 'discrepancy', 'sure', None; aggregate: 'mean', 'sparsity'"
            raise ValueError(f"SlopeDLS: guard={guard!r}, aggregate={aggregate!r} given; choose from {known}")
        if sigma is not None and not bool((torch.as_tensor(sigma) >= 0).all()):
            raise ValueError(f"SlopeDLS: sigma={sigma!r} given, at least 0 is needed")
        self.tau, self.n_iter, self.learn, self.aggregate = tau, n_iter, learn, aggregate
        self.guard, self.robust, self.z_tol = guard, robust, z_tol
        if isinstance(sigma, Tensor) and not isinstance(sigma, nn.Parameter):
            self.register_buffer("sigma", sigma.detach().clone())
        else:
            self.sigma = sigma

    @classmethod
    def fast(cls, **options: Any) -> Self:
        """The variant without iteration, for real time: one pass over sizes 8, 16, 32 by cosines.

        Args:
            options: of the class, in the place of those of the variant.
        """
        recipe: dict[str, Any] = {"tau": 2.7, "n_iter": 1, "learn": False, "aggregate": "sparsity"}
        return cls(**({"patch_sizes": (8, 16, 32)} | recipe | options))

    def in_units(self, result: SlopeDLSResult) -> SlopeDLSResult:
        """The height in the unit of `pixel_size`; slopes and their codes have none."""
        return result._replace(height=result.height * self.unit)

    def iterate(self, fields: Fields, callback: Callback | None = None) -> SlopeDLSResult:
        """Outliers replaced, the iterations, and the guard."""
        trusted = torch.ones_like(fields.gradient[:, :1]) if fields.mask is None else fields.mask.to(fields.gradient)
        if fields.mask is not None and visible(fields.mask) and bool(fields.mask.all()):
            fields = fields._replace(mask=None)  # the direct solve serves
        if self.robust:
            gradient, outliers = replace_outliers(fields, tol=self.z_tol)
            fields, trusted = fields._replace(gradient=gradient), torch.where(outliers, 0, trusted)
        noise = self._noise(fields)
        result = self._run(fields, noise, callback)
        if self.guard == "sure":
            result = result._replace(height=self._blend(fields, noise, result.height))
        return result._replace(confidence=trusted.expand(noise.level.shape[0], -1, -1, -1))

    def _run(self, fields: Fields, noise: Noise, callback: Callback | None = None) -> SlopeDLSResult:
        a = GradientOperator("forward", fields.steps)
        v, w = self.edges(fields)
        z = start = self._height(fields, v, w, None)
        valid, coded = _continue(fields, z, w, self.z_tol)
        scales = self._scales(fields)
        D = scales[0].initial_dictionary(v) if self.learn else None
        B: Tensor | None = None
        misfit = [edge_cost(z, v, w, fields.steps)]
        for iteration in range(self.n_iter):
            slopes = extend_edges(a(z))
            slopes = slopes if valid is None else torch.where(valid, slopes, coded)
            parts = []
            for k, scale in enumerate(scales):
                if k == 0 and D is not None:  # on a grid at rest, where the codes of the last iteration still fit
                    part, D, B = scale.code_atoms(slopes, noise, self.tau, D, B)
                else:
                    part = scale.shifted(iteration).code_cosines(slopes, noise, self.tau, self.aggregate)
                parts.append(part)
            coded = average(parts)
            z = self._height(fields, (v + _KAPPA * coded) / (1 + _KAPPA), w, z)
            if self.guard is not None:
                z = torch.where(noise.even, discrepancy_guard(z, start, noise.overall, fields.steps), z)
            misfit.append(edge_cost(z, v, w, fields.steps))
            if callback is not None:
                callback(iteration + 1, misfit[-1].detach())
        return SlopeDLSResult(z, D, B, torch.stack(misfit, 1), noise.level, z)

    def _height(self, fields: Fields, v: Tensor, w: Tensor | None, z0: Tensor | None) -> Tensor:
        guess = None if z0 is None else z0.detach()
        anchor, r = fields.anchor, fields.anchor_weight
        return solve(v, w, anchor, r, tol=self.z_tol, z0=guess, pixel_size=fields.steps).height

    def _scales(self, fields: Fields) -> list[SlopeScale]:
        """The patches that fit the image; if none does, patches of its own size."""
        h, w = fields.gradient.shape[-2:]
        sizes = [(s, s) for s in self.patch_sizes if s <= min(h, w)]
        least = self.patch_sizes[0]
        return [SlopeScale(size, fields.steps) for size in sizes or [(min(least, h), min(least, w))]]

    def _noise(self, fields: Fields) -> Noise:
        """Level for a trust of 1, and the trust on the edges where it is not the same everywhere."""
        gradient, n = fields.gradient, fields.gradient.shape[0]
        sigma, weight = self.sigma, fields.weight
        if sigma is None:
            level = noise_level(gradient, fields.mask, weight, fields.steps)
        else:
            level = torch.as_tensor(sigma, dtype=gradient.dtype, device=gradient.device)
            if level.ndim > 1:
                weight, level = self._from_map(level, fields)
            elif level.numel() not in (1, n):
                raise ValueError(f"SlopeDLS: sigma {tuple(level.shape)} does not fit {n} surfaces")
            level = level.reshape(-1).expand(n)
        trust = None if weight is None else edge_slopes(gradient, fields.mask, weight)[1]
        overall = level if weight is None else level * largest(weight).flatten().clamp(min=1e-30).rsqrt()
        return Noise(level, trust, overall, even(fields, weight))

    def _from_map(self, sigma: Tensor, fields: Fields) -> tuple[Tensor, Tensor]:
        """Weights and level of a noise map: its root mean square is the level."""
        n, _, h, w = fields.gradient.shape
        if sigma.ndim != 4 or sigma.shape[0] not in (1, n) or tuple(sigma.shape[1:]) != (1, h, w):
            raise ValueError(f"SlopeDLS: sigma {tuple(sigma.shape)} does not fit gradient {(n, 2, h, w)}")
        inside = torch.ones_like(sigma) if fields.mask is None else fields.mask.to(sigma)
        square = sigma.square() * inside
        mean = square.sum((1, 2, 3), keepdim=True) / inside.sum((1, 2, 3), keepdim=True)
        weight = torch.where(square > 0, mean / torch.where(square > 0, square, 1), 1)
        return weight.expand(n, -1, -1, -1), mean.flatten().sqrt()

    def _blend(self, fields: Fields, noise: Noise, z: Tensor) -> Tensor:
        """The height after a last blend with least squares, where the noise is uniform."""
        n, step = probe(fields.gradient, noise.overall)
        probed = fields._replace(gradient=fields.gradient + step * n)
        start, moved = (self._height(f, *self.edges(f), None) for f in (fields, fields._replace(gradient=n)))
        change = (self._run(probed, noise).height - z) / step
        return torch.where(noise.even, sure_guard(z, start, change, moved, noise.overall), z)


def _continue(fields: Fields, z: Tensor, w: Tensor | None, tol: float) -> tuple[Tensor | None, Tensor]:
    """The edges whose slopes are measured, and slopes for the others: those of the harmonic extension."""
    if w is None:
        return None, z
    held = edge_ends(w) > 0
    if not visible(held) or not bool(held.all()):
        z = harmonic_extension(z, held, tol=tol, pixel_size=fields.steps)
    return extend_edges(w) > 0, extend_edges(GradientOperator("forward", fields.steps)(z))
