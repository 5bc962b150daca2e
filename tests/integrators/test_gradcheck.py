"""PyTorch's own gradcheck and gradgradcheck, float64, for every operator and every integrator of the registry.

Integrators are checked in fast mode (along random directions), with the settings of `tests/test_derivatives.py`. Those
run a given number of iterations with inner solves to 1e-13: a looser stop would be a map with small jumps, which no
difference quotient can follow. Nothing in the registry is left out; thresholds act on a support that the steps of
gradcheck (1e-6) do not change. DLS at its fixed point is in `tests/test_implicit.py`, against the converged map.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from tests.helpers import random_field
from tests.helpers.methods import EXACT, exact, promising
from tests.integrators.test_derivatives import as_function, inputs
from torchdls import (
    GradientOperator,
    Patches,
    dct2,
    edge_slopes,
    gradient_to_normals,
    idct2,
    noise_level,
    normals_to_gradient,
    ring_of_lights,
    solve,
    soup_dil_sweep,
    woodham,
)
from torchdls.operators import dst2, slope_divergence
from torchdls.solvers import harmonic_extension, solve_direct

H, W = 5, 6
MASK = torch.ones(2, 1, H, W, dtype=torch.bool)
MASK[0, :, 1:3, 2:4] = False  # a hole
MASK[1, :, :, 4] = False  # two components

z, g = random_field(2, 1, H, W), random_field(2, 2, H, W, seed=1)
w, r = random_field(2, 2, H, W, seed=2).abs() + 0.3, random_field(2, 1, H, W, seed=3).abs() + 0.2
steps, patches = (0.5, 2.0), Patches((3, 2), (2, 1))
atoms = torch.linalg.qr(random_field(4, 4, seed=4))[0].expand(2, -1, -1)
directions = ring_of_lights(4).double()
camera = torch.tensor([[8.0, 0, 2.5], [0, 8, 2], [0, 0, 1]]).double()


def masked_solve(g: Tensor, w: Tensor, a: Tensor, r: Tensor) -> Tensor:
    v, trust = edge_slopes(g, MASK, w)
    return solve(v, trust, a, r, tol=1e-13).height


def free_solve(g: Tensor, w: Tensor) -> Tensor:
    """Without anchors: the constant of each component is free."""
    v, trust = edge_slopes(g, MASK, w)
    return solve(v, trust, tol=1e-13).height


def sweep(order: str, threshold: str) -> Callable[..., tuple[Tensor, Tensor]]:
    return lambda P, D, B, mu: soup_dil_sweep(P, D, B, mu, order=order, threshold=threshold)


P, B = random_field(2, 4, 6, seed=5), random_field(2, 4, 6, seed=6)
mu = torch.tensor([[0.4], [0.5]]).double()
images = random_field(2, 4, 3, 4, seed=7).abs() * 0.1 + 0.5

OPERATORS: dict[str, tuple[Callable[..., Tensor | tuple[Tensor, ...]], tuple[Tensor, ...]]] = {
    **{f"differences, {name}": (GradientOperator(name, steps), (z,)) for name in ("forward", "backward", "central")},
    **{f"adjoint, {name}": (GradientOperator(name, steps).adjoint, (g,)) for name in ("forward", "central")},
    "patches": (patches.extract, (z,)),
    "patches, adjoint": (lambda x: patches.adjoint(x, (H, W)), (patches.extract(z),)),
    "cosine transform": (dct2, (z,)),
    "inverse cosine transform": (idct2, (z,)),
    "sine transform": (dst2, (z,)),
    "divergence": (slope_divergence, (g,)),
    "edge slopes, weights": (lambda g, w: edge_slopes(g, MASK, w), (g, w)),
    "direct solve": (lambda z, r: solve_direct(z, r, steps), (z, r[:, :, :1, :1])),
    "solve, mask, weight, anchor": (masked_solve, (g, w, z, r)),
    "solve, mask, weight": (free_solve, (g, w)),
    "extension": (lambda z: harmonic_extension(z, MASK, torch.ones_like(MASK), tol=1e-13), (z,)),
    "noise level": (lambda g: noise_level(g), (random_field(2, 2, 8, 8),)),
    "normals to gradient": (lambda n: normals_to_gradient(n).gradient, (gradient_to_normals(g),)),
    "normals and camera": (lambda n, c: normals_to_gradient(n, camera=c).gradient, (gradient_to_normals(g), camera)),
    "gradient to normals": (gradient_to_normals, (g,)),
    "photometric stereo": (lambda x, lights: woodham(x, lights).normals, (images, directions)),
}
SWEEPS = {
    f"sweep, {order}, {threshold}": (sweep(order, threshold), (P, atoms, B, mu))
    for order in ("atom", "block")
    for threshold in ("hard", "soft", "firm")
}


@pytest.mark.parametrize("name", [*OPERATORS, *(pytest.param(name, marks=pytest.mark.slow) for name in SWEEPS)])
def test_operators(name: str) -> None:
    operator, tensors = (OPERATORS | SWEEPS)[name]
    points = [t.detach().clone().requires_grad_() for t in tensors]
    iterates = name.startswith("solve, ")  # entry by entry, these take too long
    assert gradcheck(operator, points, check_forward_ad=True, fast_mode=iterates, nondet_tol=1e-12)
    assert gradgradcheck(operator, points, fast_mode=True, nondet_tol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["rectangle", "mask", "all"])
@pytest.mark.parametrize("name, label", EXACT)
def test_integrators(name: str, label: str, case: str) -> None:
    if label != "default" and case != "rectangle":
        pytest.skip("the default tells")
    integrator = exact(promising(name, "derivatives_equal_finite_differences"), label)
    call, values = as_function(integrator, inputs(integrator, label, case))
    assert gradcheck(call, values, check_forward_ad=True, fast_mode=True, nondet_tol=1e-9)
    assert gradgradcheck(call, values, fast_mode=True, nondet_tol=1e-9)
