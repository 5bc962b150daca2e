"""Derivatives of every integrator in the registry equal finite differences: first, second and forward mode.

A new integrator is tested with its defaults; where it needs small or tight settings, they are the `exact` forms of its
line in helpers/methods.py. Nothing may be detached in silence: see `test_every_input_is_reached`.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.helpers import random_field
from tests.helpers.methods import EXACT, exact, method, promising
from torchdls import Integrator

pytestmark = pytest.mark.device
H, W = 6, 7  # a rectangle, neither side a multiple of the stride of DLS


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
@pytest.mark.parametrize("name, label", EXACT)
def test_derivatives_equal_finite_differences(name: str, label: str, case: str) -> None:
    """What gradcheck and gradgradcheck do in fast mode, by relative error, along a random direction of all inputs.

    J u by forward mode and <c, J u> by reverse mode against central differences of the height, and the derivative of
    J^T c along u, by double backward, against central differences of J^T c.
    """
    integrator = exact(promising(name, "derivatives_equal_finite_differences"), label)
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
@pytest.mark.parametrize("name, label", EXACT)
def test_every_input_is_reached(name: str, label: str, case: str) -> None:
    """A loss that depends on an input gives it a gradient: not None, not zero, not NaN."""
    integrator = exact(name, label)
    call, values = as_function(integrator, inputs(integrator, label, case))
    loss = call(*values).square().sum()
    for slope in torch.autograd.grad(loss, values):
        assert slope.isfinite().all()
        assert slope.abs().max() > 0


@pytest.mark.parametrize("name, label", EXACT)
def test_functional_transforms_agree(name: str, label: str) -> None:
    """vmap over two batches, and jvp against vjp."""
    integrator = exact(name, label)
    g, direction, back = random_field(2, 1, 2, H, W), random_field(1, 2, H, W, seed=4), random_field(1, 1, H, W, seed=5)
    separate = torch.stack([integrator(x) for x in g])
    if "functional_transforms_agree" in method(name).no:
        with pytest.raises(RuntimeError, match="data-dependent control flow"):
            torch.vmap(integrator)(g)
    else:
        tol = 1e-7 if name == "piecewise" else 1e-9  # its solves take another way where values cannot be looked at
        torch.testing.assert_close(torch.vmap(integrator)(g), separate, rtol=tol, atol=tol)
    _, tangent = torch.func.jvp(integrator, (g[0],), (direction,))
    _, pull = torch.func.vjp(integrator, g[0])
    torch.testing.assert_close((tangent * back).sum(), (pull(back)[0] * direction).sum(), rtol=1e-8, atol=1e-9)
