"""DLS with checkpoints: the derivative of autograd through all iterations, from hand-written steps back."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.helpers import random_field
from torchdls import DLS, DLSResult, Exact, FixedDictionary, LeastSquares, Proximal, SoupDIL, Unroll, dct_dictionary

H, W = 9, 8
MASK = torch.ones(2, 1, H, W, dtype=torch.bool)
MASK[0, :, 3:5, 3:5] = False
MASK[1, :, :2, 6:] = False

CASES: dict[str, dict[str, Any]] = {
    "paper": {},
    "block": {"learner": SoupDIL("block")},
    "unused kept": {"learner": SoupDIL(unused="keep"), "n_atoms": 20},
    "unused first": {"n_atoms": 20, "mu": 1.0},
    "shared": {"learn": "shared"},
    "shared, block": {"learn": "shared", "learner": SoupDIL("block")},
    "fixed": {"learn": "fixed"},
    "soft": {"learner": SoupDIL(threshold="soft")},
    "firm": {"learner": SoupDIL("block", threshold="firm", bound=1.5)},
    "firm, fixed": {"learner": FixedDictionary("firm", bound=1.5)},
    "two sweeps": {"learner": SoupDIL(n_sweeps=2)},
    "proximal": {"height_step": "proximal"},
    "accelerated": {"height_step": Proximal(3, accelerated=True)},
    "schedule": {"mu": [0.6, 0.5, 0.5, 0.4, 0.3], "learner": SoupDIL(threshold="soft")},
    "stopped early": {"tol": 0.03, "n_iter": 30},
    "K-SVD": {"learner": "k_svd"},
    "low-rank atoms": {"learner": "dino_kat"},
}


def of_height(result: DLSResult) -> Tensor:
    return (result.height.square() * random_field(2, 1, H, W, seed=3)).sum()


def of_everything(result: DLSResult) -> Tensor:
    return of_height(result) + result.codes.square().sum() + (result.dictionary[:, 0] ** 3).sum()


def of_objective(result: DLSResult) -> Tensor:
    return result.objective.sum()


def slopes(loss: Any, masked: bool, checkpoint: bool, options: dict[str, Any]) -> tuple[DLSResult, tuple[Tensor, ...]]:
    """Gradients in the slopes, weights, lam, mu and the dictionary, where they have one."""
    settings = {
        "patch_size": 3,
        "n_atoms": 9,
        "lam": 0.4,
        "mu": 0.35,
        "n_iter": 5,
        "tol": 0.0,
        "height_step": Exact(1e-12),
    } | options
    atoms = dct_dictionary(3, settings["n_atoms"], dtype=torch.float64)
    trained = {
        k: torch.nn.Parameter(torch.tensor(settings[k]).double())
        for k in ("lam", "mu")
        if not isinstance(settings[k], list)
    }
    model = DLS(
        **settings | trained | {"dictionary": torch.nn.Parameter(atoms)},
        data_term=LeastSquares(tol=1e-13),
        derivative=Unroll(checkpoint),
    )
    g, w = random_field(2, 2, H, W).requires_grad_(), (random_field(2, 2, H, W, seed=7).abs() + 0.3).requires_grad_()
    result = model.solve(g, MASK if masked else None, w)
    points = (g, w, *model.parameters())
    return result, torch.autograd.grad(loss(result), points, materialize_grads=True)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_checkpoint_changes_memory_alone(name: str, masked: bool) -> None:
    for loss in (of_height, of_everything) if name != "paper" else (of_height, of_everything, of_objective):
        (plain, wanted), (same, found) = (slopes(loss, masked, c, CASES[name]) for c in (False, True))
        torch.testing.assert_close(tuple(same), tuple(plain), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-11)
        assert all(g.abs().max() > 0 for g in found[:3])


def test_callback_and_second_derivatives() -> None:
    g, seen = random_field(1, 2, H, W).requires_grad_(), []
    model = DLS(3, n_atoms=9, mu=0.3, n_iter=5, tol=0.0, derivative=Unroll(checkpoint=True))
    result = model.solve(g, callback=lambda i, cost: seen.append((i, cost)))
    assert [i for i, _ in seen] == [1, 2, 3, 4, 5]
    torch.testing.assert_close(torch.stack([c for _, c in seen], 1), result.objective[:, 1:])
    with pytest.raises(RuntimeError, match=r"checkpoint=True\) has first derivatives only"):
        torch.autograd.grad(result.height.square().sum(), g, create_graph=True)


@pytest.mark.slow
def test_a_sweep_keeps_no_residual() -> None:
    """What is saved between the passes: heights, dictionaries and nonzero codes, of a few iterations only."""
    g = random_field(1, 2, 40, 40).requires_grad_()
    sizes: dict[bool, int] = {}
    for checkpoint in (False, True):
        seen: dict[int, int] = {}

        def pack(t: Tensor, seen: dict[int, int] = seen) -> Tensor:
            seen[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
            return t

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
            DLS(mu=2.0, n_iter=16, tol=0.0, derivative=Unroll(checkpoint))(g)
        sizes[checkpoint] = sum(seen.values())
    assert 30 * sizes[True] < sizes[False]
