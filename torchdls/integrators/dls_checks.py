"""What DLS asks of its settings."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls.operators import Patches


def parameter(name: str, value: float | Tensor | str) -> float | Tensor | str:
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
