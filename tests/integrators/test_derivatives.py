"""Derivatives of every integrator in the registry equal finite differences: first, second and forward mode.

A new integrator is tested with its defaults; where it needs small or tight settings, or where PyTorch cannot give a
derivative, it has a line in the tables below. Nothing may be detached in silence: see `test_every_input_is_reached`.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchdls
from tests.helpers import random_field
from torchdls import (
    DLS,
    INTEGRATORS,
    L1,
    AnisotropicDiffusion,
    Bilateral,
    HornBrooks,
    Huber,
    Integrator,
    LeastSquares,
    MEstimator,
    MumfordShah,
    SlopeDLS,
    TotalVariation,
    WeightedLeastSquares,
)

pytestmark = pytest.mark.device
H, W = 6, 7  # a rectangle, neither side a multiple of the stride of DLS


def dls(**options: Any) -> Callable[[], Integrator]:
    settings = {"patch_size": 3, "n_atoms": 9, "lam": 0.4, "mu": 0.35, "n_iter": 2, "tol": 0.0, "z_tol": 1e-13}
    return lambda: DLS(data_term=LeastSquares(tol=1e-13), **{**settings, **options})


def slope_dls(**options: Any) -> Callable[[], Integrator]:
    settings: dict[str, Any] = {"recipe": "plain", "patch_sizes": (3, 5), "tau": 0.8, "n_iter": 2, "z_tol": 1e-13}
    return lambda: SlopeDLS(**(settings | options))


FEW = {"n_iter": 2, "tol": 0.0, "solve_tol": 1e-13}

# What each method is built with: nothing, unless it stands here. More than one line tests more than one form.
VARIANTS: dict[str, dict[str, Callable[[], Integrator]]] = {
    "least_squares": {
        "default": lambda: LeastSquares(tol=1e-13),
        "pixel_size": lambda: LeastSquares(tol=1e-13, pixel_size=(0.5, 2.0)),
        "dirichlet": lambda: LeastSquares(tol=1e-13, boundary="dirichlet"),
    },
    "horn_brooks": {"default": lambda: HornBrooks(relaxation=1.5)},
    "weighted_least_squares": {"default": lambda: WeightedLeastSquares(floor=0.1, tol=1e-13)},
    "total_variation": {"default": lambda: TotalVariation(**FEW)},
    "l1": {"default": lambda: L1(**FEW)},
    "huber": {"default": lambda: Huber(**FEW)},
    "m_estimator": {
        "default": lambda: MEstimator(floor=0.1, **FEW),
        "tukey": lambda: MEstimator("tukey", floor=0.1, **FEW),
    },
    "anisotropic_diffusion": {"default": lambda: AnisotropicDiffusion(beta=0.2, **FEW)},
    "bilateral": {"default": lambda: Bilateral(**FEW)},
    "mumford_shah": {"default": lambda: MumfordShah(floor=0.1, **FEW)},
    "dls": {
        "default": dls(),
        "block": dls(order="block", n_sweeps=2, bound=3.0),
        "shared": dls(learn="shared", pixel_size=(0.5, 1.5)),
        "proximal": dls(z_step="proximal", n_prox=2),
        "soft": dls(threshold="soft", mu="auto"),
        "firm": dls(threshold="firm", order="block"),
        "fixed": dls(learn="fixed", grad="unroll"),
    },
    "slope_dls": {
        "default": slope_dls(),
        "quick": slope_dls(recipe="quick"),
        "cosines": slope_dls(learn=False, aggregate="sparsity", pixel_size=(0.5, 1.5)),
    },
}
# Iterations that stop when a value says so, written in plain operations: vmap refuses them, and says why.
NO_VMAP = {"horn_brooks"}
CASES = [(name, label) for name in INTEGRATORS for label in VARIANTS.get(name, {"default": None})]

mask = torch.ones(2, 1, H, W, dtype=torch.bool)
mask[0, :, 2:4, 2:4] = False  # a hole
mask[1, :, :, 5] = False  # two components
mask[1, :, 0, :2] = False
FIELDS: dict[str, tuple[str, ...]] = {
    "rectangle": (),
    "mask": ("mask",),
    "weight": ("weight",),
    "anchor": ("anchor", "anchor_weight"),
    "all": ("mask", "weight", "anchor", "anchor_weight"),
}
PARTS = ("mask", "weight", "anchor")  # what "all" holds together


def build(name: str, label: str) -> Integrator:
    return VARIANTS[name][label]() if name in VARIANTS else INTEGRATORS[name]()


def inputs(integrator: Integrator, variant: str, case: str) -> dict[str, Tensor]:
    """The gradient and what the case adds to it; skips the case if the method does not take it."""
    if variant != "default" and case not in ("rectangle", "all"):
        pytest.skip("the default tells")
    needed = {label.split("_")[0] for label in FIELDS[case]}
    if not needed <= integrator.accepts:
        pytest.skip(f"takes no {', '.join(sorted(needed - integrator.accepts))}")
    values = {
        "mask": mask,
        "weight": random_field(2, 2, H, W, seed=1).abs() + 0.3,
        "anchor": random_field(2, 1, H, W, seed=2),
        "anchor_weight": random_field(2, 1, H, W, seed=3).abs() + 0.1,
    }
    return {"gradient": random_field(2, 2, H, W), **{label: values[label] for label in FIELDS[case]}}


def as_function(integrator: Integrator, fields: dict[str, Tensor]) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """The integrator as a function of those of its fields that have a derivative."""
    names = [label for label, field in fields.items() if field.is_floating_point()]

    def call(*values: Tensor) -> Tensor:
        return integrator(**{**fields, **dict(zip(names, values, strict=True))})

    return call, [fields[label].clone().requires_grad_() for label in names]


def assert_close(found: Tensor, wanted: Tensor, tol: float, what: str) -> None:
    error = float((found - wanted).detach().norm() / wanted.detach().norm().clamp(min=1e-12))
    assert error <= tol, f"{what}: relative error {error:.1e}"


@pytest.mark.parametrize("case", ["rectangle", "all", *(pytest.param(c, marks=pytest.mark.slow) for c in PARTS)])
@pytest.mark.parametrize("name, label", CASES)
def test_derivatives_equal_finite_differences(name: str, label: str, case: str) -> None:
    """What gradcheck and gradgradcheck do in fast mode, by relative error, along a random direction of all inputs.

    J u by forward mode and <c, J u> by reverse mode against central differences of the height, and the derivative of
    J^T c along u, by double backward, against central differences of J^T c.
    """
    integrator = build(name, label).double()
    call, values = as_function(integrator, inputs(integrator, label, case))
    directions = [random_field(*x.shape, seed=10 + i) / x.numel() ** 0.5 for i, x in enumerate(values)]
    step = 1e-4

    def moved(t: float) -> list[Tensor]:
        return [(x.detach() + t * u).requires_grad_() for x, u in zip(values, directions, strict=True)]

    def pull(points: list[Tensor], create_graph: bool = False) -> list[Tensor]:
        z = call(*points)
        return list(torch.autograd.grad((z * back).sum(), points, create_graph=create_graph))

    height, tangent = torch.func.jvp(call, tuple(x.detach() for x in values), tuple(directions))
    back = random_field(*height.shape, seed=20)
    # Two step sizes, extrapolated: the differences themselves are then exact to the fourth order.
    with torch.no_grad():
        coarse, fine = ((call(*moved(t)) - call(*moved(-t))) / (2 * t) for t in (2 * step, step))
    numeric = (4 * fine - coarse) / 3
    assert_close(tangent, numeric, 1e-6, "forward mode")
    slopes = pull(values, create_graph=True)
    inner = sum(((s * u).sum() for s, u in zip(slopes, directions, strict=True)), torch.zeros(()).double())
    assert_close(inner, (numeric * back).sum(), 1e-6, "reverse mode")
    if not inner.requires_grad:  # the map is linear
        return
    curvature = torch.autograd.grad(inner, values, materialize_grads=True)
    coarse_, fine_ = (
        [(a - b) / (2 * t) for a, b in zip(pull(moved(t)), pull(moved(-t)), strict=True)] for t in (2 * step, step)
    )
    for found, a, b in zip(curvature, fine_, coarse_, strict=True):
        wanted = (4 * a - b) / 3
        assert (found - wanted).norm() <= 1e-5 * (wanted.norm() + 1e-2 * slopes[0].detach().norm()), "second derivative"


@pytest.mark.parametrize("case", ["rectangle", "all"])
@pytest.mark.parametrize("name, label", CASES)
def test_every_input_is_reached(name: str, label: str, case: str) -> None:
    """A loss that depends on an input gives it a gradient: not None, not zero, not NaN."""
    integrator = build(name, label).double()
    call, values = as_function(integrator, inputs(integrator, label, case))
    loss = call(*values).square().sum()
    for slope in torch.autograd.grad(loss, values):
        assert slope.isfinite().all()
        assert slope.abs().max() > 0


@pytest.mark.parametrize("name, label", CASES)
def test_functional_transforms_agree(name: str, label: str) -> None:
    """vmap over two batches, and jvp against vjp."""
    integrator = build(name, label).double()
    g, direction, back = random_field(2, 1, 2, H, W), random_field(1, 2, H, W, seed=4), random_field(1, 1, H, W, seed=5)
    separate = torch.stack([integrator(x) for x in g])
    if name in NO_VMAP:
        with pytest.raises(RuntimeError, match="data-dependent control flow"):
            torch.vmap(integrator)(g)
    else:
        torch.testing.assert_close(torch.vmap(integrator)(g), separate, rtol=1e-9, atol=1e-9)
    _, tangent = torch.func.jvp(integrator, (g[0],), (direction,))
    _, pull = torch.func.vjp(integrator, g[0])
    torch.testing.assert_close((tangent * back).sum(), (pull(back)[0] * direction).sum(), rtol=1e-8, atol=1e-9)


def test_table_names_methods_that_exist() -> None:
    assert set(VARIANTS) <= set(INTEGRATORS)
    assert torchdls.INTEGRATORS is INTEGRATORS
