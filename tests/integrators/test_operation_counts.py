"""What the inner loops cost in operations: an accidental copy or loop shows here, without a clock."""

from collections import Counter

import pytest
import scipy.fft
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchdls import DLS, SURFACES, LeastSquares, Patches, SoupDIL, _compiled
from torchdls.dictionary.soup_dil import residual_sweep
from torchdls.operators import cosine
from torchdls.solvers import direct

VIEWS = {"view", "slice", "select", "transpose", "expand", "unsqueeze", "as_strided", "detach", "split", "alias", "t"}
VIEWS |= {"permute", "_unsafe_view", "unfold", "squeeze", "view_as_real", "view_as_complex", "diagonal", "unbind"}


class Operations(TorchDispatchMode):
    """Counts the operations that compute or copy, and the large ones among them."""

    def __init__(self, large):
        super().__init__()
        self.count: Counter[str] = Counter()
        self.large: Counter[str] = Counter()
        self.least = large

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if name not in VIEWS:
            self.count[name] += 1
            self.large[name] += isinstance(out, torch.Tensor) and out.numel() >= self.least
        return out


def noisy(size=96):
    gradient = SURFACES["tent"](size, dtype=torch.float32).gradient
    return gradient + 0.1 * torch.randn(gradient.shape, generator=torch.Generator().manual_seed(0))


def codes_of(order):
    result = DLS(learner=SoupDIL(order), n_iter=2, tol=0.0).solve(noisy())
    P, D, B = Patches().extract(result.height), result.dictionary, result.codes
    return (P.mT - B.mT @ D.mT).mT, D, B


@pytest.mark.parametrize("order, total", [("block", 1000), ("atom", 2400)])
def test_sweep(order, total, monkeypatch):
    """A few operations for every atom, on its row alone; the residual is met once or twice for every group."""
    monkeypatch.setattr(_compiled, "installed", lambda: False)
    R, D, B = codes_of(order)
    with Operations(large=R.numel()) as seen:
        residual_sweep(R, D, B, 0.2, order=order)
    assert seen.count.total() < total
    assert seen.large.total() <= 8  # updates of the residual in place, and no copy of it
    assert seen.large["copy_"] == (order == "block")  # the codes, where they were
    assert not any(seen.large[name] for name in ("clone", "cat", "_to_copy"))


def test_least_squares_is_two_transforms_of_scipy(monkeypatch):
    """One there, one back in the same memory, and what SciPy is not called for: the divergence and the gain."""
    g = noisy(160)
    calls: Counter[str] = Counter()
    LeastSquares()(g)  # fills the tables of this size
    for name in ("dctn", "idctn"):
        transform = getattr(scipy.fft, name)
        monkeypatch.setattr(scipy.fft, name, lambda *a, f=transform, n=name, **k: (calls.update([n]), f(*a, **k))[1])
    with Operations(large=g.numel() // 2) as seen:
        LeastSquares()(g)
    assert calls == {"dctn": 1, "idctn": 1}
    assert seen.count.total() < 30
    assert seen.large.total() < 12


def test_least_squares_is_two_transforms(monkeypatch):
    for module in (cosine, direct):
        monkeypatch.setattr(module, "plain", lambda _: False)
    g = noisy(160)
    LeastSquares()(g)  # fills the tables of this size
    with Operations(large=g.numel() // 2) as seen:
        LeastSquares()(g)
    assert seen.count["_fft_r2c"] == 1
    assert seen.count["_fft_c2r"] == 1
    assert seen.count.total() < 30
    assert seen.large.total() < 12


@pytest.mark.parametrize("size", [64, 96])
def test_least_squares_of_a_small_field_is_four_products(size):
    """Beside the products: the gain, two sums that tell whether values are finite, and how the solve went."""
    g = noisy(size)
    LeastSquares()(g)  # fills the tables of this size
    with Operations(large=g.numel() // 2) as seen:
        LeastSquares()(g)
    assert seen.count["mm"] + seen.count["bmm"] == 4
    assert seen.count.total() <= 12


def test_an_iteration_of_the_masked_solve(monkeypatch):
    """Two transforms, one product with the system, and a few updates in place."""
    for module in (cosine, direct):  # transforms of SciPy are no operations of PyTorch
        monkeypatch.setattr(module, "plain", lambda _: False)
    y, x = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 96), indexing="ij")
    inside, g = (x.square() + y.square() < 0.9)[None, None], noisy()
    counts, steps = [], []
    for tol in (1e-2, 1e-5):
        method = LeastSquares(tol=tol)
        fields = method._check_fields(g, inside)
        method._solve_fields(fields)  # fills the tables of this size, whose making would hide a part of the steps
        with Operations(large=g.numel() // 4) as seen:
            steps.append(int(method._solve_fields(fields).iterations))
        counts.append(seen)
    more = steps[1] - steps[0]
    assert more >= 3
    assert counts[1].count["_fft_r2c"] - counts[0].count["_fft_r2c"] == more
    assert (
        counts[1].count.total() - counts[0].count.total() <= 64 * more
    )  # eight of them on one number per surface: which iterate is the best
    assert counts[1].large.total() - counts[0].large.total() < 30 * more


@pytest.mark.parametrize("order", ["block", "atom"])
def test_a_batch_of_small_surfaces_is_not_swept_one_by_one(order, monkeypatch):
    monkeypatch.setattr(_compiled, "installed", lambda: False)
    counts = []
    for n in (2, 8):
        g = noisy(40).expand(n, -1, -1, -1)
        with Operations(large=g.numel()) as seen:
            DLS(learner=SoupDIL(order), n_iter=2, tol=0.0)(g)
        counts.append(seen.count.total())
    assert counts[1] < 1.05 * counts[0]


def test_iteration_of_dls_touches_the_patches_a_few_times():
    g, marks = noisy(), []
    with Operations(large=45 * 45 * 64) as seen:
        DLS(learner=SoupDIL("block"), n_iter=3, tol=0.0).solve(
            g, callback=lambda *_: marks.append((seen.count.total(), seen.large.total()))
        )
    (count, large), (count_before, large_before) = marks[2], marks[1]
    assert count - count_before < 1700
    assert large - large_before <= 9
