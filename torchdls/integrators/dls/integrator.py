"""DLS: integration regularised by a dictionary that is learned from the patches of the surface itself."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from torchdls._tracing import in_plain_autograd, is_concrete, seen_everywhere
from torchdls.dictionary import dct_dictionary
from torchdls.dictionary.learners import FixedDictionary, Learner
from torchdls.dictionary.soup_dil import Order, Unused
from torchdls.dictionary.thresholds import Threshold
from torchdls.integrators.base import Fields, Integrator
from torchdls.integrators.classic.least_squares import LeastSquares
from torchdls.integrators.data_term import edge_cost
from torchdls.integrators.dls.checkpoint import Iteration, run_in_legs
from torchdls.integrators.dls.choice import check_selectable, choose_threshold
from torchdls.integrators.dls.implicit import implicit_derivative
from torchdls.integrators.dls.problem import Finished, Problem, State, drop_costly_codes, merge, patch_cost
from torchdls.integrators.dls.settings import (
    Grad,
    Learn,
    check_combination,
    check_dictionary,
    check_options,
    check_strength,
    choose_learner,
    per_surface,
    register_setting,
    resolve_derivative,
)
from torchdls.integrators.dls.window import live_window
from torchdls.integrators.iterative import Callback, Iterative
from torchdls.noise import noise_if_told
from torchdls.operators import GradientOperator, Patches
from torchdls.solvers import harmonic_extension, remove_free_constants, solve

# lam is a plateau from here on; one standard deviation of the noise is safe on textured relief and on smooth surfaces
# alike (benchmarks/quality/dls.py).
_AUTO_LAM = 0.5
_AUTO_MU = 1.0


class DLSResult(NamedTuple):
    """What `DLS.solve` returns; always batched.

    Attributes:
        height: (N, 1, H, W).
        dictionary: (N, n, K), or (1, n, K) if shared or fixed; unit-norm atoms.
        codes: (N, K, L), in units of height.
        objective: (N, n_iter + 1), from the start (B = 0) on, for heights in pixels and before their free constant is
            taken out; it never rises (with one dictionary for the batch, its sum over the batch never does).
        noise: (N,) estimated standard deviation of one gradient sample, of mean weight if there are weights.
        lam: (N,) the regularisation weight used.
        mu: (N,) the threshold used, for heights in pixels.
        converged: (N,) bool, whether the height settled to `tol` before the iterations ran out.
        iterations: (N,) the iterations each surface took.

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


class DLS(Iterative[DLSResult]):
    r"""Dictionary learning on surfaces.

        min over z, B, D   data(z) + lam ( \sum_j ||P_j z - D b_j||^2 + mu^2 ||B||_0 ),   ||d_i|| = 1, |b_ji| <= bound

    with data(z) = 1/2 ||A z - v||^2 by default. From the height of the data term alone and B = 0, every iteration
    sweeps over the codes and atoms of all overlapping patches (`soup_dil_sweep`) and then solves for the height,
    where the patches act as an anchor: lam \sum_j ||P_j z - D b_j||^2 = 1/2 \sum_i r_i (z_i - a_i)^2 + const, with r
    = 2 lam c, a = fold(D B) / c and c the number of patches that hold a pixel.

    `lam` and `mu` refer to heights measured in pixels (h = sqrt(dx dy)), so they mean the same at every pixel size.

    With a mask, the fit counts valid pixels only. Invalid pixels of a patch are filled before each sweep by the patch's
    current approximation D b_j, which majorises that cost; before the first sweep, by the harmonic extension of the
    height, and patches that this serves badly lose their codes again. So the objective never rises. Patches without a
    valid pixel are left out. Nothing outside the mask is read.

    Args:
        patch_size: rows and columns of a patch, or one number for both.
        stride: step between patches, at most the patch size.
        n_atoms: K, the number of atoms of the initial DCT dictionary; ignored if `dictionary` is given.
        lam: weight of the patch model; a number, a tensor (a number or one per surface), or "auto" (0.5).
        mu: threshold on the codes; a number, a tensor (a number or one per surface), or "auto": the noise
            level of one gradient sample, which `noise_level` estimates from the non-integrable part of each field;
            where there is none, or no cell of 2 x 2 pixels tells it, the height is that of the data term alone.
        n_iter: limit of iterations.
        data_term: an integrator built on the solve (*), which provides the data term and the first height.
        dictionary: initial dictionary (n, K), or (N, n, K) for each surface of a batch; atoms are brought to unit
            norm. An `nn.Parameter` is trained with the module, a tensor is a buffer. None for
            `dct_dictionary(patch_size, n_atoms)`.
        z_step: "exact" solves for the height; "proximal" takes `n_prox` proximal gradient steps as in the paper, with
            tau = 1 / ||A||^2 (1/8 for unit weights and square pixels).
        order: order of the sweep, "atom" (the paper's) or "block".
        learn: "each" learns a dictionary per surface, "shared" one for the batch, "fixed" updates the codes alone.
        n_sweeps: sweeps per iteration.
        n_prox: proximal gradient steps per iteration.
        bound: bound a on the codes, for heights in pixels.
        unused: rule for atoms that no patch uses, "first" or "keep" (see `soup_dil_sweep`).
        learner: "soup_dil", "k_svd", "dino_kat", "unitary", "fixed", or a `Learner` such as `KSVD(n_nonzero=4)`; None
            is `SoupDIL(order, unused, threshold)`.
        tol: a surface stops once a step moves its height by less than `tol` times the whole way from the first height;
            0 runs all iterations.
        threshold: "hard" (the paper's), or "soft" or "firm" (see `torchdls.dictionary.thresholds`), with which `mu` can
            be trained.
        select: predict for each surface the risk of several thresholds without the truth (`torchdls.select`), and take
            the best, or least squares (lam = 0) where none promises to cut its risk by a third. Seven runs instead of
            one; three where mu is a number. For full rectangles with equal weights and no anchors. The derivative holds
            the choice fixed.
        z_tol: relative residual of the exact z-step.
        grad: what the derivative is (docs/differentiation.md). "unroll": of the iterations that were run, exact.
            "implicit": of the fixed point, for a fixed dictionary, at the cost of one linear solve.
            "frozen_dictionary": the same as if the learned dictionary did not move, an approximation. "none". "auto" is
            "implicit" where that is exact and "unroll" elsewhere.
        grad_tol: relative residual of the linear solve of an implicit derivative.
        checkpoint: save memory of an unrolled derivative: only heights, dictionaries and nonzero codes are kept, of
            one iteration in sqrt(n_iter), and iterations are run again in the backward pass. First derivatives only.
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
    mu: float | Tensor | str
    dictionary: Tensor

    def __init__(
        self,
        patch_size: int | tuple[int, int] = 8,
        stride: int | tuple[int, int] = 2,
        n_atoms: int = 64,
        lam: float | Tensor | Literal["auto"] = "auto",
        mu: float | Tensor | Literal["auto"] = "auto",
        n_iter: int = 50,
        data_term: Integrator | None = None,
        dictionary: Tensor | None = None,
        z_step: Literal["exact", "proximal"] = "exact",
        order: Order = "atom",
        *,
        learn: Learn = "each",
        n_sweeps: int = 1,
        n_prox: int = 1,
        bound: float = math.inf,
        unused: Unused = "first",
        learner: str | Learner | None = None,
        threshold: Threshold = "hard",
        select: bool = False,
        tol: float = 1e-3,
        z_tol: float = 1e-6,
        grad: Grad = "auto",
        grad_tol: float = 1e-3,
        checkpoint: bool = False,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(pixel_size=pixel_size)
        self.patches = Patches(patch_size, stride)
        self.data_term = LeastSquares() if data_term is None else data_term
        if not isinstance(self.data_term, Integrator):
            raise TypeError(f"DLS: data_term is a {type(data_term).__name__}, an Integrator is needed")
        if not self.data_term.quadratic:
            raise ValueError(f"DLS: data_term {type(data_term).__name__} is not built on the weighted solve")
        asked, fixed = learn, learner == "fixed" or isinstance(learner, FixedDictionary)
        learn = "fixed" if fixed else learn
        options = {"z_step": z_step, "order": order, "learn": learn, "unused": unused, "threshold": threshold}
        counts = {"n_iter": n_iter, "n_sweeps": n_sweeps, "n_prox": n_prox}
        check_options(**options, **counts, grad=grad, bound=bound, tol=tol, z_tol=z_tol, grad_tol=grad_tol)
        register_setting(self, "lam", check_strength("lam", lam))
        register_setting(self, "mu", check_strength("mu", mu))
        self.n_iter, self.n_sweeps, self.n_prox = n_iter, n_sweeps, n_prox
        self.z_step, self.order, self.learn, self.unused, self.threshold = z_step, order, learn, unused, threshold
        self.bound, self.tol, self.z_tol, self.grad_tol = bound, tol, z_tol, grad_tol
        self.learner = choose_learner(learner, order, unused, threshold, self.patches)
        self.checkpoint, self.select = checkpoint, select
        if select:
            check_selectable(self.data_term, learn)
        initial = dct_dictionary(self.patches.size, n_atoms) if dictionary is None else dictionary
        check_dictionary(initial, self.patches)
        register_setting(self, "dictionary", initial)
        self.grad = resolve_derivative(grad, learn, threshold, self._steady, initial)
        check_combination(learn=asked, fixed=fixed, n_prox=n_prox, z_step=z_step, checkpoint=checkpoint, grad=self.grad)

    def in_units(self, result: DLSResult) -> DLSResult:
        """Height and codes in the unit of `pixel_size`."""
        return result._replace(height=result.height * self.unit, codes=result.codes * self.unit)

    def iterate(self, fields: Fields, callback: Callback | None = None) -> DLSResult:
        """The iterations, within the window of the patches that a mask leaves alive."""
        noise = self._noise(fields)
        if not self.patches.fit(fields.gradient.shape) or (isinstance(self.mu, str) and seen_everywhere(~(noise > 0))):
            return self._without_patches(fields, noise)
        window = live_window(fields.mask, self.patches)
        fields = fields if window is None else window.crop(fields)
        model = self._model(fields, noise)
        if self.select:
            model = choose_threshold(model, isinstance(self.mu, str), functools.partial(self._trial, model))
        result = self._differentiated(model, callback)
        height = remove_free_constants(result.height, fields.mask, fields.anchor_weight)
        if window is None:
            return result._replace(height=height)
        return result._replace(height=window.put_back(height), codes=window.put_codes_back(result.codes))

    def _without_patches(self, fields: Fields, noise: Tensor) -> DLSResult:
        """The surface of the data term alone, where no patch fits or none has noise to lose: nothing to iterate."""
        z, D = self.data_term.integrate(fields), self._initial_dictionary(fields)
        cost = self.data_term.data_cost(fields, z)
        if fields.anchor is not None and fields.anchor_weight is not None:
            cost = cost + 0.5 * (fields.anchor_weight * (z - fields.anchor).square()).sum((-3, -2, -1))
        rows, columns = self.patches.grid(z.shape) if self.patches.fit(z.shape) else (0, 0)
        codes = z.new_zeros(len(z), D.shape[-1], rows * columns)
        costs = cost[:, None].expand(-1, self.n_iter + 1)
        nothing = torch.zeros_like(noise)
        lam, mu = (per_surface(name, getattr(self, name), nothing) for name in ("lam", "mu"))
        return DLSResult(z, D, codes, costs, noise, 0 * lam, mu, nothing == 0, nothing.long())

    def _differentiated(self, model: Problem, callback: Callback | None) -> DLSResult:
        """The result of the iterations, with the derivative that was chosen."""
        if self.grad == "unroll":
            return self._run_within(model, callback)
        with torch.no_grad():
            found = self._run_within(model, callback)
        found = DLSResult(*(t.detach() for t in found))
        if self.grad == "none":
            return found
        D = self._initial_dictionary(model.fields) if self.learn == "fixed" else found.dictionary
        height, codes = implicit_derivative(
            model, found.height, D, found.codes, threshold=self.threshold, bound=self.bound, tol=self.grad_tol
        )
        return found._replace(height=height, dictionary=D, codes=codes, noise=model.noise, lam=model.lam, mu=model.mu)

    def _trial(self, model: Problem, gradient: Tensor, mu: Tensor) -> Tensor:
        """Height of other gradients with another threshold."""
        other = self._model(model.fields._replace(gradient=gradient), model.noise)
        return self._run_within(other._replace(lam=model.lam, mu=mu), None).height

    def _run_within(self, model: Problem, callback: Callback | None) -> DLSResult:
        state = self._start(model)
        objective = [self._objective(model, state)]
        if self.checkpoint and self.n_iter and in_plain_autograd(state.z, state.D, model.lam, model.mu):
            options = self.learner, self.learn != "fixed", self.n_sweeps, self.bound, self.threshold, self.tol
            parts_of_one = Iteration(self._round, self._settled, self._step, *options)
            end, values, active, taken = run_in_legs(parts_of_one, model, state, objective[0], self.n_iter, callback)
            return DLSResult(end.z, end.D, end.B, values, model.noise, model.lam, model.mu, ~active, taken)
        active = torch.ones_like(model.noise, dtype=torch.bool)
        taken = torch.zeros_like(active, dtype=torch.int64)
        running, parts = model, [Finished(torch.arange(len(active), device=active.device), state)]
        look = self.tol > 0 and is_concrete(model.fields.gradient)
        for iteration in range(1, self.n_iter + 1):
            index, old = parts[-1]
            new, value = self._round(running, old, first=iteration == 1)
            settled = self._settled(new, old)
            whole = len(index) == len(active)
            taken = taken + active if whole else taken.index_add(0, index, torch.ones_like(index))
            if not look:  # every surface stays in the batch, and those that have settled do not move
                new = old.choose(active, new) if self.tol > 0 else new
                value = torch.where(active, value, objective[-1]) if self.tol > 0 else value
            parts[-1] = Finished(index, new)
            objective.append(value if whole else objective[-1].index_copy(0, index, value))
            if callback is not None:
                callback(iteration, objective[-1].detach())
            active = active & ~settled if whole else active.index_copy(0, index, ~settled)
            if look and bool(settled.any()):  # what has settled leaves the batch
                if bool(settled.all()):
                    break
                parts[-1:] = [Finished(index[keep], new.select(keep)) for keep in (settled, ~settled)]
                running = running.select(~settled)
        objective += [objective[-1]] * (self.n_iter + 1 - len(objective))
        end = merge(parts)
        return DLSResult(
            end.z, end.D, end.B, torch.stack(objective, 1), model.noise, model.lam, model.mu, ~active, taken
        )

    def _start(self, model: Problem) -> State:
        """Heights of the data term alone, and no codes: the patches are the residual."""
        z = self.data_term.integrate(model.fields)
        D = self._initial_dictionary(model.fields)
        if model.valid is None:
            R = model.patches.extract(z)
        else:
            some = model.valid.any(1, keepdim=True)
            R = torch.where(some, model.patches.extract(self._extend(model, z)), 0)
        return State(z, z, R, D, R.new_zeros(R.shape[0], D.shape[-1], R.shape[-1]))

    def _extend(self, model: Problem, z: Tensor) -> Tensor:
        """The height continued over the patches that hold a valid pixel."""
        assert model.fields.mask is not None
        assert model.valid is not None
        live = model.valid.any(1, keepdim=True).expand(model.valid.shape).to(z.dtype)
        reach = model.patches.adjoint(live, z.shape) > 0
        return harmonic_extension(z, model.fields.mask, reach, tol=self.z_tol, pixel_size=model.fields.steps)

    def _round(self, model: Problem, state: State, first: bool) -> tuple[State, Tensor]:
        """One iteration, and the objective after it."""
        state = self._iterate(model, state, first)
        return state, self._objective(model, state)

    def _iterate(self, model: Problem, state: State, first: bool) -> State:
        """Codes and atoms, then the height."""
        R, D, B = state.R, state.D, state.B
        bare = torch.where(model.valid, R, 0) if first and model.valid is not None else None
        for _ in range(self.n_sweeps):
            R, D, B = self.learner(R, D, B, model.mu[:, None], self.bound, self.learn != "fixed")
            # Filling the invalid pixels of a patch by its approximation D b means: no residual there.
            R = R if model.valid is None else torch.where(model.valid, R, 0)
            if bare is not None:
                R, B = drop_costly_codes(bare, R, B, model.mu, self.threshold)
                bare = None
        z = self._step(model, state.z, model.patches.adjoint(R, state.z.shape))
        return State(state.start, z, model.patches.extract_onto(R, z - state.z), D, B)

    def _settled(self, new: State, old: State) -> Tensor:
        """(N,) bool: the step was short. With one dictionary for all, a surface has settled once all have."""
        step, way = ((z).flatten(1).norm(dim=1) for z in (new.z - old.z, new.z - new.start))
        settled = step <= self.tol * way
        return settled.all().expand_as(settled) if self.learn == "shared" else settled

    def _model(self, fields: Fields, noise: Tensor) -> Problem:
        """Everything that stays the same during the iterations."""
        gradient, mask = fields.gradient, fields.mask
        shape, N = gradient.shape[-2:], gradient.shape[0]
        lam = per_surface("lam", self.lam, _AUTO_LAM * torch.ones_like(noise))
        mu = per_surface("mu", self.mu, _AUTO_MU * noise)
        if isinstance(self.mu, str):  # where there is no noise, or nothing tells it: least squares
            lam, mu = (torch.where(noise > 0, t, 0) for t in (lam, mu))
        coverage = self.patches.coverage(shape, dtype=gradient.dtype, device=gradient.device)
        edges = self.data_term.edges(fields) if self._steady else None
        if mask is None:
            if self.patches.tile(shape):  # one number, with which the height is one direct solve
                coverage = coverage[..., :1, :1]
            return Problem(fields, self.patches, coverage, None, edges, noise, lam, mu)
        valid = self.patches.extract(mask.to(gradient.dtype)) > 0
        return Problem(fields, self.patches, coverage * mask, valid.expand(N, -1, -1), edges, noise, lam, mu)

    def _noise(self, fields: Fields) -> Tensor:
        """(N,) noise of a gradient sample of mean weight; NaN where nothing tells it."""
        weight = fields.weight
        if weight is not None:  # a common factor of the weights is no news about the noise
            count = (weight > 0).sum((-3, -2, -1), keepdim=True).clamp(min=1)
            weight = weight * count / weight.sum((-3, -2, -1), keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
        level, told = noise_if_told(fields.gradient, fields.mask, weight, fields.steps)
        return torch.where(told, level, math.nan)

    @property
    def _steady(self) -> bool:
        """Whether the data term is one quadratic, whatever the height."""
        kind = type(self.data_term)
        return kind.edges is Integrator.edges and kind.data_cost is Integrator.data_cost

    def _initial_dictionary(self, fields: Fields) -> Tensor:
        D = self.dictionary.to(fields.gradient)
        D = D if D.ndim == 3 else D[None]
        N = fields.gradient.shape[0]
        if D.shape[0] not in (1, N) or (self.learn == "shared" and D.shape[0] != 1):
            raise ValueError(f"DLS: dictionary {tuple(D.shape)} does not fit {N} surfaces with learn={self.learn!r}")
        D = D / D.norm(dim=1, keepdim=True)
        return D.expand(N, -1, -1) if self.learn == "each" else D

    def _step(self, model: Problem, z: Tensor, folded: Tensor) -> Tensor:
        """The height for given patches D B = P - R, with R folded."""
        fields = model.fields
        v, w = model.edges or self.data_term.edges(fields, z)
        strength = 2 * model.lam[:, None, None, None]
        weight = strength * model.coverage
        pull = weight * z - strength * folded  # = 2 lam fold(D B), as fold(P) = coverage z
        if fields.anchor is not None and fields.anchor_weight is not None:
            weight, pull = weight + fields.anchor_weight, pull + fields.anchor_weight * fields.anchor
        if self.z_step == "exact":
            anchor = pull / torch.where(weight > 0, weight, 1)
            return solve(v, w, anchor, weight, tol=self.z_tol, z0=z.detach(), pixel_size=fields.steps).height
        a = GradientOperator("forward", fields.steps)
        largest = z.new_ones(()) if w is None else w.amax((-3, -2, -1), keepdim=True).clamp(min=1)
        tau = 1 / (a.norm_bound**2 * largest)
        for _ in range(self.n_prox):
            misfit = a(z) - v
            slope = a.adjoint(misfit if w is None else w * misfit)
            z = (z - tau * slope + tau * pull) / (1 + tau * weight)
        return z

    def _objective(self, model: Problem, state: State) -> Tensor:
        """(N,) value of the cost, for heights in pixels."""
        fields, z = model.fields, state.z
        cost = self.data_term.data_cost(fields, z) if model.edges is None else edge_cost(z, *model.edges, fields.steps)
        if fields.anchor is not None and fields.anchor_weight is not None:
            cost = cost + 0.5 * (fields.anchor_weight * (z - fields.anchor).square()).sum((-3, -2, -1))
        return cost + model.lam * patch_cost(state.R, state.B, model.mu, model.valid, self.threshold)

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
