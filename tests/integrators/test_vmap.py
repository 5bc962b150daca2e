"""`vmap(grad)` of every integrator and photometric method, in every input, equals a loop of gradients."""

import pytest
import torch
from torch.func import grad, vmap

from tests.helpers import random_field, uniform_field
from tests.helpers.methods import bumps, method, promising
from torchdls import INTEGRATORS, low_rank_normals, ring_of_lights, sparse_normals, woodham

pytestmark = pytest.mark.device
PLACES = 2
ITERATIVE = [pytest.param(f, marks=pytest.mark.slow) for f in (sparse_normals, low_rank_normals)]


def per_sample(f, *tensors):
    return vmap(grad(f))(*tensors), torch.stack([grad(f)(*(t[i] for t in tensors)) for i in range(PLACES)])


@pytest.mark.parametrize("argument", ["gradient", "weight"])
@pytest.mark.parametrize("name", INTEGRATORS)
def test_integrators(name, argument):
    if argument not in ("gradient", *INTEGRATORS[name].accepts):
        pytest.skip(f"{name} takes no {argument}")
    promising(name, "functional_transforms_agree")
    options = {"tol": 0.0, "n_iter": 2} if "n_iter" in INTEGRATORS.parameters(name) else {}
    known = INTEGRATORS.parameters(name)
    integrator = method(name).build(name, **{k: v for k, v in options.items() if k in known})
    g = bumps(PLACES, 9, 8)
    weight = 0.5 + uniform_field(PLACES, 1, 9, 8, seed=2)
    probe = random_field(9, 8, seed=3)
    if argument == "gradient":
        together, one_by_one = per_sample(lambda g: (integrator(g) * probe).sum(), g)
    else:
        together, one_by_one = per_sample(lambda w, g: (integrator(g, weight=w) * probe).sum(), weight, g)
    torch.testing.assert_close(together, one_by_one, rtol=1e-4, atol=1e-5)  # solves stop at 1e-6
    assert one_by_one.any()


@pytest.mark.parametrize("normals", [woodham, *ITERATIVE])
def test_photometric_methods(normals):
    lights = ring_of_lights(8, 45, dtype=torch.float64, device=torch.get_default_device())
    images = 0.2 + uniform_field(PLACES, 8, 5, 4, seed=4)
    together, one_by_one = per_sample(lambda i: normals(i, lights).normals[0].sum(), images)
    torch.testing.assert_close(together, one_by_one, rtol=1e-6, atol=1e-8)
    assert one_by_one.any()
