"""Assertions about linear maps, derivatives and arguments."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

Map = Callable[[Tensor], Tensor]


def assert_adjoint(apply: Map, adjoint: Map, x: Tensor, y: Tensor, tol: float = 1e-12) -> None:
    """<A x, y> = <x, A^T y> for each surface of the batch, and A^T is what autograd finds for A, and A for A^T."""
    left, right = (apply(x) * y).flatten(1).sum(1), (x * adjoint(y)).flatten(1).sum(1)
    scale = apply(x).flatten(1).norm(dim=1) * y.flatten(1).norm(dim=1) + torch.finfo(x.dtype).tiny
    assert ((left - right).abs() <= tol * scale).all(), (left, right)
    for forward, backward, a, b in ((apply, adjoint, x, y), (adjoint, apply, y, x)):
        _, pullback = torch.func.vjp(forward, a)
        torch.testing.assert_close(pullback(b)[0], backward(b), rtol=tol, atol=tol * float(scale.max() + 1))


def assert_gradients(f: Callable[..., Tensor], *inputs: Tensor, second: bool = False, forward: bool = False) -> None:
    """Derivatives of f at float64 inputs equal finite differences: reverse mode, and forward and second on request."""
    inputs = tuple(x.detach().clone().requires_grad_(x.is_floating_point()) for x in inputs)
    assert gradcheck(f, inputs, check_forward_ad=forward, atol=1e-6, rtol=1e-4)
    if second:
        assert gradgradcheck(f, inputs, atol=1e-6, rtol=1e-4, fast_mode=True)


@contextmanager
def assert_unchanged(*tensors: Tensor | float | None) -> Iterator[None]:
    """The tensors hold the same values (NaN included), in the same memory, when the block ends."""
    given: Sequence[Tensor] = [t for t in tensors if isinstance(t, Tensor)]
    before = [(t.clone(), t.data_ptr(), t._version) for t in given]
    yield
    for t, (values, pointer, version) in zip(given, before, strict=True):
        torch.testing.assert_close(t, values, rtol=0, atol=0, equal_nan=True)
        assert (t.data_ptr(), t._version) == (pointer, version)
