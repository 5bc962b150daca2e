"""Sequences against DLS on single frames, the optimality conditions of the low-rank part, and planted sequences."""

import math

import pytest
import torch

from tests.helpers.fields import random_field, seeded
from torchdls import (
    DLS,
    SURFACES,
    DinoKat,
    Exact,
    OnlineDLS,
    SequenceDLS,
    SequencePatches,
    add_noise,
    rmse,
)
from torchdls.operators import GradientOperator
from torchdls.sequences.common import Frames
from torchdls.sequences.low_rank import _Problem


@pytest.mark.parametrize("frames, frame_stride, length", [(3, 1, 3), (3, 2, 8), (1, 1, 4), (4, 3, 6)])
def test_patches_by_slicing_and_their_transpose(frames, frame_stride, length):
    patches, z = SequencePatches((3, 4), frames, (2, 3), frame_stride), random_field(2, length, 1, 8, 9)
    x = patches.extract(z)
    starts = sorted({*range(0, length - frames + 1, frame_stride), length - frames})
    rows, columns = sorted({0, 2, 4, 5}), sorted({0, 3, 5})
    assert x.shape == (2, 12 * frames, len(rows) * len(columns) * len(starts))
    number = 0
    for i in rows:
        for j in columns:
            for t in starts:
                cut = z[:, t : t + frames, 0, i : i + 3, j : j + 4].movedim(1, -1).flatten(1)
                assert torch.equal(x[:, :, number], cut)
                number += 1
    y = random_field(*x.shape, seed=2)
    torch.testing.assert_close((x * y).sum(), (z * patches.adjoint(y, z.shape)).sum())
    torch.testing.assert_close(
        patches.coverage(z.shape, like=z), patches.adjoint(patches.extract(torch.ones_like(z[:1])), z.shape)
    )


def frame(size=20, seed=0):
    g = SURFACES["tent"](size, dtype=torch.float64).gradient
    return add_noise(g, 10, seeded(seed))


def test_one_frame_is_dls():
    g = frame()
    dls = DLS(mu=0.3, n_iter=4, tol=0, select=False, height_step=Exact(1e-12))(g)
    options = {"mu": 0.3, "lam": 0.5}
    one = SequenceDLS(frames=1, low_rank=math.inf, n_iter=4, **options)(g[None])
    torch.testing.assert_close(one[0], dls, rtol=0, atol=1e-8)
    torch.testing.assert_close(OnlineDLS(first=4, **options)(g[None])[0], dls, rtol=0, atol=1e-8)


@pytest.mark.parametrize("level, rank", [(9.0, 1), (4.0, 2), (1e-9, 4)])
def test_low_rank_least_squares_by_brute_force(level, rank):
    """The best approximation of integrable slopes of each rank (Eckart, Young), and the best of the ranks."""
    g = random_field(1, 4, 2, 6, 5) + 2 * random_field(1, 1, 2, 6, 5, seed=1)
    frames = Frames(g, 1.0)
    problem = _Problem(frames, SequencePatches(3, 2), 0.5, g.new_ones(1), g.new_full((1,), level))
    zero = torch.zeros_like(frames.height())
    A = GradientOperator("forward")
    U, s, V = torch.linalg.svd(A(frames.height()[0]).flatten(1), full_matrices=False)
    lost = (frames.slopes - A(frames.height()[0])).square().sum() / 2
    costs = [lost + s[k:].square().sum() / 2 + level**2 / 2 * k for k in range(5)]
    assert int(torch.stack(costs).argmin()) == rank
    L = problem.low_rank_part(zero)
    D, B = torch.zeros(1, 18, 1).double(), torch.zeros(1, 1, problem.patches.extract(zero).shape[-1]).double()
    torch.testing.assert_close(problem.cost(L, zero, D, B)[0], min(costs))
    torch.testing.assert_close(A(L[0]).flatten(1), (U[:, :rank] * s[:rank]) @ V[:rank])


@pytest.mark.parametrize("learner", ["soup_dil", DinoKat(1, (16, 3))], ids=["soup_dil", "low_rank_atoms"])
def test_the_objective_never_rises(learner):
    g = torch.stack([frame(16, seed) for seed in range(4)], 1)
    found = SequenceDLS(4, 3, 2, n_iter=5, learner=learner, pixel_size=(0.5, 2.0)).solve(g)
    assert (found.objective.diff(dim=1) <= 1e-9 * found.objective[:, :1]).all()
    assert found.objective[0, -1] < found.objective[0, 0]


def planted(frames=8, size=24):
    """Two shapes whose shares change from frame to frame."""
    a, b = (SURFACES[s](size, dtype=torch.float64) for s in ("peaks", "tent"))
    share = torch.linspace(0, 1, frames, dtype=torch.float64).view(-1, 1, 1, 1)
    truth = share * a.height + (1 - share) * b.height
    return truth, share * a.gradient + (1 - share) * b.gradient


def test_a_planted_low_rank_sequence_beats_frame_by_frame():
    truth, slopes = planted()
    noisy = add_noise(slopes, 3, seeded(1))
    together, apart = (rmse(z, truth).mean() for z in (SequenceDLS(n_iter=10)(noisy), DLS(n_iter=10)(noisy)))
    assert together < 0.8 * apart


def test_a_stream_needs_few_iterations():
    """Three for each frame that continue, beside three that begin anew, and twenty."""
    truth, slopes = planted()
    noisy = add_noise(slopes, 3, seeded(1))
    online = rmse(OnlineDLS(first=20, n_iter=3)(noisy), truth)[1:].mean()
    few, many = (rmse(DLS(n_iter=n, select=False, tol=0)(noisy), truth)[1:].mean() for n in (3, 20))
    assert online < 0.5 * (few + many)


def test_surfaces_of_a_batch_are_alone():
    g = torch.stack([frame(12, seed) for seed in range(6)]).view(2, 3, 2, 12, 12)
    for method in (SequenceDLS(4, 2, n_iter=2), OnlineDLS(4, first=2, n_iter=1)):
        both = method(g)
        for i in range(2):
            torch.testing.assert_close(both[i], method(g[i]), rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(method(7 * g[i]), 7 * both[i], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "method",
    [SequenceDLS(3, 2, 1, mu=0.2, low_rank=0.5, n_iter=1), OnlineDLS(3, 1, mu=0.2, first=1, n_iter=1)],
    ids=["together", "online"],
)
def test_derivative(method):
    g = random_field(1, 3, 2, 5, 4).requires_grad_()
    assert torch.autograd.gradcheck(method, [g], fast_mode=True, atol=1e-4)


@pytest.mark.parametrize("make", [SequenceDLS, OnlineDLS])
def test_bad_arguments(make):
    with pytest.raises(ValueError, match=r"gradient \(2, 8, 8\)"):
        make()(torch.zeros(2, 8, 8))
    with pytest.raises(TypeError, match="gradient"):
        make()(torch.zeros(3, 2, 8, 8, dtype=torch.int64))
    with pytest.raises(ValueError, match="not finite"):
        make()(torch.full((5, 2, 8, 8), float("nan")))
    with pytest.raises(ValueError, match="n_iter"):
        make(n_iter=0)
    with pytest.raises(ValueError, match="learner"):
        make(learner="magic")
    with pytest.raises(ValueError, match="mu"):
        make(mu=-1.0)
    with pytest.raises(ValueError, match="frames"):
        SequenceDLS()(torch.zeros(2, 2, 8, 8))
    with pytest.raises(ValueError, match="frame_stride"):
        SequencePatches(4, 2, 2, 3)
