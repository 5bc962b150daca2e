"""Whether an operation is being recorded, and so must not overwrite what it was given, nor look at its values."""

from __future__ import annotations

from math import isfinite

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor
from torch.fx.experimental.proxy_tensor import get_proxy_mode


def is_recorded(*tensors: Tensor) -> bool:
    """True where autograd, a function transform or a compiler follows what happens to one of the tensors.

    So it is for tensors without values. Where it is False nobody can tell results computed in place from fresh ones,
    and values may be looked at.
    """
    if torch.compiler.is_compiling() or torch.autograd.forward_ad._current_level >= 0:
        return True
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        return True
    return any(torch._C._functorch.is_functorch_wrapped_tensor(t) or not has_values(t) for t in tensors)


def in_plain_autograd(*tensors: Tensor) -> bool:
    """True where plain autograd alone, in reverse mode, follows one of the tensors."""
    transformed = any(torch._C._functorch.is_functorch_wrapped_tensor(t) for t in tensors)
    if transformed or torch.compiler.is_compiling() or torch.autograd.forward_ad._current_level >= 0:
        return False
    return torch.is_grad_enabled() and any(t.requires_grad and has_values(t) for t in tensors)


def has_values(x: Tensor) -> bool:
    """Whether there are values at all: not on the meta device nor in a fake tensor, which plan shapes and memory."""
    return x.device.type != "meta" and not is_fake(x)


def is_fake(x: Tensor) -> bool:
    """Whether it is a fake tensor, however many function transforms are around it."""
    while torch._C._functorch.is_functorch_wrapped_tensor(x):
        x = torch._C._functorch.get_unwrapped(x)
    return isinstance(x, FakeTensor)


def only_shapes(x: Tensor) -> bool:
    """Whether only shapes are asked for: there are no values, and no graph is made that values will go through."""
    return not has_values(x) and not torch.compiler.is_compiling() and get_proxy_mode() is None


def is_concrete(x: Tensor) -> bool:
    """Whether values can be looked at: there are some, not in a traced graph, nor inside vmap, however deep."""
    functorch = torch._C._functorch
    if torch.compiler.is_compiling():
        return False
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            return False
        x = functorch.get_unwrapped(x)
    return has_values(x)


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
