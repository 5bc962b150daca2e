"""`vmap(grad)` of every integrator and photometric method equals a loop of gradients; so does `vmap(jvp)` of these."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch.func import grad, jvp, vmap

from tests.helpers import random_field, uniform_field
from tests.helpers.methods import bumps, method, promising
from torchdls import (
    INTEGRATORS,
    PhotometricResult,
    bivariate_normals,
    dlnv_normals,
    dlpi_normals,
    low_rank_normals,
    ring_of_lights,
    sparse_normals,
    woodham,
)

pytestmark = pytest.mark.device
PLACES = 2
# A few iterations: what is mapped is each of them alike.
PHOTOMETRIC: dict[str, Callable[..., PhotometricResult]] = {
    "woodham": woodham,
    "sparse_normals, bayes": partial(sparse_normals, n_iter=5),
    "sparse_normals, l1": partial(sparse_normals, prior="l1", n_iter=5),
    "low_rank_normals": partial(low_rank_normals, max_iter=5),
    "bivariate_normals": partial(bivariate_normals, degree=1, n_iter=5),
    "dlpi_normals": partial(dlpi_normals, patch_size=3, n_iter=2, mu=0.05),
    "dlnv_normals": partial(dlnv_normals, patch_size=3, n_iter=2, mu=0.05),
}


def per_sample(f, *tensors):
    return vmap(grad(f))(*tensors), torch.stack([grad(f)(*(t[i] for t in tensors)) for i in range(PLACES)])


@pytest.mark.filterwarnings("ignore::torchdls.ConvergenceWarning")
@pytest.mark.parametrize("argument", ["gradient", "weight"])
@pytest.mark.parametrize("name", INTEGRATORS)
def test_integrators(name, argument):
    if argument not in ("gradient", *INTEGRATORS[name].accepts):
        pytest.skip(f"{name} takes no {argument}")
    promising(name, "functional_transforms_agree")
    options = {"tol": 0.0, "n_iter": 2} if "n_iter" in INTEGRATORS.parameters(name) else {}
    if name == "horn_brooks":  # as many sweeps for all, since none sees values
        options = {"tol": 1e-30, "max_iter": 60}
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


@pytest.mark.parametrize("argument", ["images", "lights"])
@pytest.mark.parametrize("name", PHOTOMETRIC)
def test_photometric_methods(name, argument):
    """vmap(grad) and vmap(jvp) equal their loops, and the one is the transpose of the other."""
    lights = ring_of_lights(8, 45, dtype=torch.float64, device=torch.get_default_device())
    given = {
        "images": 0.2 + uniform_field(PLACES, 8, 5, 4, seed=4),
        "lights": lights + 0.1 * random_field(PLACES, 8, 3, seed=5),
    }
    mask = uniform_field(1, 5, 4, seed=8) < 0.8  # of a single surface, the same for all
    probe, change = random_field(11, 5, 4, seed=6), random_field(*given[argument].shape, seed=7)

    def results(images, lights):
        return torch.cat(PHOTOMETRIC[name](images, lights, mask=mask))

    def forward(images, lights, change):
        def of(x):
            return results(**{"images": images, "lights": lights} | {argument: x})

        return jvp(of, ({"images": images, "lights": lights}[argument],), (change,))[1]

    inputs = given["images"], given["lights"]
    slope = grad(lambda i, k: (probe * results(i, k)).sum(), argnums=int(argument == "lights"))
    slopes, changes = vmap(slope)(*inputs), vmap(forward)(*inputs, change)
    singles = [tuple(t[i] for t in (*inputs, change)) for i in range(PLACES)]
    close = {"rtol": 1e-6, "atol": 1e-8}
    torch.testing.assert_close(slopes, torch.stack([slope(i, k) for i, k, _ in singles]), **close)
    torch.testing.assert_close(changes, torch.stack([forward(*single) for single in singles]), **close)
    along = (slopes * change).flatten(1).sum(1)
    torch.testing.assert_close(along, (probe * changes).flatten(1).sum(1), **close)
    assert along.all()
