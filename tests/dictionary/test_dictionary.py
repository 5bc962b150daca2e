"""The SOUP-DIL sweep against plain NumPy written from the paper, and the initial dictionaries."""

import math

import numpy as np
import pytest
import scipy.fft
import torch

from tests.helpers import assert_gradients, assert_unchanged, random_field, soup_dil
from torchdls import SURFACES, LeastSquares, Patches, dct_dictionary, soup_dil_sweep
from torchdls.dictionary.thresholds import penalty, shrink


def problem(N=2, n=6, K=9, L=40, sparsity=0.3, seed=0):
    """Patches, unit-norm atoms and sparse codes; K above a group of the sweep and not a multiple of it."""
    P, D = random_field(N, n, L, seed=seed), random_field(N, n, K, seed=seed + 1)
    B = random_field(N, K, L, seed=seed + 2)
    return P, D / D.norm(dim=1, keepdim=True), torch.where(B.abs() < 1.5 - sparsity, 0, B)


def objective(P, D, B, mu):
    """||P - D B||^2 + sum of mu^2 over the nonzero codes, for all surfaces together."""
    mu = torch.as_tensor(mu, dtype=P.dtype)
    level = mu if mu.ndim == 0 else mu[..., None] if mu.ndim == 2 else mu[:, None]
    return float((P - D @ B).square().sum() + (level.square() * (B != 0)).sum())


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("K", [1, 5, 8, 17])
@pytest.mark.parametrize("unused", ["first", "keep"])
@pytest.mark.parametrize("bound", [math.inf, 1.2])
@pytest.mark.parametrize("order", ["atom", "block"])
def test_sweep_is_the_papers(order, bound, unused, K):
    P, D, B = problem(K=K)
    mu = torch.linspace(0.2, 1.1, K, dtype=P.dtype)
    if K > 1:
        mu[-1] = 100.0  # no patch is worth a code of the last atom
    for _ in range(3):
        D_new, B_new = soup_dil_sweep(P, D, B, mu, bound, order, unused=unused)
        for i in range(len(P)):
            expected = soup_dil(P[i].numpy(), D[i].numpy(), B[i].numpy(), mu.numpy(), bound, order, unused)
            np.testing.assert_allclose(D_new[i].numpy(), expected[0], atol=1e-9)
            np.testing.assert_allclose(B_new[i].numpy(), expected[1], atol=1e-9)
        D, B = D_new, B_new
    if K > 1:
        assert (B[:, -1] == 0).all(), "the case of an unused atom occurs"


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("dtype, atol", [(torch.float32, 1e-4), (torch.float64, 1e-9)], ids=str)
@pytest.mark.parametrize("order", ["atom", "block"])
def test_sparse_batches_are_the_papers(order, dtype, atol):
    """Few patches use an atom, and on the second surface none does: then only those that do are looked at."""
    P, D, B = problem(N=3, L=300)
    P[1] *= 0.01
    B[1] = 0
    mu = np.full(9, 2.2)
    D_new, B_new = soup_dil_sweep(P.to(dtype), D.to(dtype), B.to(dtype), 2.2, order=order)
    assert 0.01 < float((B_new != 0).double().mean()) < 0.2
    assert (B_new[1] == 0).all()
    for i in range(3):
        expected = soup_dil(P[i].numpy(), D[i].numpy(), B[i].numpy(), mu, order=order)
        np.testing.assert_allclose(D_new[i].numpy(), expected[0], atol=atol)
        np.testing.assert_allclose(B_new[i].numpy(), expected[1], atol=10 * atol)


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("surface", ["tent", "peaks"])
@pytest.mark.parametrize("order", ["atom", "block"])
def test_float32_is_accurate_on_patches_of_surfaces(order, surface):
    """Atoms agree with float64 as long as the same codes pass the threshold; the few that flip move some atoms more."""
    gradient = SURFACES[surface](128, dtype=torch.float64).gradient
    P = Patches().extract(LeastSquares()(gradient + 0.1 * random_field(*gradient.shape)))
    D, B = dct_dictionary(8, 64)[None].double(), torch.zeros(1, 64, P.shape[-1], dtype=P.dtype)
    D, B = soup_dil_sweep(P, D, B, 0.3, order=order)
    exact, rounded = (
        soup_dil_sweep(P.to(t), D.to(t), B.to(t), 0.3, order=order) for t in (torch.float64, torch.float32)
    )
    flips = ((exact[1] != 0) != (rounded[1] != 0)).sum()
    errors = (exact[0] - rounded[0]).norm(dim=1)
    assert flips <= 3
    assert errors.median() < 2e-5
    assert flips > 0 or errors.max() < 1e-4
    assert objective(P, rounded[0].double(), rounded[1].double(), 0.3) == pytest.approx(objective(P, *exact, 0.3), 1e-6)


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("order", ["atom", "block"])
def test_fixed_dictionary_updates_the_codes_alone(order):
    P, D, B = problem()
    for atoms in (D, D[:1]):
        D_new, B_new = soup_dil_sweep(P, atoms, B, 0.7, 1.5, order, learn=False)
        assert torch.equal(D_new, atoms)
        for i in range(2):
            mu = np.full(D.shape[-1], 0.7)
            own = atoms[min(i, len(atoms) - 1)].numpy()
            expected = soup_dil(P[i].numpy(), own, B[i].numpy(), mu, 1.5, learn=False)
            np.testing.assert_allclose(B_new[i].numpy(), expected[1], atol=1e-10)


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("order", ["atom", "block"])
@pytest.mark.parametrize("per", ["number", "surface", "atom", "both"])
def test_shared_dictionary_learns_from_all_patches(order, per):
    P, D, B = problem(N=3)
    levels = random_field(3, 9, seed=8).abs()
    mu = {"number": 0.6, "surface": levels[:, :1], "atom": levels[:1], "both": levels}[per]
    D_new, B_new = soup_dil_sweep(P, D[:1], B, mu, order=order)
    assert D_new.shape == (1, 6, 9)
    full = torch.as_tensor(mu, dtype=P.dtype).expand(3, 9)
    # In NumPy: all patches side by side, and a threshold for each code.
    side, codes = (torch.cat(list(t), -1).numpy() for t in (P, B))
    matrix = torch.cat([m[:, None].expand(9, 40) for m in full], -1).numpy()
    expected = soup_dil(side, D[0].numpy(), codes, matrix, order=order)
    np.testing.assert_allclose(D_new[0].numpy(), expected[0], atol=1e-9)
    np.testing.assert_allclose(torch.cat(list(B_new), -1).numpy(), expected[1], atol=1e-9)


@pytest.mark.usefixtures("sweep_by")
def test_thresholds_of_every_shape():
    P, D, B = problem(N=2)
    number = soup_dil_sweep(P, D, B, 0.8)[1]
    for shape in [(), (1,), (9,), (1, 9), (2, 1), (2, 9), (1, 1)]:
        torch.testing.assert_close(soup_dil_sweep(P, D, B, torch.full(shape, 0.8, dtype=P.dtype))[1], number)
    each = torch.tensor([[0.3], [1.5]], dtype=P.dtype)
    both = soup_dil_sweep(P, D, B, each)[1]
    for i in range(2):
        torch.testing.assert_close(
            both[i : i + 1], soup_dil_sweep(P[i : i + 1], D[i : i + 1], B[i : i + 1], each[i])[1]
        )


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("bound", [math.inf, 2.0, 0.4])
@pytest.mark.parametrize("order", ["atom", "block"])
def test_objective_never_rises(order, bound, shared, learn):
    """For every mix of options, also with a bound below mu, from codes that satisfy it."""
    mu = 0.9
    P, D, B = problem(N=3, sparsity=0.0)
    D, B = (D[:1] if shared else D), B.clamp(-bound, bound)
    last = objective(P, D, B, mu)
    first = last
    for _ in range(6):
        D, B = soup_dil_sweep(P, D, B, mu, bound, order, learn=learn)
        now = objective(P, D, B, mu)
        assert now <= last * (1 + 1e-12)
        assert B.abs().max() <= bound
        torch.testing.assert_close(D.norm(dim=1), torch.ones_like(D[:, 0]))
        last = now
    assert last < 0.95 * first


def test_hard_threshold_by_brute_force():
    """Against the better of 0 and the best nonzero code in the bounds; at |x| = mu the code is 0."""
    x = torch.linspace(-4, 4, 801, dtype=torch.float64)
    for mu, bound in [(1.0, math.inf), (1.0, 1.5), (1.0, 0.4), (2.0, 1.9), (0.0, 1.0), (3.0, 0.1)]:
        inside = x.clamp(-bound, bound)
        costs = torch.stack([x.square(), (inside - x).square() + mu**2])
        b = shrink(x, torch.tensor(mu, dtype=x.dtype), bound)
        cost = (b - x).square() + penalty(b, torch.tensor(mu, dtype=x.dtype))
        torch.testing.assert_close(cost, costs.amin(0))
        assert b.abs().max() <= bound
    level = torch.tensor(1.0)
    edge = torch.tensor([1.0, -1.0, 1.0 + 1e-6, -1.0 - 1e-6])
    assert (shrink(edge, level) != 0).tolist() == [False, False, True, True]


@pytest.mark.usefixtures("sweep_by")
def test_float32_keeps_up_with_float64():
    """Large patches, small details: nothing cancels."""
    P, D, B = problem(n=16, K=24, L=500)
    P = P + 1e3 * D[..., :1]
    for order in ("atom", "block"):
        exact = soup_dil_sweep(P, D, B, 0.5, order=order)
        rough = soup_dil_sweep(P.float(), D.float(), B.float(), 0.5, order=order)
        assert rough[0].dtype == rough[1].dtype == torch.float32
        # A code within rounding of mu may fall on either side and take its atom along, but neither costs more.
        costs = [(P - d.double() @ b.double()).square().sum() + 0.25 * b.count_nonzero() for d, b in (exact, rough)]
        torch.testing.assert_close(costs[1], costs[0], rtol=1e-3, atol=0)


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("order", ["atom", "block"])
def test_the_layout_of_the_patches_makes_no_difference(order):
    """`unfold` puts the pixels of a patch far apart; the sweep works on a residual that has them side by side."""
    height = LeastSquares()(SURFACES["peaks"](40).gradient)
    apart = torch.nn.functional.unfold(height, 8, stride=2)
    together = Patches(8, 2).extract(height)
    assert torch.equal(apart, together)
    assert apart.stride() != together.stride()
    D, B = dct_dictionary(8)[None], torch.zeros(1, 64, apart.shape[-1])
    for one, other in zip(*(soup_dil_sweep(P, D, B, 0.1, order=order) for P in (apart, together)), strict=True):
        assert torch.equal(one, other)


@pytest.mark.usefixtures("sweep_by")
def test_arguments_are_left_alone():
    P, D, B = problem()
    mu = torch.full((9,), 0.5, dtype=P.dtype)
    with assert_unchanged(P, D, B, mu):
        for order in ("atom", "block"):
            soup_dil_sweep(P, D, B, mu, 1.0, order)
            soup_dil_sweep(P, D[:1], B, mu, 1.0, order)
            soup_dil_sweep(P, D, B, mu, 1.0, order, learn=False)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("order", ["atom", "block"])
def test_derivatives_with_the_support_frozen(order, shared):
    P, D, B = problem(n=4, K=3, L=5)
    mu = 0.4

    def sweep(P, D, B):
        return torch.cat([t.flatten() for t in soup_dil_sweep(P, D, B, mu, order=order)])

    assert_gradients(sweep, P, D[:1] if shared else D, B)


def test_derivative_at_an_unused_atom_is_finite():
    P, D, B = (t.requires_grad_() for t in problem())
    for order in ("atom", "block"):
        for unused in ("first", "keep"):
            D_new, B_new = soup_dil_sweep(P, D, torch.zeros_like(B), 1e3, order=order, unused=unused)
            assert (B_new == 0).all()
            grads = torch.autograd.grad(D_new.sum() + B_new.sum(), (P, D), allow_unused=True)
            assert all(g is None or g.isfinite().all() for g in grads)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"order": "row"}, "order: 'row' is unknown; choose 'atom' or 'block'"),
        ({"unused": "random"}, "unused: 'random' is unknown"),
        ({"D": torch.ones(2, 5, 9)}, r"D \(2, 5, 9\) .* do not fit"),
        ({"D": torch.ones(3, 6, 9)}, r"D \(3, 6, 9\)"),
        ({"B": torch.zeros(2, 9, 39)}, r"B \(2, 9, 39\)"),
        ({"P": torch.zeros(6, 40)}, r"P \(6, 40\)"),
        ({"mu": -0.1}, "mu"),
        ({"mu": float("nan")}, "mu"),
        ({"mu": torch.ones(4)}, r"mu: \(4,\) given"),
        ({"mu": torch.ones(3, 9)}, r"mu: \(3, 9\) given"),
        ({"mu": torch.ones(2, 9, 1)}, r"mu: \(2, 9, 1\) given"),
        ({"bound": 0.0}, "bound"),
        ({"bound": -1.0}, "bound"),
        ({"bound": float("nan")}, "bound"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    P, D, B = (t.float() for t in problem())
    with pytest.raises(ValueError, match=message):
        soup_dil_sweep(**{"P": P, "D": D, "B": B, "mu": 0.5} | arguments)


@pytest.mark.parametrize("size", [1, 2, 3, 8, (2, 5), (1, 7), (6, 4)], ids=str)
def test_square_dictionary_is_the_dct(size):
    p, q = (size, size) if isinstance(size, int) else size
    D = dct_dictionary(size, dtype=torch.float64)
    assert D.shape == (p * q, p * q)
    np.testing.assert_allclose(D.T.numpy() @ D.numpy(), np.eye(p * q), atol=1e-12)
    image = np.random.default_rng(0).normal(size=(p, q))
    coefficients = scipy.fft.dctn(image, norm="ortho")
    np.testing.assert_allclose(D.T.numpy() @ image.ravel(), coefficients.ravel(), atol=1e-12)


@pytest.mark.parametrize("size", [2, 3, 8, (2, 5), (1, 7), (7, 1)], ids=str)
@pytest.mark.parametrize("factor", [0.3, 0.9, 1.1, 1.7, 2.0, 4.0])
def test_other_numbers_of_atoms(size, factor):
    p, q = (size, size) if isinstance(size, int) else size
    K = max(1, round(factor * p * q))
    D = dct_dictionary(size, K, dtype=torch.float64)
    assert D.shape == (p * q, K)
    torch.testing.assert_close(D.norm(dim=0), torch.ones(K, dtype=torch.float64))
    torch.testing.assert_close(D[:, 0], torch.full((p * q,), (p * q) ** -0.5, dtype=torch.float64))
    assert (D[:, 1:].sum(0).abs() < 1e-12).all()
    if 1.7 * p * q <= K:  # below, the highest frequency may be left out
        assert torch.linalg.matrix_rank(D) == p * q


def test_few_atoms_are_the_low_frequencies():
    full, few = dct_dictionary(8, dtype=torch.float64), dct_dictionary(8, 3, dtype=torch.float64)
    torch.testing.assert_close(few, full[:, [0, 1, 8]])


def test_dictionary_dtype():
    assert dct_dictionary(4).dtype == torch.float32
    assert dct_dictionary(4, dtype=torch.float64).dtype == torch.float64


@pytest.mark.parametrize(
    "size, atoms, message",
    [
        (0, None, "patch_size: 0 given"),
        ((4, -1), None, "patch_size"),
        (4, 0, "n_atoms: 0 given"),
        (1, 2, "only the constant"),
        (2.0, None, "patch_size: 2.0 given"),
        (4, 3.5, "n_atoms: 3.5 given"),
        ((4, 4, 4), None, "patch_size"),
    ],
)
def test_bad_dictionaries_are_named(size, atoms, message):
    with pytest.raises((ValueError, TypeError), match=message):
        dct_dictionary(size, atoms)
