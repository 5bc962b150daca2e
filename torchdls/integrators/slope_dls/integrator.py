"""SlopeDLS: sparse coding of the slopes, at several scales, with thresholds that the noise alone decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor, nn

from torchdls._checks import check_numbers
from torchdls._tracing import is_concrete
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import Quadratic
from torchdls.integrators.fields import has_even_trust, largest_per_surface
from torchdls.integrators.iterative import Callback, Iterative
from torchdls.integrators.slope_dls.coding import Aggregate, Noise, SlopeScale, average
from torchdls.integrators.slope_dls.holed import continued, smooth_holed
from torchdls.integrators.slope_dls.outliers import replace_outliers
from torchdls.integrators.slope_dls.runs import FOUR, HOLED, HOLED_QUICK, KAPPA, QUICK, Grid, Run, smooth
from torchdls.noise import noise_if_told
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.operators.edges import extend_edges
from torchdls.operators.modes import Boundary
from torchdls.selection import discrepancy_guard, probe, sure_guard
from torchdls.solvers import solve

Guard = Literal["discrepancy", "sure"]
Recipe = Literal["blend", "quick", "plain"]


class SlopeDLSResult(NamedTuple):
    """What `SlopeDLS.solve` returns; always batched.

    Attributes:
        height: (N, 1, H, W).
        dictionary: (N, 2n, K) learned atoms of the smallest patches, the slope in x above that in y; None if
            nothing is learned.
        codes: (N, K, L) of the last iteration, in the unit of the slopes, or None likewise.
        misfit: (N, n_iter + 1), 1/2 sum_e w_e ((A z)_e - v_e)^2 of least squares and after each iteration (of the first
            run, where there are several; where surfaces of a batch take unequal numbers, the last one repeats).
        noise: (N,) standard deviation of one gradient sample of weight 1.
        confidence: (N, 1, H, W): 0 where `robust` replaced a sample, else 1; 0 outside the mask.

    Example:
        >>> result = torchdls.SlopeDLS(recipe="quick").solve(torchdls.SURFACES["tent"](32).gradient)
        >>> result.height.shape, result.misfit.shape
        (torch.Size([1, 1, 32, 32]), torch.Size([1, 7]))
    """

    height: Tensor
    dictionary: Tensor | None
    codes: Tensor | None
    misfit: Tensor
    noise: Tensor
    confidence: Tensor

    @property
    def iterations(self) -> Tensor:
        """(N,) the iterations of the (first) run: as many as asked for."""
        return torch.full_like(self.noise, self.misfit.shape[1] - 1, dtype=torch.int64)

    @property
    def converged(self) -> Tensor:
        """(N,) bool: the iterations are a fixed number, and all were made."""
        return torch.ones_like(self.noise, dtype=torch.bool)


@dataclass(frozen=True)
class _Plain:
    """Settings of the recipe "plain"."""

    patch_sizes: tuple[int, ...] = (8, 24, 48)
    tau: float = 0.8
    n_iter: int = 16
    learn: bool = True
    aggregate: Aggregate = "mean"


_HOLED: dict[str, tuple[Run, ...]] = {"blend": HOLED, "quick": HOLED_QUICK}
_RUNS: dict[str, tuple[Run, ...]] = {"blend": FOUR, "quick": QUICK, "plain": ()}


class SlopeDLS(Iterative[SlopeDLSResult]):
    r"""Sparse coding of the slopes at several scales, with nothing to tune.

    The noise of the data is white in the slopes, and integration colours it in a known way. So the slopes are what is
    coded sparsely, and every coefficient gets the threshold that its own noise asks for. From the least-squares height
    on, each iteration

    1. cuts the slopes A z into overlapping patches of 4, 8, 16, 32, 64 pixels and the whole image, and keeps those
       coefficients (cosines, in patches from 16 pixels on after polynomials up to degree 5) that exceed tau sigma s_k,
       s_k the exact noise of coefficient k at its place;
    2. averages the estimates of all patches to slopes u, each patch with the inverse variance of its pixels,
       size^2 / (1 + kept coefficients);
    3. integrates them, by the solve (*): z = argmin 1/2 sum_e w_e ((A z)_e - v'_e)^2 + anchors, with
       v' = (v + 25 u) / 26;
    4. gives back, in every band of frequencies, what was removed beyond the noise (`discrepancy_guard`).

    tau falls from 1.6 to 0.3 over 8 iterations, and the grid of the patches shifts from one to the next. The recipe
    "blend" does so in four ways (along rows and columns, along the diagonals, with equal weights, and with small
    patches alone), and blends the four heights by Stein's unbiased risk estimate from a second round on probed data,
    slow waves and the others with weights of their own.
    Then waves of periods above 16 pixels, which patches hardly see, are shrunk in cosines and in polynomials of the
    position (`shrink_slow_waves`); the first of the four ways goes on from there for two iterations (tau 0.5 and 0.4,
    without step 4); and where little of the noise was found, as on texture, least squares is returned (`cautious`).
    "quick" is one run of 6 iterations with equal weights, its slow waves shrunk, about a tenth of the work.

    Surfaces with a mask, unequal weights or anchors go through one run with equal weights ("quick": of 4 iterations).
    Slopes outside the mask are filled by the last estimate u (at first by those of the harmonic extension). Patches
    weigh by the square of the share of slopes that they know, and their noise is that far from every border; weights
    are inverse relative variances, and each patch is coded in units of its own noise. Step 4 and the slow waves are
    left out; the run is blended with least squares by its risk, which a probe tells there too.

    "plain" codes sizes 8, 24, 48 with one threshold, from the noise that atoms see far from the border; patches of the
    smallest size hold both components and go through one sweep of SOUP-DIL, which learns their dictionary. With a
    mask, weights or anchors step 4 is left out.

    Differentiable by unrolling, with choices held fixed: the supports of the codes, the weights of the blend, the
    shares of the thresholds of slow waves and of least squares. Heights, weights and thresholds refer to heights in
    pixels, so they mean the same at every pixel size.

    Args:
        patch_sizes: sides of the patches; those that do not fit the image are left out. None for those of the recipe,
            and so for the next four.
        tau: threshold in standard deviations of the noise of a coefficient, the same in all iterations.
        n_iter: number of iterations.
        learn: "plain" alone: learn the dictionary of the smallest patches; False codes them by cosines too.
        recipe: "blend", "quick" or "plain".
        sigma: standard deviation of one gradient sample of weight 1: a number, (N,), or a map (N, 1, H, W), which takes
            the place of the weights in the coding. None estimates it with `noise_level`; fields without a complete
            cell of 2 x 2 pixels, which do not show it, are then integrated as they are.
        guard: "discrepancy" (step 4, and the return to least squares); "sure" adds at the end a blend with least
            squares in every band by Stein's unbiased risk estimate, from a second run on probed data (twice the time);
            None for neither.
        robust: look for grossly wrong samples first and replace them (`replace_outliers`); for a few percent of them.
        aggregate: "plain" alone: weights of the patches in the average: "mean", or "sparsity", 1 / (1 + number of
            coefficients).
        z_tol: relative residual of the heights where no direct solve serves.
        boundary: "neumann" (free borders), or "periodic" for a surface that repeats, as in `LeastSquares`: patches
            reach around the torus, on which the noise of every coefficient is the same in all of them, and the height
            is tileable. For "blend" and "quick", without masks, weights and anchors.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is unknown or out of range, or `sigma` does not fit the gradient.

    Source: an extension of Wagenmaker, Moore, Nadakuditi (ICIP 2017); the noise of transform coefficients after Donoho,
    Johnstone (1994), the shifts after Coifman, Donoho (1995), "Translation-invariant de-noising", the blend after
    Ramani, Blu, Unser (2008), the slow waves after Karacali, Snyder (2004).

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> noisy = torchdls.add_noise(surface.gradient, 5, torch.Generator().manual_seed(0))
        >>> plain, height = torchdls.LeastSquares()(noisy), torchdls.SlopeDLS()(noisy)
        >>> bool(torchdls.rmse(height, surface.height) < 0.7 * torchdls.rmse(plain, surface.height))
        True
    """

    sigma: float | Tensor | None

    def __init__(
        self,
        patch_sizes: Sequence[int] | None = None,
        tau: float | None = None,
        n_iter: int | None = None,
        learn: bool | None = None,
        *,
        recipe: Recipe = "blend",
        sigma: float | Tensor | None = None,
        guard: Guard | None = "discrepancy",
        robust: bool = False,
        aggregate: Aggregate | None = None,
        z_tol: float = 1e-5,
        boundary: Boundary = "neumann",
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        if recipe not in _RUNS:
            raise ValueError(f"SlopeDLS: recipe={recipe!r} given; choose from 'blend', 'quick', 'plain'")
        sizes = (8,) if patch_sizes is None else patch_sizes
        whole = isinstance(sizes, Sequence) and all(isinstance(s, int) and s >= 2 for s in sizes)
        if not whole or not sizes:
            raise ValueError(f"SlopeDLS: patch_sizes={patch_sizes!r} given, integers of at least 2 are needed")
        if n_iter is not None and (not isinstance(n_iter, int) or n_iter < 0):
            raise ValueError(f"SlopeDLS: n_iter={n_iter!r} given, an integer of at least 0 is needed")
        check_numbers("SlopeDLS", z_tol=z_tol, **({} if tau is None else {"tau": tau}))
        if (tau is not None and not tau >= 0) or not z_tol > 0:
            raise ValueError(f"SlopeDLS: tau={tau!r} must not be negative, z_tol={z_tol!r} must be positive")
        if guard not in ("discrepancy", "sure", None) or aggregate not in ("mean", "sparsity", None):
            known = "guard: 'discrepancy', 'sure', None; aggregate: 'mean', 'sparsity', None"
            raise ValueError(f"SlopeDLS: guard={guard!r}, aggregate={aggregate!r} given; choose from {known}")
        if not isinstance(sigma, Tensor | None):
            check_numbers("SlopeDLS", sigma=sigma)
        if sigma is not None and not bool((torch.as_tensor(sigma) >= 0).all()):
            raise ValueError(f"SlopeDLS: sigma={sigma!r} given, at least 0 is needed")
        if boundary not in ("neumann", "periodic"):
            raise ValueError(f"SlopeDLS: boundary={boundary!r} is unknown; choose from 'neumann', 'periodic'")
        if boundary == "periodic" and (recipe == "plain" or guard == "sure" or robust or getattr(sigma, "ndim", 0) > 1):
            other = "recipe='plain', guard='sure', robust=True or a map of sigma"
            raise ValueError(f"SlopeDLS: boundary='periodic' does not go with {other}")
        self.boundary = boundary
        if boundary == "periodic":
            self.accepts = frozenset()
        self.patch_sizes = None if patch_sizes is None else tuple(patch_sizes)
        self.tau, self.n_iter, self.learn, self.aggregate = tau, n_iter, learn, aggregate
        self.recipe, self.guard, self.robust, self.z_tol = recipe, guard, robust, z_tol
        if isinstance(sigma, Tensor) and not isinstance(sigma, nn.Parameter):
            self.register_buffer("sigma", sigma.detach().clone())
        else:
            self.sigma = sigma

    @classmethod
    def fast(cls, **options: Any) -> Self:
        """The recipe "quick".

        Args:
            options: of the class, in the place of those of the variant.
        """
        return cls(**({"recipe": "quick"} | options))

    def _given(self) -> dict[str, Any]:
        """The options that take the place of those of the recipe."""
        names = ("patch_sizes", "tau", "n_iter", "learn", "aggregate")
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def _runs(self, runs: Sequence[Run]) -> list[Run]:
        """Runs with the options given."""
        given: dict[str, Any] = {}
        if self.patch_sizes is not None:
            given |= {"sizes": self.patch_sizes, "whole": False}
        if self.tau is not None:
            given["tau"] = (self.tau, self.tau)
        if self.n_iter is not None:
            given["n_iter"] = self.n_iter
        return [replace(run, **given) for run in runs]

    @property
    def _exact_runs(self) -> list[Run]:
        """The runs of the recipe for full rectangles with equal trust; none for "plain"."""
        return self._runs(_RUNS[self.recipe])

    def _to_pixel_size(self, result: SlopeDLSResult) -> SlopeDLSResult:
        """The height in the unit of `pixel_size`; slopes and their codes have none."""
        return result._replace(height=result.height * self._unit)

    def _iterate(self, fields: Fields, callback: Callback | None = None) -> SlopeDLSResult:
        """Outliers replaced, the iterations, and the guard."""
        trusted = torch.ones_like(fields.gradient[:, :1]) if fields.mask is None else fields.mask.to(fields.gradient)
        if fields.mask is not None and is_concrete(fields.mask) and bool(fields.mask.all()):
            fields = fields._replace(mask=None)  # the direct solve serves
        if self.robust:
            gradient, outliers = replace_outliers(fields, tol=self.z_tol)
            fields, trusted = fields._replace(gradient=gradient), torch.where(outliers, 0, trusted)
        noise = self._noise(fields)
        result = self._smooth(fields, noise, callback)
        if self.guard == "sure":
            result = result._replace(height=self._blend(fields, noise, result.height))
        return result._replace(confidence=trusted.expand(noise.level.shape[0], -1, -1, -1))

    def _smooth(self, fields: Fields, noise: Noise, callback: Callback | None = None) -> SlopeDLSResult:
        """Each surface by the runs of the recipe for full rectangles with equal trust, or by those for others."""
        bare = fields.mask is None and fields.anchor_weight is None and noise.trust is None
        known = bare or is_concrete(noise.even)
        if self.recipe == "plain":
            return self._plain(fields, noise, callback)
        if known and not bare and not bool(noise.even.any()):
            return self._holed(fields, noise, callback)
        exact = self._exact(fields, noise, callback)
        if bare or (known and bool(noise.even.all())):
            return exact
        holed = self._holed(fields, noise)
        length = max(exact.misfit.shape[1], holed.misfit.shape[1])
        return exact._replace(
            height=torch.where(noise.even, exact.height, holed.height),
            misfit=torch.where(
                noise.even[:, :, 0, 0], _lengthened(exact.misfit, length), _lengthened(holed.misfit, length)
            ),
        )

    def _exact(self, fields: Fields, noise: Noise, callback: Callback | None) -> SlopeDLSResult:
        """By the runs of the recipe, on full rectangles with equal trust."""
        data = Quadratic.of(fields)
        grid = Grid(fields.steps, fields.boundary)
        misfit = [data.cost(grid.least_squares(fields.gradient))]

        def watch(z: Tensor) -> None:
            misfit.append(data.cost(z))
            if callback is not None:
                callback(len(misfit) - 1, misfit[-1].detach())

        guarded = self.guard is not None
        height = smooth(self._exact_runs, fields.gradient, noise.overall, grid, guarded, watch)
        return SlopeDLSResult(height, None, None, torch.stack(misfit, 1), noise.level, height)

    def _plain(self, fields: Fields, noise: Noise, callback: Callback | None = None) -> SlopeDLSResult:
        recipe = replace(_Plain(), **self._given())
        a = GradientOperator("forward", fields.steps)
        data = Quadratic.of(fields)
        v, w, *_ = data
        z = start = self._height(fields, v, w, None)
        valid, coded = continued(z, w, fields.steps, self.z_tol)
        scales = _scales(fields, recipe.patch_sizes)
        D = scales[0].initial_dictionary(v) if recipe.learn else None
        B: Tensor | None = None
        misfit = [data.cost(z)]
        for iteration in range(recipe.n_iter):
            slopes = extend_edges(a(z))
            slopes = slopes if valid is None else torch.where(valid, slopes, coded)
            parts = []
            for k, scale in enumerate(scales):
                if k == 0 and D is not None:  # on a grid at rest, where the codes of the last iteration still fit
                    part, D, B = scale.code_atoms(slopes, noise, recipe.tau, D, B)
                else:
                    part = scale.shifted(iteration).code_cosines(slopes, noise, recipe.tau, recipe.aggregate)
                parts.append(part)
            coded = average(parts)
            z = self._height(fields, (v + KAPPA * coded) / (1 + KAPPA), w, z)
            if self.guard is not None:
                z = torch.where(noise.even, discrepancy_guard(z, start, noise.overall, fields.steps), z)
            misfit.append(data.cost(z))
            if callback is not None:
                callback(iteration + 1, misfit[-1].detach())
        return SlopeDLSResult(z, D, B, torch.stack(misfit, 1), noise.level, z)

    def _holed(self, fields: Fields, noise: Noise, callback: Callback | None = None) -> SlopeDLSResult:
        """By the runs of the recipe for holes, unequal weights or anchors."""
        data = Quadratic.of(fields)
        misfit: list[Tensor] = []

        def watch(z: Tensor) -> None:
            misfit.append(data.cost(z))
            if callback is not None and len(misfit) > 1:
                callback(len(misfit) - 1, misfit[-1].detach())

        runs = self._runs(_HOLED[self.recipe])
        height = smooth_holed(runs, fields, noise, self.z_tol, self.guard is not None, watch)
        return SlopeDLSResult(height, None, None, torch.stack(misfit, 1), noise.level, height)

    def _height(self, fields: Fields, v: Tensor, w: Tensor | None, z0: Tensor | None) -> Tensor:
        guess = None if z0 is None else z0.detach()
        anchor, r = fields.anchor, fields.anchor_weight
        return solve(v, w, anchor, r, tol=self.z_tol, z0=guess, pixel_size=fields.steps).height

    def _noise(self, fields: Fields) -> Noise:
        """Level for a trust of 1, and the trust on the edges where it is not the same everywhere."""
        gradient, n = fields.gradient, fields.gradient.shape[0]
        sigma, weight = self.sigma, fields.weight
        if sigma is None:
            level, _ = noise_if_told(gradient, fields.mask, weight, fields.steps, fields.boundary)
        else:
            level = torch.as_tensor(sigma, dtype=gradient.dtype, device=gradient.device)
            if level.ndim > 1:
                weight, level = self._from_map(level, fields)
            elif level.numel() not in (1, n):
                raise ValueError(f"SlopeDLS: sigma {tuple(level.shape)} does not fit {n} surfaces")
            level = level.reshape(-1).expand(n)
        trust = None if weight is None else edge_slopes(gradient, fields.mask, weight)[1]
        overall = level if weight is None else level * largest_per_surface(weight).flatten().clamp(min=1e-30).rsqrt()
        return Noise(level, trust, weight, overall, has_even_trust(fields, weight))

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
        start, moved = (self._height(f, *Quadratic.of(f)[:2], None) for f in (fields, fields._replace(gradient=n)))
        change = (self._smooth(probed, noise).height - z) / step
        return torch.where(noise.even, sure_guard(z, start, change, moved, noise.overall), z)


def _scales(fields: Fields, patch_sizes: tuple[int, ...]) -> list[SlopeScale]:
    """The patches that fit the image; if none does, patches of its own size."""
    h, w = fields.gradient.shape[-2:]
    sizes = [(s, s) for s in patch_sizes if s <= min(h, w)]
    least = patch_sizes[0]
    return [SlopeScale(size, fields.steps) for size in sizes or [(min(least, h), min(least, w))]]


def _lengthened(misfit: Tensor, length: int) -> Tensor:
    """(N, length): the last value repeats."""
    return torch.cat([misfit, misfit[:, -1:].expand(-1, length - misfit.shape[1])], 1)
