"""The integrators as PyTorch modules: copied, pickled, replicated, trained, compiled, exported, and in a long chain."""

import copy
import io
import pickle
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from tests.helpers import random_field
from tests.helpers.methods import method
from torchdls import DLS, INTEGRATORS, LeastSquares, NormalsToGradient, SoupDIL, Unroll, soup_dil_sweep

SMALL: dict[str, Any] = {"patch_size": 4, "n_atoms": 16, "n_iter": 3, "tol": 0.0}
quiet = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")


def dls(**options) -> DLS:
    """A small DLS with everything that can be trained as a parameter."""
    atoms = nn.Parameter(torch.eye(16) + 0.1 * random_field(16, 16, dtype=torch.float32))
    trained = {"lam": nn.Parameter(torch.tensor(0.4)), "mu": nn.Parameter(torch.tensor(0.3)), "dictionary": atoms}
    return DLS(**{**SMALL, **trained, "learner": SoupDIL(threshold="firm"), **options})


@pytest.mark.parametrize("name", INTEGRATORS)
def test_copies_give_the_same_surface(name: str) -> None:
    module, g = (dls() if name == "dls" else method(name).build(name)), random_field(2, 2, 16, 16, dtype=torch.float32)
    with torch.no_grad():
        expected = module(g)
        for twin in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
            torch.testing.assert_close(twin(g), expected, rtol=0, atol=0)
    buffer = io.BytesIO()
    torch.save(module.state_dict(), buffer)
    buffer.seek(0)
    fresh = dls() if name == "dls" else method(name).build(name)
    with torch.no_grad():
        for p in fresh.parameters():
            p.zero_()
    fresh.load_state_dict(torch.load(buffer))
    with torch.no_grad():
        torch.testing.assert_close(fresh(g), expected, rtol=0, atol=0)


def test_replicas_share_the_parameters_of_the_original() -> None:
    """What DataParallel does on each device: a call on a copy whose parameters are functions of the original's."""
    module, g = dls(), random_field(2, 2, 16, 16, dtype=torch.float32)
    doubled = {k: p * 1.0 for k, p in module.named_parameters()}
    height = torch.func.functional_call(module, doubled, (g,))
    height.square().sum().backward()
    for name, p in module.named_parameters():
        assert p.grad is not None, name
        assert p.grad.isfinite().all()
        assert p.grad.abs().max() > 0


def test_tensors_move_with_the_module() -> None:
    module = DLS(**SMALL, lam=torch.tensor(0.4), mu=torch.tensor([0.3, 0.5])).double()
    assert {k: v.dtype for k, v in module.state_dict().items()} == dict.fromkeys(
        ("lam", "mu", "dictionary"), torch.float64
    )


@pytest.mark.parametrize("threshold", ["soft", "firm"])
@pytest.mark.parametrize("learn", ["each", "fixed"])
def test_training_lowers_the_loss(threshold: str, learn: str) -> None:
    """lam and mu, kept positive by a parametrisation, and the dictionary learn to undo noise."""

    class Positive(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return nn.functional.softplus(x)

    row = torch.linspace(-2, 2, 16)
    truth = (row.square()[:, None] + row.sin())[None, None]
    slopes = torch.cat([truth.diff(dim=-1, append=truth[..., -1:]), truth.diff(dim=-2, append=truth[..., -1:, :])], 1)
    noisy = slopes + 0.2 * random_field(2, 2, 16, 16, dtype=torch.float32)
    model = dls(learner=SoupDIL(threshold=threshold), learn=learn, derivative="unroll")
    for name in ("lam", "mu"):
        parametrize.register_parametrization(model, name, Positive())
    optimiser, losses = torch.optim.Adam(model.parameters(), 0.02), []
    for _ in range(8):
        optimiser.zero_grad()
        loss = (model(noisy) - truth + truth.mean()).square().mean()
        loss.backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]


def test_hard_threshold_gives_mu_no_derivative() -> None:
    mu = nn.Parameter(torch.tensor(0.3))
    g = random_field(1, 2, 16, 16, dtype=torch.float32, seed=1).requires_grad_()
    DLS(**SMALL, mu=mu)(g).square().sum().backward()
    assert mu.grad is None or mu.grad == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"learner": SoupDIL("block")},
        {"learner": "fixed"},
        {"learner": SoupDIL("block", threshold="soft"), "derivative": Unroll(checkpoint=True)},
    ],
)
def test_a_long_chain_stays_finite(options: dict) -> None:
    """Images to normals to gradients to DLS to a loss: batch 8, 128 x 128, with everything that makes NaN elsewhere."""
    lights = torch.tensor([[0.5, 0, 0.87], [-0.25, 0.43, 0.87], [-0.25, -0.43, 0.87], [0, 0, 1.0]])
    images = random_field(8, 4, 128, 128, dtype=torch.float32).abs() * 0.1 + 0.5
    images[0, :, :40, :40] = 0.5  # flat patches
    images[1, :, 3:9] = 0.0  # black: normals of length 0
    images[2, 0, 50:60], images[2, 1:, 50:60] = 1.0, 0.0  # nz near 0 or below
    images.requires_grad_()
    weight = torch.ones(8, 1, 128, 128)
    weight[3, :, 20:26, 20:26] = 0
    weight.requires_grad_()
    normals = torch.einsum("ck,nkhw->nchw", torch.linalg.pinv(lights), images)
    n_atoms = 64 if options["learner"] == "fixed" else 100  # more atoms than the patches use
    model = DLS(n_iter=2, tol=0.0, n_atoms=n_atoms, **options)
    height = model(NormalsToGradient()(normals), weight=weight)
    height.square().mean().backward()
    assert height.isfinite().all()
    assert images.grad.isfinite().all()
    assert images.grad.abs().max() > 0
    assert weight.grad.isfinite().all()


@pytest.mark.slow
@quiet
def test_compiles_without_a_break() -> None:
    """Least squares, one sweep of SOUP-DIL, a step of the preconditioned solver, and DLS with proximal steps."""
    g = random_field(1, 2, 12, 12, dtype=torch.float32)
    P, D = (
        random_field(1, 16, 30, dtype=torch.float32),
        torch.linalg.qr(random_field(1, 16, 16, dtype=torch.float32))[0],
    )
    B = torch.zeros(1, 16, 30)

    def step(x: Tensor, w: Tensor) -> Tensor:
        from torchdls import GradientOperator
        from torchdls.solvers import solve_direct

        a = GradientOperator()
        return solve_direct(a.adjoint(w * a(x)), None)

    cases: list[tuple[Any, tuple[Tensor, ...]]] = [
        (LeastSquares(), (g,)),
        (lambda P, D, B: soup_dil_sweep(P, D, B, 0.5), (P, D, B)),
        (step, (g[:, :1], g.abs())),
        (DLS(4, 2, 9, mu=0.3, n_iter=1, tol=0.0, height_step="proximal", learner=SoupDIL("block")), (g,)),
    ]
    for function, arguments in cases:
        torch._dynamo.reset()
        compiled = torch.compile(function, backend="aot_eager", fullgraph=True)
        torch.testing.assert_close(compiled(*arguments), function(*arguments), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@quiet
@pytest.mark.parametrize(
    "module",
    [LeastSquares(), DLS(4, 2, 9, mu=0.3, n_iter=2, tol=0.0, height_step="proximal", learner=SoupDIL("block"))],
    ids=["least_squares", "dls"],
)
def test_exports_for_a_fixed_shape(module: nn.Module) -> None:
    g = random_field(1, 2, 12, 12, dtype=torch.float32)
    program = torch.export.export(module, (g,))
    other = random_field(1, 2, 12, 12, seed=1, dtype=torch.float32)
    torch.testing.assert_close(program.module()(other), module(other), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@quiet
def test_least_squares_in_onnx(tmp_path) -> None:
    """Up to 128 pixels a side the solve is four products with matrices, which ONNX has."""
    pytest.importorskip("onnxscript", reason="the ONNX exporter of PyTorch needs onnxscript")
    onnx = pytest.importorskip("onnx.reference", reason="the reference evaluator comes with onnx")
    g, path = random_field(1, 2, 12, 128, dtype=torch.float32), tmp_path / "least_squares.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(LeastSquares().eval(), (g,), path, dynamo=True, verbose=False)
    (found,) = onnx.ReferenceEvaluator(str(path)).run(None, {"gradient": g.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), LeastSquares()(g), rtol=1e-4, atol=1e-4)
