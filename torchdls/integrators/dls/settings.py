"""The options of DLS: what is allowed, and what "auto" stands for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchdls._checks import check_numbers
from torchdls._registry import LEARNERS
from torchdls.dictionary.learners import DinoKat, Learner, SoupDIL
from torchdls.dictionary.soup_dil import Order, Unused
from torchdls.dictionary.thresholds import THRESHOLDS, Threshold
from torchdls.operators import Patches

Learn = Literal["each", "shared", "fixed"]
Grad = Literal["auto", "unroll", "implicit", "frozen_dictionary", "none"]

_WORDS = {
    "z_step": ("exact", "proximal"),
    "order": ("atom", "block"),
    "learn": ("each", "shared", "fixed"),
    "unused": ("first", "keep"),
    "threshold": THRESHOLDS,
    "grad": ("auto", "unroll", "implicit", "frozen_dictionary", "none"),
}
_COUNTS = {"n_iter": 0, "n_sweeps": 1, "n_prox": 1}


def check_options(*, bound: float, tol: float, z_tol: float, grad_tol: float, **options: Any) -> None:
    """ValueError for a word that is unknown, or a number out of its range."""
    for name, known in _WORDS.items():
        if options[name] not in known:
            raise ValueError(f"DLS: {name}={options[name]!r} is unknown; choose from {', '.join(map(repr, known))}")
    for name, least in _COUNTS.items():
        if not isinstance(options[name], int) or options[name] < least:
            raise ValueError(f"DLS: {name}={options[name]!r} given, an integer of at least {least} is needed")
    check_numbers("DLS", bound=bound, tol=tol, z_tol=z_tol, grad_tol=grad_tol)
    if not bound > 0 or not tol >= 0 or not z_tol > 0 or not grad_tol > 0:
        positive = f"bound={bound!r}, z_tol={z_tol!r} and grad_tol={grad_tol!r} must be positive"
        raise ValueError(f"DLS: {positive}, tol={tol!r} not negative")


def resolve_derivative(grad: Grad, learn: Learn, threshold: str, steady: bool, dictionary: Tensor) -> Grad:
    """The kind of derivative that "auto" stands for, once the kind asked for is found to exist.

    Args:
        grad: what was asked for.
        learn: whether the dictionary is learned.
        threshold: rule of the codes.
        steady: the data term is one quadratic, whatever the height.
        dictionary: the initial dictionary.
    """
    possible = steady and threshold != "firm"
    if grad == "auto":
        return "implicit" if learn == "fixed" and possible else "unroll"
    if grad in ("implicit", "frozen_dictionary"):
        if not possible:
            what = "a quadratic data term and hard or soft thresholds"
            raise ValueError(f"DLS: grad={grad!r} needs {what}; take grad='unroll'")
        if (grad == "implicit") != (learn == "fixed"):
            other = "'unroll' (exact) or 'frozen_dictionary'" if grad == "implicit" else "'implicit'"
            raise ValueError(f"DLS: grad={grad!r} does not go with learn={learn!r}; take {other}")
        if grad == "frozen_dictionary" and isinstance(dictionary, nn.Parameter):
            raise ValueError("DLS: grad='frozen_dictionary' gives a trained dictionary no derivative; take 'unroll'")
    return grad


def choose_learner(
    learner: str | Learner | None, order: Order, unused: Unused, threshold: Threshold, patches: Patches
) -> Learner:
    """The learner of that name for these patches, or the one given; None is SOUP-DIL with the other options."""
    if learner is None or learner == "soup_dil":
        return SoupDIL(order, unused, threshold)
    if isinstance(learner, str):
        if learner not in LEARNERS:
            raise ValueError(f"DLS: learner={learner!r} is unknown; choose from {', '.join(map(repr, LEARNERS))}")
        learner = LEARNERS[learner]()
    if not callable(learner):
        raise TypeError(f"DLS: learner is a {type(learner).__name__}, a name or a Learner is needed")
    if getattr(learner, "threshold", "hard") != threshold:
        raise ValueError(f"DLS: threshold={threshold!r} does not go with learner={learner!r}")
    for name, value, default in (("order", order, "atom"), ("unused", unused, "first")):
        if value not in (default, getattr(learner, name, default)):
            raise ValueError(f"DLS: {name}={value!r} does not go with learner={learner!r}")
    if isinstance(learner, DinoKat) and learner.patch_size is None and isinstance(patches.size, tuple):
        learner = replace(learner, patch_size=patches.size)
    return learner


def check_combination(*, learn: Learn, fixed: bool, n_prox: int, z_step: str, checkpoint: bool, grad: Grad) -> None:
    """ValueError for an option that another one would leave without effect."""
    if fixed and learn == "shared":
        raise ValueError("DLS: learn='shared' does not go with a fixed dictionary")
    if n_prox != 1 and z_step == "exact":
        raise ValueError(f"DLS: n_prox={n_prox} does not go with z_step='exact'; take z_step='proximal'")
    if checkpoint and grad != "unroll":
        raise ValueError(f"DLS: checkpoint=True does not go with grad={grad!r}; take grad='unroll'")


def register_setting(module: nn.Module, name: str, value: float | Tensor | str) -> None:
    """A tensor becomes a buffer, so that it moves with the module, unless it is a parameter already."""
    if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
        module.register_buffer(name, value.detach().clone())
    else:
        setattr(module, name, value)


def check_strength(name: str, value: float | Tensor | str) -> float | Tensor | str:
    """Lam or mu: "auto", a number or a tensor, neither negative nor NaN; mu may be infinite, lam may not."""
    if not isinstance(value, str | int | float | Tensor):
        raise TypeError(f"DLS: {name} is a {type(value).__name__}, 'auto', a number or a tensor is needed")
    if isinstance(value, str):
        known = value == "auto"
    else:
        values = value.detach() if isinstance(value, Tensor) else torch.tensor(value, device="cpu")
        known = bool((values >= 0).all()) and (name == "mu" or bool(values.isfinite().all()))
    if not known:
        raise ValueError(f"DLS: {name}={value!r} given, 'auto' or a number of at least 0 is needed")
    return value


def per_surface(name: str, value: float | Tensor | str, auto: Tensor) -> Tensor:
    """Lam or mu as (N,): what was given, or what was found for "auto"."""
    if isinstance(value, str):
        return auto
    value = torch.as_tensor(value, dtype=auto.dtype, device=auto.device)
    if value.numel() not in (1, auto.numel()):
        raise ValueError(f"DLS: {name} {tuple(value.shape)} does not fit {auto.numel()} surfaces")
    return value.reshape(-1).expand(auto.shape)


def check_size(gradient: Tensor, patches: Patches) -> None:
    """ValueError if the field is smaller than a patch."""
    try:
        patches.grid(gradient.shape)
    except ValueError as error:
        raise ValueError(f"DLS: gradient {tuple(gradient.shape)}: {error}") from error


def check_dictionary(dictionary: Tensor, patches: Patches) -> None:
    """The initial dictionary must fit the patches and have no atom that is zero."""
    if not isinstance(dictionary, Tensor):
        raise TypeError(f"DLS: dictionary is a {type(dictionary).__name__}, a tensor is needed")
    if dictionary.ndim not in (2, 3) or dictionary.shape[-2] != patches.n_pixels or 0 in dictionary.shape:
        wanted = f"(n, K) or (N, n, K) with n = {patches.n_pixels}"
        raise ValueError(f"DLS: dictionary {tuple(dictionary.shape)} given, {wanted} is needed")
    norms = dictionary.detach().norm(dim=-2)
    if not bool((norms.isfinite() & (norms > 0)).all()):
        raise ValueError("DLS: dictionary has an atom that is zero or not finite")
