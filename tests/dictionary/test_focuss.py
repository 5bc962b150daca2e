"""FOCUSS-CNDL: its codes against the plain iteration, its objective, and planted dictionaries."""

import numpy as np
import pytest
import torch

from tests.dictionary.test_learners import low_rank_atoms, planted, start, unit
from tests.helpers import random_field
from torchdls import Focuss

F64 = torch.float64


def plain(D, p, q, mu, steps):
    """The iteration as it is written, for one patch, without the cut."""
    b = D.T @ np.linalg.solve(D @ D.T + q * mu ** (2 - q) / 2 * np.eye(len(p)), p)
    history = [b]
    for _ in range(steps):
        Q = np.diag(np.abs(b) ** (2 - q))
        b = Q @ D.T @ np.linalg.solve(D @ Q @ D.T + q * mu ** (2 - q) / 2 * np.eye(len(p)), p)
        history.append(b)
    return history


@pytest.mark.parametrize("q", [0.5, 1.0])
def test_codes_are_those_of_the_plain_iteration_cut_at_mu(q):
    P, D = random_field(1, 6, 12), unit(random_field(1, 6, 9, seed=1))
    mu = 0.3
    R, _, B = Focuss(q, steps=4)(*start(P, D), mu, learn=False)
    kept = 0
    for j, p in enumerate(P[0].T.numpy()):
        b = plain(D[0].numpy(), p, q, mu, 4)[-1]
        b = np.where(np.abs(b) > mu, b, 0)
        cost = ((p - D[0].numpy() @ b) ** 2).sum() + mu**2 * (b != 0).sum()
        if cost < (p**2).sum():  # else the old codes, which are 0, stay
            np.testing.assert_allclose(B[0, :, j], b, atol=1e-9)
            kept += 1
    assert kept > 6
    torch.testing.assert_close(R, P - D @ B)


def test_each_step_lowers_the_objective_it_is_said_to_lower():
    D, q, mu = unit(random_field(6, 9, seed=1)).numpy(), 0.5, 0.4
    for p in random_field(10, 6, seed=2).numpy():
        costs = [((p - D @ b) ** 2).sum() + mu ** (2 - q) * (np.abs(b) ** q).sum() for b in plain(D, p, q, mu, 8)]
        assert (np.diff(costs) <= 1e-12).all()


def test_learned_atoms_come_nearer_to_planted_ones():
    atoms = low_rank_atoms(4, 4, 12, 5)
    P = planted(atoms, 300, 1, 40)
    R, D, B = start(P, unit(atoms + 0.15 * random_field(16, 12, seed=9))[None])
    near = (D[0] * atoms).sum(0).mean()
    for _ in range(30):
        R, D, B = Focuss()(R, D, B, 0.3)
    assert (D[0] * atoms).sum(0).mean() > 1 - 0.2 * (1 - near)


@pytest.mark.parametrize("options", [{"q": 0.0}, {"q": 1.5}, {"steps": 0}, {"bound": 0.0}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"Focuss: {next(iter(options))}="):
        Focuss(**options)
