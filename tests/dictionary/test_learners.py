"""The dictionary learners: descent, planted dictionaries, K-SVD's pursuit against scikit-learn's, and each in DLS."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchdls
from tests.helpers import DISK, assert_gradients, assert_unchanged, random_field, seeded
from torchdls import (
    DLS,
    KSVD,
    LEARNERS,
    SURFACES,
    DinoKat,
    FixedDictionary,
    Focuss,
    SoupDIL,
    orthogonal_matching_pursuit,
)
from torchdls.dictionary.polar import nearest_of_rank

F64 = torch.float64


def unit(d):
    return d / d.norm(dim=-2, keepdim=True)


def low_rank_atoms(rows, columns, count, seed):
    left, right = random_field(rows, count, seed=seed), random_field(columns, count, seed=seed + 1)
    return unit(torch.einsum("ik,jk->ijk", left, right).flatten(0, 1))


def planted(atoms, L, nonzeros, snr_db, seed=0):
    """Patches (1, n, L) of a few atoms each, with codes of size 1 to 2 and noise."""
    K = atoms.shape[1]
    support = torch.rand(K, L, generator=seeded(seed)).argsort(0) < nonzeros
    size = 1 + torch.rand(K, L, generator=seeded(seed + 1), dtype=F64)
    clean = atoms @ (support * size * random_field(K, L, seed=seed + 2).sign())
    noise = random_field(*clean.shape, seed=seed + 3)
    return (clean + noise * clean.norm() / noise.norm() * 10 ** (-snr_db / 20))[None]


def recovered(D, atoms):
    """Part of the planted atoms that D holds, up to the sign: |<d, atom>| > .99."""
    return ((D[0].mT @ atoms).abs().amax(0) > 0.99).double().mean().item()


def cost(R, B, mu):
    return R.square().sum((1, 2)) + mu**2 * (B != 0).sum((1, 2))


def start(P, D) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return P.clone(), D.clone(), P.new_zeros(len(P), D.shape[-1], P.shape[-1])


# ---- orthogonal matching pursuit


@pytest.mark.parametrize("n_nonzero", [1, 3, 7])
def test_pursuit_equals_scikit_learn(n_nonzero):
    from sklearn.linear_model import orthogonal_mp

    D, P = unit(random_field(16, 32, seed=1)), random_field(16, 60, seed=2)
    ours = orthogonal_matching_pursuit(P[None], D[None], n_nonzero)[0]
    theirs = orthogonal_mp(D.numpy(), P.numpy(), n_nonzero_coefs=n_nonzero)
    np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_pursuit_to_a_residual_equals_scikit_learn():
    from sklearn.linear_model import orthogonal_mp

    D, P = unit(random_field(16, 32, seed=3)), random_field(16, 40, seed=4)
    ours = orthogonal_matching_pursuit(P[None], D[None], tol=2.0)[0]
    theirs = np.stack([orthogonal_mp(D.numpy(), p, tol=2.0) for p in P.mT.numpy()], 1)
    np.testing.assert_allclose(ours, theirs, atol=1e-10)
    assert len(set((ours != 0).sum(0).tolist())) > 2  # patches stop at different times


def test_pursuit_stops_at_the_threshold_and_lowers_the_cost_at_every_atom():
    D, P = unit(random_field(1, 16, 32, seed=5)), random_field(1, 16, 50, seed=6)
    before = torch.full((1,), torch.inf, dtype=F64)
    for n in range(1, 12):
        B = orthogonal_matching_pursuit(P, D, n, mu=0.6)
        now = cost(P - D @ B, B, 0.6)
        assert now <= before + 1e-9
        before = now
    assert (D.mT @ (P - D @ orthogonal_matching_pursuit(P, D, mu=0.6))).abs().max() <= 0.6
    assert (orthogonal_matching_pursuit(P, D, mu=torch.tensor([[np.inf]])) == 0).all()


def test_pursuit_batches_and_derivatives():
    D, P = unit(random_field(2, 9, 12, seed=7)), random_field(2, 9, 5, seed=8)
    both = orthogonal_matching_pursuit(P, D, 3)
    torch.testing.assert_close(both[1:], orthogonal_matching_pursuit(P[1:], D[1:], 3))
    assert_gradients(lambda p, d: orthogonal_matching_pursuit(p, d, 2), P[:1, :4, :3], unit(D[:1, :4, :5]))
    exact = orthogonal_matching_pursuit(P, torch.eye(9, dtype=F64)[None])  # every atom is taken
    torch.testing.assert_close(exact, P)
    assert (orthogonal_matching_pursuit(0 * P, D) == 0).all()
    with pytest.raises(ValueError, match="do not fit"):
        orthogonal_matching_pursuit(P, D[:, :4])
    with pytest.raises(ValueError, match="n_nonzero: 0"):
        orthogonal_matching_pursuit(P, D, 0)


# ---- the interface


ALL = [SoupDIL(), SoupDIL("block", "keep"), KSVD(), KSVD(n_nonzero=3, steps=3), FixedDictionary(), DinoKat(),
       DinoKat(2, (3, 4), "block"), Focuss(), Focuss(1.0, 2)]  # fmt: skip


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("learner", ALL, ids=repr)
@pytest.mark.parametrize("shared", [False, True])
def test_no_pass_raises_the_cost(learner, shared):
    learner = replace(learner, bound=2.5)
    square = isinstance(learner, DinoKat) and learner.patch_size is None
    P = random_field(2, 9 if square else 12, 80)
    atoms = low_rank_atoms(3, 3 if square else 4, 14, 2)[None]
    D = atoms.expand(1 if shared else 2, -1, -1)
    R, D, B = start(P, D)
    mu = torch.tensor([[0.8], [1.1]], dtype=F64)
    before = cost(R, B, mu[:, 0])
    for _ in range(6):
        R, D, B = learner(R, D, B, mu)
        now = cost(R, B, mu[:, 0])
        assert now.sum() <= before.sum() + 1e-9
        assert shared or (now <= before + 1e-9).all()
        before = now
        torch.testing.assert_close(R, P - D @ B)
        torch.testing.assert_close(D.norm(dim=1), torch.ones_like(D[:, 0]))
        assert B.abs().max() <= 2.5 + 1e-12
    assert (B != 0).any()
    if not shared:
        alone = start(P[1:], atoms)
        for _ in range(6):
            alone = learner(*alone, mu[1:])
        torch.testing.assert_close(alone[2], B[1:], atol=1e-8, rtol=1e-8)


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("learner", [*ALL[:5], Focuss()], ids=repr)
def test_learn_false_keeps_the_dictionary(learner):
    P, D = random_field(1, 9, 30), unit(random_field(1, 9, 12, seed=2))
    with assert_unchanged(D):
        R, kept, B = learner(*start(P, D), 0.7, learn=False)
    assert torch.equal(kept, D)
    torch.testing.assert_close(R, P - D @ B)


@pytest.mark.parametrize("learner", [SoupDIL(), KSVD(), KSVD(n_nonzero=2), DinoKat(), DinoKat(2), Focuss()], ids=repr)
def test_derivatives_of_a_pass(learner):
    P, D = random_field(1, 4, 6), low_rank_atoms(2, 2, 3, 2)[None]

    def run(p, d):
        return torch.cat([t.flatten() for t in learner(*learner(p.clone(), d, p.new_zeros(1, 3, 6), 0.7), 0.7)])

    assert_gradients(run, P, D)


def test_low_rank_atoms_are_the_best_ones():
    P, D = random_field(1, 12, 50), unit(random_field(1, 12, 1, seed=2))
    R, found, B = DinoKat(1, (3, 4))(*start(P, D), 0.5)
    h = (R + found @ B) @ B.mT
    u, _, v = torch.linalg.svd(h[0, :, 0].view(3, 4))
    best = torch.outer(u[:, 0], v[0]).flatten()
    torch.testing.assert_close(found[0, :, 0], best * torch.sign(best @ found[0, :, 0]))
    with pytest.raises(ValueError, match="12 pixels"):
        DinoKat()(*start(P, D), 0.5)
    with pytest.raises(ValueError, match="rank=0"):
        DinoKat(0)


def test_exact_ksvd_atom_is_the_leading_singular_vector():
    P, D = random_field(1, 9, 30), unit(random_field(1, 9, 1, seed=3))
    _, found, B = KSVD(steps=500)(*start(P, D), 0.5)
    users = B[0, 0] != 0
    u, s, v = torch.linalg.svd(P[0][:, users], full_matrices=False)
    torch.testing.assert_close((found[0] @ B[0])[:, users], s[0] * torch.outer(u[:, 0], v[0]))


def test_unused_atoms_of_ksvd_become_the_worst_patches():
    P = random_field(1, 9, 30)
    _, D, B = KSVD()(*start(P, unit(random_field(1, 9, 4))), 100.0)
    assert not B.any()
    worst = P[0][:, P[0].norm(dim=0).argsort(descending=True)[:4]]
    torch.testing.assert_close(D[0], unit(worst))


def test_ksvd_to_a_residual():
    """Codes are those of the pursuit; later passes meet the target with fewer atoms."""
    P, D, tol = random_field(1, 9, 200), unit(random_field(1, 9, 14, seed=2)), 1.5
    _, _, B = KSVD(tol=tol)(*start(P, D), 0.0, learn=False)
    torch.testing.assert_close(B, orthogonal_matching_pursuit(P, D, tol=tol))
    step, used = start(P, D), []
    for _ in range(8):
        R, D, B = step = KSVD(tol=tol)(*step, 0.0)
        torch.testing.assert_close(R, P - D @ B)
        used.append(int((B != 0).sum()))
    assert used[-1] < 0.95 * used[0]
    R, _, B = KSVD(tol=tol)(*step, 0.0, learn=False)
    assert (R.square().sum(1) <= tol + 1e-9).all()
    assert B.any(1).float().mean() > 0.5
    with pytest.raises(ValueError, match="KSVD: tol=-1"):
        KSVD(tol=-1.0)


# ---- planted dictionaries


def rates(learner, mu, passes):
    """Recovery of 16 low-rank atoms at 0, 10 and 30 dB, from 1000 patches of two atoms, the first of them to start."""
    atoms, found = low_rank_atoms(5, 5, 16, 5), []
    for snr in (0, 10, 30):
        P = planted(atoms, 1000, 2, snr)
        R, D, B = start(P, unit(P[..., :16]))
        if isinstance(learner, DinoKat):
            D = unit(torch.cat([learner.project(d) for d in D.split(1, -1)], -1))
        for _ in range(passes):
            R, D, B = learner(R, D, B, mu)
        found.append(recovered(D, atoms))
    return found


def test_planted_dictionary_is_recovered_the_better_the_less_noise():
    soup, ksvd, dino = rates(SoupDIL(), 0.7, 30), rates(KSVD(n_nonzero=2), 0.3, 20), rates(DinoKat(), 0.7, 20)
    for at_0, at_10, at_30 in (soup, ksvd, dino):
        assert at_0 < 0.2
        assert at_10 >= 0.45
        assert at_30 >= 0.65  # the rest are local minima: chance finds 0 of 16
    assert dino[1] > soup[1]  # knowing that the atoms have low rank helps against noise


# ---- in DLS


@pytest.mark.parametrize("learner", [*LEARNERS, KSVD(steps=2), DinoKat(2)], ids=str)
def test_every_learner_serves_dls(learner):
    surface = SURFACES["tent"](40, dtype=F64)
    noisy = torchdls.add_noise(surface.gradient, 10, seeded(0))
    plain = torchdls.mean_angular_error(torchdls.LeastSquares()(noisy), surface.gradient)
    result = DLS(learner=learner, n_iter=8, mu=1.5 * torchdls.noise_level(noisy)).solve(noisy)
    assert (result.objective.diff(dim=1) <= 1e-9 * result.objective[:, :1]).all()
    assert torchdls.mean_angular_error(result.height, surface.gradient) < 0.8 * plain
    mask = DISK(40, 40)
    masked = DLS(learner=learner, n_iter=4).solve(torch.where(mask, noisy, torch.nan), mask)
    assert (masked.objective.diff(dim=1) <= 1e-9 * masked.objective[:, :1]).all()
    assert masked.height.isfinite().all()


def test_dls_defaults_and_errors():
    noisy = torchdls.add_noise(SURFACES["tent"](24).gradient, 10, seeded(0))
    assert torch.equal(DLS(n_iter=3)(noisy), DLS(n_iter=3, learner="soup_dil")(noisy))
    assert torch.equal(DLS(n_iter=3, learn="fixed")(noisy), DLS(n_iter=3, learner="fixed")(noisy))
    with pytest.raises(ValueError, match="learner='mod' is unknown"):
        DLS(learner="mod")
    with pytest.raises(TypeError, match="learner is a int"):
        DLS(learner=3)
    with pytest.raises(ValueError, match="KSVD: steps=0"):
        KSVD(steps=0)
    with pytest.raises(ValueError, match="KSVD: n_nonzero=-1"):
        KSVD(n_nonzero=-1)


@pytest.mark.parametrize(
    "values, rank", [((3, 3, 1, 1), 2), ((3, 1, 1), 1), ((2, 2, 0), 2), ((5, 3, 2), 3), ((2, 2, 1, 1), 3)]
)
@pytest.mark.parametrize("shape", [(4, 4), (5, 4), (4, 6)], ids=str)
def test_derivative_of_the_nearest_matrix_of_low_rank(values, rank, shape, generator):
    """Also where singular values are equal, which the derivative through the SVD divides by the difference of."""
    u, v = (torch.linalg.qr(torch.randn(n, 4, generator=generator, dtype=torch.float64)).Q for n in shape)
    s = torch.tensor([*values, *[0] * (4 - len(values))], dtype=torch.float64)
    M = ((u * s) @ v.mT)[None].requires_grad_()
    if s[rank - 1] > s[rank]:
        assert torch.autograd.gradcheck(lambda M: nearest_of_rank(M, rank), M)
        assert torch.autograd.gradcheck(lambda M: nearest_of_rank(M, rank), M, check_forward_ad=True)
        torch.testing.assert_close(nearest_of_rank(M, rank)[0], (u[:, :rank] * s[:rank]) @ v.mT[:rank])
    else:  # there are several nearest ones
        (pull,) = torch.autograd.grad(nearest_of_rank(M, rank).square().sum(), M)
        assert bool(pull.isfinite().all())
        torch.testing.assert_close((M - nearest_of_rank(M, rank)).square().sum(), s[rank:].square().sum())


def test_second_derivative_of_the_nearest_matrix_of_low_rank(generator):
    M = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda M: nearest_of_rank(M, 2), M)
    by_hand = torch.func.vmap(torch.func.grad(lambda M: (nearest_of_rank(M, 1) * M.detach()).sum()))(M.detach())
    (pull,) = torch.autograd.grad((nearest_of_rank(M, 1) * M.detach()).sum(), M)
    torch.testing.assert_close(by_hand, pull)


def test_atoms_of_equal_singular_values_have_a_derivative():
    """Two of three are equal: kept together, and where one would have to be chosen."""
    h = torch.eye(3, dtype=torch.float64)
    h[2, 2] = 0.5
    h = h.reshape(1, 9, 1).requires_grad_()
    assert torch.autograd.gradcheck(DinoKat(2).project, h)
    (pull,) = torch.autograd.grad(DinoKat(1).project(h).sum(), h)
    assert bool(pull.isfinite().all())
