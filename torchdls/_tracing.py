"""Whether an operation is being recorded, and so must not overwrite what it was given, nor look at its values."""

from __future__ import annotations

from math import isfinite

import torch
from torch import Tensor


def is_recorded(*tensors: Tensor) -> bool:
    """True where autograd, a function transform or a compiler follows what happens to one of the tensors.

    Where it is False nobody can tell results computed in place from fresh ones, and values may be looked at.
    """
    if torch.compiler.is_compiling() or torch.autograd.forward_ad._current_level >= 0:
        return True
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        return True
    return any(torch._C._functorch.is_functorch_wrapped_tensor(t) for t in tensors)


def in_plain_autograd(*tensors: Tensor) -> bool:
    """True where plain autograd alone, in reverse mode, follows one of the tensors."""
    transformed = any(torch._C._functorch.is_functorch_wrapped_tensor(t) for t in tensors)
    if transformed or torch.compiler.is_compiling() or torch.autograd.forward_ad._current_level >= 0:
        return False
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


def is_concrete(x: Tensor) -> bool:
    """Whether values can be looked at: not in a traced graph, nor inside vmap, however deep."""
    functorch = torch._C._functorch
    if torch.compiler.is_compiling():
        return False
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            return False
        x = functorch.get_unwrapped(x)
    return True


def holds_everywhere(condition: Tensor) -> bool:
    """Whether a condition holds everywhere; True where values cannot be seen."""
    return not is_concrete(condition) or bool(condition.all())


def seen_everywhere(condition: Tensor) -> bool:
    """Whether a condition is seen to hold everywhere; False where values cannot be seen."""
    return is_concrete(condition) and bool(condition.all())


def all_finite(field: Tensor) -> bool:
    """Whether every value is finite; one sum mostly tells, and only a sum that overflows needs the second look.

    True where values cannot be seen.
    """
    return not is_concrete(field) or isfinite(field.detach().sum().item()) or bool(field.isfinite().all())
