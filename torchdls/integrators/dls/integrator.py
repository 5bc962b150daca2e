"""DLS: integration regularised by a dictionary that is learned from the patches of the surface itself."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from torchdls._checks import check_together
from torchdls._precision import full_precision
from torchdls._tracing import in_plain_autograd, seen_everywhere
from torchdls.dictionary import dct_dictionary
from torchdls.dictionary.learners import Learner
from torchdls.integrators.base import Fields, Integrator
from torchdls.integrators.classic.least_squares import LeastSquares
from torchdls.integrators.data_term import anchored_cost
from torchdls.integrators.dls.checkpoint import run_in_legs
from torchdls.integrators.dls.choice import Select, check_select, check_selectable, choose_threshold
from torchdls.integrators.dls.guard import guard
from torchdls.integrators.dls.implicit import implicit_derivative
from torchdls.integrators.dls.iteration import Settings, iterate, objective, settled
from torchdls.integrators.dls.iteration import start as initial_state
from torchdls.integrators.dls.options import Unroll
from torchdls.integrators.dls.problem import Problem, State, last_state
from torchdls.integrators.dls.settings import (
    Derivative,
    HeightStep,
    Learn,
    check_boundary,
    check_dictionary,
    check_run,
    check_strength,
    choose_derivative,
    choose_height_step,
    choose_learner,
    per_surface,
    register_setting,
    spans_patches,
)
from torchdls.integrators.dls.window import live_window
from torchdls.integrators.fields import mean_weight, slope_unit
from torchdls.integrators.iterative import Callback, Iterative
from torchdls.integrators.settling import run_until_settled
from torchdls.noise import edge_noise_if_told, noise_if_told
from torchdls.operators import Patches
from torchdls.operators.modes import Boundary
from torchdls.solvers import remove_free_constants

# lam is a plateau from here on; one standard deviation of the noise is safe on textured relief and on smooth surfaces
# alike (benchmarks/quality/dls.py).
_AUTO_LAM = 0.5
_AUTO_MU = 1.0


class DLSResult(NamedTuple):
    """What `DLS.solve` returns; always batched.

    Attributes:
        height: (N, 1, H, W).
        dictionary: (N, n, K), or (1, n, K) if shared or fixed; unit-norm atoms.
        codes: (N, K, L), in units of height; with anchors, of the height less the mean anchor of each component.
        objective: (N, n_iter + 1), from the start (B = 0) on, for heights in pixels and before their free constant is
            taken out (for mu="auto" and slopes beyond 2^30 or below 2^-30, float64: 250, that of the same slopes
            brought to order 1); it never rises (with one dictionary for the batch, its sum over the batch never does).
        noise: (N,) estimated standard deviation of one gradient sample, of mean weight if there are weights.
        lam: (N,) the regularisation weight used.
        mu: (N,) the threshold used, for heights in pixels.
        converged: (N,) bool, whether the height settled to `tol` before the iterations ran out.
        iterations: (N,) the iterations each surface took.
        followed: (N,) how far the height follows the iterations away from least squares: 0 is least squares, 1 all that
            they removed and the noise explains (`select="guard"`), or their own height where there is no guard.

    Example:
        >>> result = torchdls.DLS(n_iter=2).solve(torchdls.SURFACES["tent"](32).gradient)
        >>> result.dictionary.shape, result.codes.shape
        (torch.Size([1, 64, 64]), torch.Size([1, 64, 169]))
        >>> bool((result.objective.diff() <= 0).all())
        True
    """

    height: Tensor
    dictionary: Tensor
    codes: Tensor
    objective: Tensor
    noise: Tensor
    lam: Tensor
    mu: Tensor
    converged: Tensor
    iterations: Tensor
    followed: Tensor


class DLS(Iterative[DLSResult]):
    r"""Dictionary learning on surfaces.

        min over z, B, D   data(z) + lam ( \sum_j ||P_j z - D b_j||^2 + mu^2 ||B||_0 ),   ||d_i|| = 1, |b_ji| <= a

    with data(z) = 1/2 ||A z - v||^2 by default. From the height of the data term alone and B = 0, every iteration
    sweeps over the codes and atoms of all overlapping patches (`soup_dil_sweep`) and then solves for the height,
    where the patches act as an anchor: lam \sum_j ||P_j z - D b_j||^2 = 1/2 \sum_i r_i (z_i - a_i)^2 + const, with r
    = 2 lam c, a = fold(D B) / c and c the number of patches that hold a pixel.

    `lam` and `mu` refer to heights measured in pixels (h = sqrt(dx dy)), so they mean the same at every pixel size.

    With a mask, the fit counts valid pixels only. Invalid pixels of a patch are filled before each sweep by the patch's
    current approximation D b_j, which majorises that cost; before the first pass, by the harmonic extension of the
    height, and patches that this serves badly lose their codes again. So the objective never rises. Patches without a
    valid pixel are left out. Nothing outside the mask is read.

    Args:
        patch_size: rows and columns of a patch, or one number for both.
        stride: step between patches, at most the patch size.
        n_atoms: K, the number of atoms of the initial DCT dictionary; ignored if `dictionary` is given.
        lam: weight of the patch model; a number, a tensor (a number or one per surface), or "auto" (0.5, times
            the mean weight where there are weights).
        mu: threshold on the codes; a number (0 with a dictionary that spans its patches asks nothing of the height,
            which is that of the data term), a tensor (a number or one per surface), or "auto": the noise level of one
            gradient sample, which `noise_level` estimates from the non-integrable part of each field; where there is
            none, or no cell of 2 x 2 pixels tells it, the height is that of the data term alone. A list or tuple of
            numbers is a schedule, one for each of the `n_iter` iterations; no surface stops before its last change.
        n_iter: limit of iterations.
        data_term: an integrator built on the solve (*), which provides the data term and the first height.
        dictionary: initial dictionary (n, K), or (N, n, K) for each surface of a batch; atoms are brought to unit
            norm. An `nn.Parameter` is trained with the module, a tensor is a buffer. None for
            `dct_dictionary(patch_size, n_atoms)`.
        learner: how codes and atoms are found: "soup_dil" (the paper's), "k_svd", "dino_kat", "unitary", "focuss",
            "fixed", or a `Learner` with options of its own, such as `SoupDIL(order="block", threshold="soft")` or
            `KSVD(n_nonzero=4)`. Its `threshold` and `bound` are those of the objective.
        learn: "each" learns a dictionary per surface, "shared" one for the batch, "fixed" updates the codes alone.
        height_step: "exact" solves for the height; "proximal" takes a proximal gradient step as in the paper; or
            `Exact(tol=...)`, `Proximal(steps=...)`.
        select: what keeps the result safe. "guard": the height is followed away from least squares as far as what it
            took away looks like noise, mode by mode (`torchdls.integrators.dls.guard`): hardly ever worse than least
            squares, which remains where there is no noise. Gross errors, too, bring least squares back and
            are not mended. False: the height of the iterations, as in the paper. "auto": "guard" for mu="auto" and
            the data term `LeastSquares`, else False. True: predict for each surface the risk of several thresholds
            without the truth (`torchdls.select`), and take the best, or least squares (lam = 0) where none promises to
            cut its risk by a third. Seven runs instead of one; three where mu is a number. For full rectangles with
            equal weights and no anchors. Derivatives hold the choice fixed.
        tol: a surface stops once a step moves its height by less than `tol` times the whole way from the first height;
            0 runs all iterations.
        derivative: what the derivative is (docs/differentiation.md). "unroll": of the iterations that were run, exact;
            `Unroll(checkpoint=True)` saves memory. "implicit": of the fixed point, for a fixed dictionary, at the cost
            of one linear solve; `Implicit(tol=...)` says how exact. "frozen_dictionary": the same as if the learned
            dictionary did not move, an approximation. "none". "auto" is "implicit" where that is exact and "unroll"
            elsewhere.
        boundary: "neumann" (free borders), or "periodic" for a surface that repeats, as in `LeastSquares`: patches
            reach over the borders, and the height is tileable. The stride then divides the patches and the sides of the
            field; takes no mask, no weight and one anchor weight per surface, and goes with `LeastSquares` alone.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is unknown, out of range or without effect beside another, or the dictionary does not fit
            the patches.
        TypeError: `data_term` is not an integrator.

    Source: Wagenmaker, Moore, Nadakuditi, "Robust surface reconstruction from gradients via adaptive dictionary
    regularization", ICIP 2017.

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> noisy = torchdls.add_noise(surface.gradient, 5, torch.Generator().manual_seed(0))
        >>> plain, height = torchdls.LeastSquares()(noisy), torchdls.DLS(n_iter=10)(noisy)
        >>> bool(torchdls.rmse(height, surface.height) < 0.9 * torchdls.rmse(plain, surface.height))
        True
    """

    lam: float | Tensor | str
    mu: float | Tensor | tuple[float, ...] | str
    dictionary: Tensor

    def __init__(
        self,
        patch_size: int | tuple[int, int] = 8,
        stride: int | tuple[int, int] = 2,
        n_atoms: int = 64,
        lam: float | Tensor | Literal["auto"] = "auto",
        mu: float | Tensor | Sequence[float] | Literal["auto"] = "auto",
        n_iter: int = 50,
        data_term: Integrator | None = None,
        dictionary: Tensor | None = None,
        *,
        learner: str | Learner = "soup_dil",
        learn: Learn = "each",
        height_step: HeightStep = "exact",
        select: Select = "auto",
        tol: float = 1e-3,
        derivative: Derivative = "auto",
        boundary: Boundary = "neumann",
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        check_boundary(boundary, data_term, select)
        self.boundary = boundary
        if boundary == "periodic":
            self.accepts = frozenset({"anchor"})
        self.patches = Patches(patch_size, stride, wrap=boundary == "periodic")
        self.data_term = LeastSquares(boundary=boundary) if data_term is None else data_term
        if not isinstance(self.data_term, Integrator):
            raise TypeError(f"DLS: data_term is a {type(data_term).__name__}, an Integrator is needed")
        if self.data_term._steady is None:
            raise ValueError(f"DLS: data_term {type(data_term).__name__} is not built on the weighted solve")
        register_setting(self, "lam", check_strength("lam", lam))
        register_setting(self, "mu", check_strength("mu", mu))
        check_run(n_iter, tol, self.mu)
        self.n_iter, self.tol, self.select = n_iter, tol, select
        self.height_step = choose_height_step(height_step)
        self.learner, self.learn = choose_learner(learner, learn, self.patches)
        check_select(select, self.data_term)
        if select is True:
            check_selectable(self.data_term, self.learn, self.mu)
        initial = dct_dictionary(self.patches.size, n_atoms) if dictionary is None else dictionary
        check_dictionary(initial, self.patches)
        register_setting(self, "dictionary", initial)
        self.derivative = derivative
        rule, steady = self._settings.threshold, bool(self.data_term._steady) and boundary == "neumann"
        self._derivative = choose_derivative(derivative, self.learn, rule, steady, initial)

    def _to_pixel_size(self, result: DLSResult) -> DLSResult:
        """Height and codes in the unit of `pixel_size`."""
        return result._replace(height=result.height * self._unit, codes=result.codes * self._unit)

    @full_precision
    def solve(
        self,
        gradient: Tensor,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        anchor: Tensor | None = None,
        anchor_weight: Tensor | float | None = None,
        *,
        callback: Callback | None = None,
        start: DLSResult | None = None,
    ) -> DLSResult:
        """Integrate as `forward` does, and tell everything that was found on the way.

        Args:
            gradient: see `forward`, and so for the mask, weight and anchors; a single field is a batch of one.
            mask: see `forward`.
            weight: see `forward`.
            anchor: see `forward`.
            anchor_weight: see `forward`.
            callback: called after each iteration as callback(iteration, cost (N,)), with iterations from 1.
            start: the result of the frame before, for surfaces of the same sizes: the iterations begin with its
                dictionary and codes in place of the initial dictionary and none, and with the height of the data term
                as ever. A guess: it carries no derivative.

        Returns:
            `DLSResult`.

        Raises:
            TypeError: as `forward`, or `start` is no result of DLS of the same dtype.
            ValueError: as `forward`; `start` does not fit, or is given beside `Unroll(checkpoint=True)`.

        Example:
            >>> frames = [torchdls.SURFACES["tent"](32).gradient + 0.1 * torch.randn(1, 2, 32, 32) for _ in range(2)]
            >>> first = torchdls.DLS(n_iter=10).solve(frames[0])
            >>> torchdls.DLS(n_iter=3).solve(frames[1], start=first).iterations <= 3
            tensor([True])
        """
        fields, level = self._levelled_fields(gradient, mask, weight, anchor, anchor_weight)
        if start is not None:
            self._check_start(start, fields)
            start = DLSResult(*(t.detach() for t in start))._replace(codes=start.codes.detach() / self._unit)
        result = self._to_pixel_size(self._iterate(fields, callback, start))
        return result._replace(height=self._placed(result.height, level))

    def _check_start(self, start: DLSResult, fields: Fields) -> None:
        if not isinstance(start, DLSResult):
            raise TypeError(f"DLS: start is a {type(start).__name__}, a DLSResult is needed")
        check_together("DLS", gradient=fields.gradient, start=start.codes)
        N, shape = len(fields.gradient), fields.gradient.shape
        count = math.prod(self.patches.grid(shape)) if self.patches.fit(shape) else 0
        n, K = self.dictionary.shape[-2:]
        lone = self._initial_dictionary(fields).shape[0]
        if start.codes.shape != (N, K, count) or start.dictionary.shape != (lone, n, K):
            found = f"dictionary {tuple(start.dictionary.shape)} and codes {tuple(start.codes.shape)}"
            raise ValueError(f"DLS: start has {found}; {(lone, n, K)} and {(N, K, count)} are needed")
        if isinstance(self._derivative, Unroll) and self._derivative.checkpoint:
            raise ValueError("DLS: start does not go with derivative=Unroll(checkpoint=True)")

    def _iterate(self, fields: Fields, callback: Callback | None = None, start: DLSResult | None = None) -> DLSResult:
        """The iterations, on slopes of order 1 where the dtype asks for it and no option is a height."""
        unit = slope_unit(fields.gradient)
        if not isinstance(self.mu, str) or self._settings.bound < math.inf or seen_everywhere(unit == 1):
            return self._iterate_as_given(fields, callback, start)
        anchor = None if fields.anchor is None else fields.anchor / unit
        start = None if start is None else start._replace(codes=start.codes / unit[..., 0])
        found = self._iterate_as_given(fields._replace(gradient=fields.gradient / unit, anchor=anchor), callback, start)
        each = unit.flatten()
        return found._replace(
            height=found.height * unit, codes=found.codes * unit[..., 0], noise=found.noise * each, mu=found.mu * each
        )

    def _iterate_as_given(self, fields: Fields, callback: Callback | None, start: DLSResult | None) -> DLSResult:
        """The iterations, within the window of the patches that a mask leaves alive."""
        noise = self._noise(fields)
        if not self.patches.fit(fields.gradient.shape) or (isinstance(self.mu, str) and seen_everywhere(~(noise > 0))):
            return self._without_patches(fields, noise)
        window = live_window(fields.mask, self.patches)
        fields = fields if window is None else window.crop(fields)
        problem = self._problem(fields, noise)._replace(follows=start is not None)
        if start is not None and window is not None:
            start = start._replace(codes=window.crop_codes(start.codes))
        if self.select is True:
            problem = choose_threshold(problem, isinstance(self.mu, str), functools.partial(self._trial, problem))
        result = self._differentiated(problem, callback, start)
        height = remove_free_constants(result.height, fields.mask, fields.anchor_weight)
        followed = result.followed
        if self._guarded:
            reference = self.data_term._integrate(fields)
            height, followed = guard(height, reference, result.codes, fields, noise)
        if window is None:
            return result._replace(height=height, followed=followed)
        return result._replace(
            height=window.put_back(height), followed=followed, codes=window.put_codes_back(result.codes)
        )

    def _without_patches(self, fields: Fields, noise: Tensor) -> DLSResult:
        """The surface of the data term alone, where no patch fits or none has noise to lose: nothing to iterate."""
        z, D = self.data_term._integrate(fields), self._initial_dictionary(fields)
        cost = anchored_cost(self.data_term._data_term(fields), fields, z)
        rows, columns = self.patches.grid(z.shape) if self.patches.fit(z.shape) else (0, 0)
        codes = z.new_zeros(len(z), D.shape[-1], rows * columns)
        costs = cost[:, None].expand(-1, self.n_iter + 1)
        nothing = torch.zeros_like(noise)
        lam, mu = (per_surface(name, getattr(self, name), nothing) for name in ("lam", "mu"))
        return DLSResult(z, D, codes, costs, noise, 0 * lam, mu, nothing == 0, nothing.long(), nothing)

    @property
    def _settings(self) -> Settings:
        return Settings(self.data_term, self.learner, self.learn, self.height_step, self.tol)

    def _differentiated(self, problem: Problem, callback: Callback | None, start: DLSResult | None = None) -> DLSResult:
        """The result of the iterations, with the derivative that was chosen."""
        how = self._derivative
        if isinstance(how, Unroll):
            return self._run(problem, callback, how.checkpoint, start)
        with torch.no_grad():
            found = self._run(problem, callback, start=start)
        found = DLSResult(*(t.detach() for t in found))
        if how is None:
            return found
        D = self._initial_dictionary(problem.fields) if self.learn == "fixed" else found.dictionary
        rule, bound = self._settings.threshold, self._settings.bound
        height, codes = implicit_derivative(
            problem, found.height, D, found.codes, threshold=rule, bound=bound, tol=how.tol
        )
        given = {"noise": problem.noise, "lam": problem.lam, "mu": problem.mu}
        return found._replace(height=height, dictionary=D, codes=codes, **given)

    def _trial(self, problem: Problem, gradient: Tensor, mu: Tensor) -> Tensor:
        """Height of other gradients with another threshold."""
        other = self._problem(problem.fields._replace(gradient=gradient), problem.noise)
        return self._run(other._replace(lam=problem.lam, mu=mu, follows=False)).height

    def _run(
        self,
        problem: Problem,
        callback: Callback | None = None,
        checkpoint: bool = False,
        start: DLSResult | None = None,
    ) -> DLSResult:
        """The iterations, until every surface has settled."""
        settings, D = self._settings, self._initial_dictionary(problem.fields)
        if start is not None and self.learn != "fixed":
            D = start.dictionary
        begin = initial_state(problem, D, settings, None if start is None else start.codes.clone())
        cost = objective(problem, begin, settings)
        if checkpoint and in_plain_autograd(begin.z, begin.D, problem.lam, problem.mu):
            end = run_in_legs(problem, begin, cost, settings, self.n_iter, callback)
        else:

            def advance(problem: Problem, old: State, _: Tensor, iteration: int) -> tuple[State, Tensor, Tensor]:
                new = iterate(problem, old, settings, iteration)
                costs = objective(problem, new, settings, iteration)[:, None]
                return new, costs, settled(problem, new, old.z, settings, iteration)

            end = run_until_settled(
                problem, begin, cost, advance, self.n_iter, tol=self.tol, finish=last_state, callback=callback
            )
        z, D, B = end.state
        rest = end.objective[:, -1:].expand(-1, self.n_iter + 1 - end.objective.shape[1])
        costs = torch.cat([end.objective, rest], 1)
        noise, lam, mu = problem.noise, problem.lam, problem.mu
        whole = torch.ones_like(noise)
        return DLSResult(z, D, B, costs, noise, lam, mu, end.converged, end.iterations, whole)

    def _problem(self, fields: Fields, noise: Tensor) -> Problem:
        """Everything that stays the same during the iterations."""
        gradient, mask = fields.gradient, fields.mask
        shape, N = gradient.shape[-2:], gradient.shape[0]
        lam = per_surface("lam", self.lam, _AUTO_LAM * mean_weight(fields).flatten())
        mu = per_surface("mu", self.mu, _AUTO_MU * noise)
        if isinstance(self.mu, str):  # where there is no noise, or nothing tells it: least squares
            lam, mu = (torch.where(noise > 0, t, 0) for t in (lam, mu))
        elif not isinstance(self.mu, tuple) and spans_patches(
            self.dictionary, self.learner
        ):  # patches that cost nothing: least squares
            lam = torch.where(mu > 0, lam, 0)  # without a threshold patches cost nothing: least squares
        coverage = self.patches.coverage(shape, dtype=gradient.dtype, device=gradient.device)
        data = self.data_term._data_term(fields)
        schedule = self.mu if isinstance(self.mu, tuple) else None
        if mask is None:
            if self.patches.even(shape):  # one number, with which the height is one direct solve
                coverage = coverage[..., :1, :1]
            return Problem(fields, self.patches, coverage, None, data, noise, lam, mu, schedule)
        valid = (self.patches.extract(mask.to(gradient.dtype)) > 0).expand(N, -1, -1)
        return Problem(fields, self.patches, coverage * mask, valid, data, noise, lam, mu, schedule)

    def _noise(self, fields: Fields) -> Tensor:
        """(N,) noise of a gradient sample of mean weight; NaN where nothing tells it."""
        weight = fields.weight
        if weight is not None:  # a common factor of the weights is no news about the noise
            weight = weight / mean_weight(fields)
        if fields.on_edges:
            level, told = edge_noise_if_told(fields.gradient, weight, fields.steps)
        else:
            level, told = noise_if_told(fields.gradient, fields.mask, weight, fields.steps, fields.boundary)
        return torch.where(told, level, math.nan)

    @property
    def _reads_edges(self) -> bool:  # type: ignore[override]
        """As its data term does."""
        return self.data_term._reads_edges

    @property
    def _guarded(self) -> bool:
        """Whether the result is held to least squares."""
        automatic = isinstance(self.mu, str) and type(self.data_term) is LeastSquares
        return self.select == "guard" or (self.select == "auto" and automatic)

    def _initial_dictionary(self, fields: Fields) -> Tensor:
        D = self.dictionary.to(fields.gradient)
        D = D if D.ndim == 3 else D[None]
        N = fields.gradient.shape[0]
        if D.shape[0] not in (1, N) or (self.learn == "shared" and D.shape[0] != 1):
            raise ValueError(f"DLS: dictionary {tuple(D.shape)} does not fit {N} surfaces with learn={self.learn!r}")
        D = D / D.norm(dim=1, keepdim=True)
        return D.expand(N, -1, -1) if self.learn == "each" else D

    @property
    def patch_size(self) -> int | tuple[int, int]:
        """Rows and columns of a patch."""
        return self.patches.size

    @property
    def stride(self) -> int | tuple[int, int]:
        """Step between patches, down and to the right."""
        return self.patches.stride

    @property
    def n_atoms(self) -> int:
        """K, the number of atoms."""
        return self.dictionary.shape[-1]

    def _arguments(self) -> dict[str, Any]:
        arguments = super()._arguments()
        if not isinstance(self.dictionary, nn.Parameter):
            cosines = dct_dictionary(self.patch_size, self.n_atoms).to(self.dictionary)
            if torch.equal(cosines, self.dictionary):
                arguments["dictionary"] = None
        return arguments
