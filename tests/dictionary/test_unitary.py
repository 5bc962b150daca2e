"""The orthonormal dictionary: each step against brute force, and the descent of both."""

import math

import pytest
import torch

from torchdls.dictionary.polar import polar_factor
from torchdls.dictionary.unitary import Unitary


def cost(P, D, B, mu):
    return (P - D @ B).square().sum((1, 2)) + mu**2 * B.count_nonzero((1, 2))


def test_the_dictionary_is_the_best_rotation_or_reflection(generator):
    P = torch.randn(1, 2, 30, generator=generator, dtype=torch.float64)
    start = torch.eye(2, dtype=torch.float64)[None]
    R, D, B = Unitary()(P.clone(), start, torch.zeros(1, 2, 30, dtype=torch.float64), 0.5)
    assert torch.equal(B, torch.where(P.abs() > 0.5, P, 0))  # codes of the dictionary that came in
    angle = torch.linspace(0, 2 * math.pi, 20001, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    turns = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    every = torch.cat([turns, turns * torch.tensor([1.0, -1.0], dtype=torch.float64)])
    least = (P - every @ B).square().sum((1, 2)).min()
    assert R.square().sum() <= least * (1 + 1e-12)
    torch.testing.assert_close(R.square().sum(), least, rtol=1e-5, atol=0)  # as fine as the grid of angles
    torch.testing.assert_close(R, P - D @ B)


def test_descends_and_stays_orthonormal(generator):
    P = torch.randn(2, 9, 50, generator=generator, dtype=torch.float64)
    D = torch.linalg.qr(torch.randn(2, 9, 9, generator=generator, dtype=torch.float64)).Q
    R, B, mu = P.clone(), torch.zeros(2, 9, 50, dtype=torch.float64), 0.7
    last = cost(P, D, B, mu)
    for _ in range(8):
        R, D, B = Unitary()(R, D, B, mu)
        now = cost(P, D, B, mu)
        assert (now <= last * (1 + 1e-12)).all()
        last = now
    torch.testing.assert_close(D.mT @ D, torch.eye(9, dtype=torch.float64).expand(2, -1, -1))


def test_one_dictionary_for_a_batch_is_that_of_all_patches_together(generator):
    P = torch.randn(3, 4, 20, generator=generator, dtype=torch.float64)
    D, B = torch.eye(4, dtype=torch.float64)[None], torch.zeros(3, 4, 20, dtype=torch.float64)
    _, shared, _ = Unitary()(P.clone(), D, B, 0.5)
    side_by_side = P.transpose(0, 1).flatten(1)[None]
    _, alone, _ = Unitary()(side_by_side.clone(), D, torch.zeros_like(side_by_side), 0.5)
    torch.testing.assert_close(shared, alone)


def test_no_codes_keep_the_dictionary(generator):
    P = torch.randn(1, 4, 20, generator=generator, dtype=torch.float64)
    D = torch.linalg.qr(torch.randn(1, 4, 4, generator=generator, dtype=torch.float64)).Q
    _, kept, B = Unitary()(P.clone(), D, torch.zeros(1, 4, 20, dtype=torch.float64), 1e3)
    assert not B.any()
    assert torch.equal(kept, D)


def test_needs_a_square_dictionary():
    P = torch.ones(1, 4, 5)
    with pytest.raises(ValueError, match=r"Unitary: dictionary \(1, 4, 6\)"):
        Unitary()(P, torch.ones(1, 4, 6), torch.zeros(1, 6, 5), 0.1)


def with_singular_values(generator, *values):
    n = len(values)
    u, v = (torch.linalg.qr(torch.randn(2, n, n, generator=generator, dtype=torch.float64)).Q for _ in range(2))
    return (u * torch.tensor(values, dtype=torch.float64)) @ v.mT


# Of the SVD alone the derivative is NaN at the first three.
@pytest.mark.parametrize("values", [(2, 2, 2), (3, 3, 1), (2, 1, 1), (3, 2, 1)], ids=str)
def test_derivatives_at_equal_singular_values(generator, values):
    M = with_singular_values(generator, *values).requires_grad_()
    assert torch.autograd.gradcheck(polar_factor, M, check_forward_ad=True, check_batched_grad=True)
    assert torch.autograd.gradgradcheck(polar_factor, M, check_fwd_over_rev=True)
    torch.testing.assert_close(polar_factor(M) @ polar_factor(M).mT, torch.eye(3).double().expand(2, -1, -1))


def test_what_singular_values_of_0_leave_open_does_not_move(generator):
    M = with_singular_values(generator, 2, 1, 0, 0).requires_grad_()
    (slope,) = torch.autograd.grad(polar_factor(M)[:, 0].sum(), M)
    assert bool(slope.isfinite().all())
    assert float(slope.abs().max()) < 10


def test_the_learner_has_a_derivative_where_the_codes_are_alike():
    """Patches that are each an atom: P B^T is a multiple of the identity."""
    P = torch.eye(4, dtype=torch.float64)[None].repeat(1, 1, 3).requires_grad_()
    D, B = torch.eye(4, dtype=torch.float64)[None], torch.zeros(1, 4, 12, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda P: Unitary()(P, D, B, 0.5)[1], P)
