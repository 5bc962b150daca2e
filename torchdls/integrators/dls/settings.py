"""The options of DLS: what is allowed, and what words stand for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchdls._checks import check_numbers
from torchdls._registry import LEARNERS
from torchdls._tracing import holds_everywhere, is_concrete
from torchdls.dictionary.learners import DinoKat, FixedDictionary, Learner, SoupDIL
from torchdls.dictionary.unitary import Unitary
from torchdls.integrators.dls.options import DERIVATIVES, HEIGHT_STEPS, Exact, Implicit, Proximal, Unroll, meant
from torchdls.operators import Patches

Learn = Literal["each", "shared", "fixed"]
LEARN: tuple[Learn, ...] = ("each", "shared", "fixed")
HeightStep = Literal["exact", "proximal"] | Exact | Proximal
Derivative = Literal["auto", "unroll", "implicit", "frozen_dictionary", "none"] | Unroll | Implicit


def check_run(n_iter: int, tol: float, mu: object) -> None:
    """ValueError for a number of iterations or a tolerance out of its range, or a schedule of another length."""
    if not isinstance(n_iter, int) or n_iter < 0:
        raise ValueError(f"DLS: n_iter={n_iter!r} given, an integer of at least 0 is needed")
    check_numbers("DLS", tol=tol)
    if not tol >= 0:
        raise ValueError(f"DLS: tol={tol!r} given, a number of at least 0 is needed")
    if isinstance(mu, tuple) and len(mu) != n_iter:
        raise ValueError(f"DLS: mu has {len(mu)} values for n_iter={n_iter} iterations")


def check_boundary(boundary: object, data_term: object, select: object) -> None:
    """ValueError for an unknown boundary, one that differs from the data term's, or one without a predicted risk."""
    if boundary not in ("neumann", "periodic"):
        raise ValueError(f"DLS: boundary={boundary!r} is unknown; choose from 'neumann', 'periodic'")
    own = getattr(data_term, "boundary", boundary)
    if own != boundary and own != "dirichlet":  # that one has no data term at all, which is said elsewhere
        name = type(data_term).__name__
        raise ValueError(f"DLS: boundary={boundary!r} does not go with data_term {name}, whose boundary is {own!r}")
    if boundary == "periodic" and select is True:
        raise ValueError("DLS: select=True predicts the risk with free borders, not with boundary='periodic'")


def choose_height_step(height_step: HeightStep) -> Exact | Proximal:
    """The height step that was named, or the one given."""
    return meant("height_step", height_step, HEIGHT_STEPS, (Exact, Proximal))


def choose_derivative(
    derivative: Derivative, learn: Learn, threshold: str, steady: bool, dictionary: Tensor
) -> Unroll | Implicit | None:
    """The derivative that was named or given, once it is found to exist; what "auto" stands for.

    Args:
        derivative: what was asked for.
        learn: whether the dictionary is learned.
        threshold: rule of the codes.
        steady: the data term is one quadratic, whatever the height, and the borders are free.
        dictionary: the initial dictionary.
    """
    possible = steady and threshold != "firm"
    automatic = Implicit() if learn == "fixed" and possible else Unroll()
    found = meant("derivative", derivative, {"auto": automatic, **DERIVATIVES}, (Unroll, Implicit))
    if not isinstance(found, Implicit):
        return found
    asked = f"DLS: derivative={derivative!r}"
    if not possible:
        what = "a data term that is one quadratic, free borders, and hard or soft thresholds"
        raise ValueError(f"{asked} needs {what}; take derivative='unroll'")
    if found.frozen_dictionary == (learn == "fixed"):
        other = "'implicit'" if found.frozen_dictionary else "'unroll' (exact) or 'frozen_dictionary'"
        raise ValueError(f"{asked} does not go with learn={learn!r}; take {other}")
    if found.frozen_dictionary and isinstance(dictionary, nn.Parameter):
        raise ValueError(f"{asked} gives a trained dictionary no derivative; take 'unroll'")
    return found


def choose_learner(learner: str | Learner, learn: Learn, patches: Patches) -> tuple[Learner, Learn]:
    """The learner of that name for these patches, or the one given, and how it learns."""
    if isinstance(learner, str):
        if learner not in LEARNERS:
            raise ValueError(f"DLS: learner={learner!r} is unknown; choose from {', '.join(map(repr, LEARNERS))}")
        learner = LEARNERS[learner]()
    if not callable(learner):
        raise TypeError(f"DLS: learner is a {type(learner).__name__}, a name or a Learner is needed")
    if learn not in LEARN:
        raise ValueError(f"DLS: learn={learn!r} is unknown; choose from {', '.join(map(repr, LEARN))}")
    if isinstance(learner, FixedDictionary):
        if learn == "shared":
            raise ValueError("DLS: learn='shared' does not go with a fixed dictionary")
        return learner, "fixed"
    if learn == "fixed" and isinstance(learner, SoupDIL | DinoKat):
        idle = {name: getattr(learner, name) for name in ("order", "unused")}
        if idle != {"order": "atom", "unused": "first"}:
            given = ", ".join(f"{name}={value!r}" for name, value in idle.items())
            raise ValueError(f"DLS: {given} of the learner have no effect with learn='fixed'; take FixedDictionary")
    if isinstance(learner, DinoKat) and learner.patch_size is None and isinstance(patches.size, tuple):
        learner = replace(learner, patch_size=patches.size)
    return learner, learn


def register_setting(module: nn.Module, name: str, value: object) -> None:
    """A tensor becomes a buffer, so that it moves with the module, unless it is a parameter already."""
    if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
        module.register_buffer(name, value.detach().clone())
    else:
        setattr(module, name, value)


def check_strength(name: str, value: Any) -> float | Tensor | tuple[float, ...] | str:
    """Lam or mu: "auto", a number or a tensor, neither negative nor NaN; mu may be infinite, lam may not.

    mu may also be a sequence of numbers, one for each iteration, which becomes a tuple.
    """
    kinds = (str, int, float, Tensor, *((list, tuple) if name == "mu" else ()))
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise TypeError(f"DLS: {name} is a {type(value).__name__}, 'auto', a number or a tensor is needed")
    if isinstance(value, list | tuple):
        if not all(isinstance(v, int | float) and not isinstance(v, bool) and v >= 0 for v in value):
            raise ValueError(f"DLS: {name}={value!r} given, a schedule of numbers of at least 0 is needed")
        return tuple(map(float, value))
    if isinstance(value, str):
        known = value == "auto"
    else:
        values = value.detach() if isinstance(value, Tensor) else torch.tensor(value, device="cpu")
        known = bool((values >= 0).all()) and (name == "mu" or bool(values.isfinite().all()))
    if not known:
        raise ValueError(f"DLS: {name}={value!r} given, 'auto' or a number of at least 0 is needed")
    return value


def per_surface(name: str, value: float | Tensor | Sequence[float] | str, auto: Tensor) -> Tensor:
    """Lam or mu as (N,): what was given, the last of a schedule, or what was found for "auto"."""
    if isinstance(value, str):
        return auto
    if isinstance(value, list | tuple):
        value = value[-1] if value else 0.0
    value = torch.as_tensor(value, dtype=auto.dtype, device=auto.device)
    if value.numel() not in (1, auto.numel()):
        raise ValueError(f"DLS: {name} {tuple(value.shape)} does not fit {auto.numel()} surfaces")
    return value.reshape(-1).expand(auto.shape)


def check_dictionary(dictionary: Tensor, patches: Patches) -> None:
    """The initial dictionary must fit the patches and have no atom that is zero."""
    if not isinstance(dictionary, Tensor):
        raise TypeError(f"DLS: dictionary is a {type(dictionary).__name__}, a tensor is needed")
    if dictionary.ndim not in (2, 3) or dictionary.shape[-2] != patches.n_pixels or 0 in dictionary.shape:
        wanted = f"(n, K) or (N, n, K) with n = {patches.n_pixels}"
        raise ValueError(f"DLS: dictionary {tuple(dictionary.shape)} given, {wanted} is needed")
    norms = dictionary.detach().norm(dim=-2)
    if not holds_everywhere(norms.isfinite() & (norms > 0)):
        raise ValueError("DLS: dictionary has an atom that is zero or not finite")


def spans_patches(dictionary: Tensor, learner: Learner) -> bool:
    """Whether codes of the dictionary make any patch, so that patches cost nothing where codes do not (mu = 0)."""
    by_threshold = isinstance(learner, SoupDIL | FixedDictionary | DinoKat | Unitary) and learner.bound == math.inf
    D = dictionary.detach()
    return by_threshold and is_concrete(D) and bool((torch.linalg.matrix_rank(D) == D.shape[-2]).all())
