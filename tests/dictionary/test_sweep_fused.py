"""The compiled loops against the sweep by PyTorch alone, which other tests hold against NumPy."""

import math

import pytest
import torch

from tests.helpers import random_field
from torchdls import _compiled, backends, soup_dil_sweep
from torchdls.dictionary import sweep_fused
from torchdls.dictionary.soup_dil import residual_sweep

pytestmark = pytest.mark.skipif(not _compiled.installed(), reason="Numba is not installed (the extra `fast`)")
orders = pytest.mark.parametrize("order", ["atom", "block"])


def problem(N=2, n=6, K=19, L=40):
    """R, D and B with few codes, K above a group of the sweep and not a multiple of it."""
    P, D, B = (random_field(N, *shape, seed=k) for k, shape in enumerate([(n, L), (n, K), (K, L)]))
    D, B = D / D.norm(dim=1, keepdim=True), torch.where(B.abs() < 1.2, 0, B)
    return (P - D @ B).mT.contiguous().mT, D, B


def by_pytorch(monkeypatch, R, D, B, *args, **options):
    with monkeypatch.context() as alone:
        alone.setattr(_compiled, "installed", lambda: False)
        assert backends() == {"soup_dil_sweep": "torch", "SlopeDLS": "torch"}
        return residual_sweep(R.clone(), D, B.clone(), *args, **options)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("learn, shared", [(True, False), (True, True), (False, True), (False, False)])
@pytest.mark.parametrize("threshold, bound", [("hard", math.inf), ("hard", 0.5), ("soft", 0.7), ("firm", math.inf)])
@orders
def test_they_do_what_pytorch_does(order, threshold, bound, learn, shared, threads, monkeypatch):
    monkeypatch.setattr(sweep_fused, "_CHUNK", 7)  # several, and a rest
    R, D, B = problem()
    D, P, mu = D[:1] if shared else D, R + (D[:1] if shared else D) @ B, torch.linspace(0.3, 0.9, 19)
    options = {"unused": "keep", "learn": learn, "threshold": threshold}
    expected = by_pytorch(monkeypatch, R, D, B, mu, bound, order, **options)
    torch.set_num_threads(threads)
    try:
        found = residual_sweep(R.clone(), D, B.clone(), mu, bound, order, **options)
        fresh = soup_dil_sweep(P, D, B, mu, bound, order, **options)
    finally:
        torch.set_num_threads(1)
    assert 0.1 < float((found[2] != 0).double().mean()) < 0.9
    for one, other in zip((*found, *fresh), (*expected, *expected[1:]), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found[0] + found[1] @ found[2], P, rtol=1e-10, atol=1e-10)


@orders
def test_from_the_second_sweep_on_nothing_is_copied(order):
    R, D, B = residual_sweep(*problem(), 0.4, order=order)
    again = residual_sweep(R, D, B, 0.4, order=order)
    assert again[0].data_ptr() == R.data_ptr()
    assert again[2].data_ptr() == B.data_ptr()


@orders
def test_any_layout_and_parameters(order):
    R, D, B = problem()
    expected = soup_dil_sweep(R, D, B, 0.4, order=order)
    sliced = torch.zeros(2, 12, 80, dtype=R.dtype)[:, ::2, ::2].copy_(R)
    given = sliced, torch.nn.Parameter(D.mT.contiguous()).mT, B.mT.contiguous().mT.requires_grad_()
    with torch.no_grad():
        found = soup_dil_sweep(*given, 0.4, order=order)
    assert not any(x.requires_grad for x in found)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@orders
def test_what_is_recorded_is_left_to_pytorch(order, monkeypatch):
    R, D, B = problem()
    monkeypatch.setattr(sweep_fused, "_loops", lambda: pytest.fail("the loops leave no derivative"))
    assert soup_dil_sweep(R.requires_grad_(), D, B, 0.4, order=order)[1].requires_grad
    mu = torch.tensor(0.4, requires_grad=True)
    assert soup_dil_sweep(R.detach(), D, B, mu, order=order, threshold="soft")[1].requires_grad


def test_accuracy_in_float32_is_that_of_pytorch(monkeypatch):
    """Sums over 30,000 patches, against the same sweep in float64."""
    R, D, B = problem(1, 16, 24, 30000)
    mu, rough = torch.full((24,), 1.0), [x.float() for x in (R, D, B)]
    exact = by_pytorch(monkeypatch, *(x.double() for x in rough), mu, order="block")[1]
    errors = [
        float((D.double() - exact).abs().max())
        for D in (residual_sweep(*rough, mu, order="block")[1], by_pytorch(monkeypatch, *rough, mu, order="block")[1])
    ]
    assert errors[0] < max(2 * errors[1], 1e-6), errors
