"""Matching pursuit with atoms that nearly depend on each other, against the same in float64, one patch at a time."""

import pytest
import torch

from tests.helpers import assert_gradients, random_field
from torchdls import KSVD, orthogonal_matching_pursuit


def nearly_dependent(seed, gap=1e-5):
    """Atoms (1, 16, 5), the last two of which are `gap` apart, and patches (1, 16, 30)."""
    D = random_field(16, 5, seed=seed)
    D[:, 4] = D[:, 3] / D[:, 3].norm() + gap * random_field(16, seed=seed + 1)
    return (D / D.norm(dim=0))[None], random_field(1, 16, 30, seed=seed + 2)


def pursued(D, p, steps):
    """|r|^2 of one patch after so many steps, by least squares over the atoms taken."""
    taken: list[int] = []
    residual = p
    for _ in range(steps):
        size = (D.mT @ residual).abs()
        size[taken] = -1
        taken.append(int(size.argmax()))
        residual = p - D[:, taken] @ torch.linalg.lstsq(D[:, taken], p[:, None]).solution[:, 0]
    return float(residual.square().sum())


@pytest.mark.parametrize("seed", range(0, 40, 4))
@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-5])
def test_each_step_lowers_the_residual(seed, gap):
    """In float32: never above the step before, and at the end what the atoms that do not depend on others leave."""
    D, P = nearly_dependent(seed, gap)
    single = D.float(), P.float()
    before = P.square().sum(1) * (1 + 1e-6)
    for steps in range(1, 6):
        B = orthogonal_matching_pursuit(single[1], single[0], steps)
        left = (P - D @ B.double()).square().sum(1)
        assert (left <= before * (1 + 1e-6)).all()
        before = left
    expected = torch.tensor([pursued(D[0, :, :4], p, 4) for p in P[0].mT], dtype=torch.float64)
    assert (before[0] <= expected * (1 + 1e-5)).all()
    assert (B.abs() < 100).all()  # two atoms do not cancel each other


def test_another_atom_takes_the_place_of_one_that_is_dropped():
    """Of the two atoms asked for, the second is a third one, as the twin of the first says nothing new."""
    D = torch.eye(3)[:, [0, 0, 1]][None]
    B = orthogonal_matching_pursuit(torch.tensor([[[1.0], [0.5], [0.2]]]), D, 2)[0, :, 0]
    assert B[2] == 0.5
    assert B[:2].sum() == 1.0
    assert (B != 0).sum() == 2


def test_derivative_beside_a_twin():
    D, P = random_field(1, 4, 3, seed=5), random_field(1, 4, 4, seed=6)
    D = D / D.norm(dim=1, keepdim=True)
    D = torch.cat([D, D[..., :1]], -1)
    assert_gradients(lambda p: orthogonal_matching_pursuit(p, D), P)


def test_k_svd_learns_from_twins():
    D, P = nearly_dependent(1)
    R, D, B = KSVD()(P.float(), D.float(), torch.zeros(1, 5, 30), mu=0.1)
    assert R.isfinite().all()
    cost = R.square().sum() + 0.01 * (B != 0).sum()
    assert cost <= P.square().sum()
    torch.testing.assert_close(P.float() - D @ B, R, rtol=0, atol=1e-4)
