"""Every integrator at every scale: weights, offsets, units and slopes, in both precisions.

The linear solve itself is compared with SciPy in `tests/solvers/test_scales.py`. Here the truth is equivariance: a
scale or an offset that goes in comes out, in the precision that the heights leave.
"""

import pytest
import torch

from tests.helpers import MASKS, random_field, sparse_solve, uniform_field
from tests.helpers.methods import METHODS, bumps, method
from torchdls import DLS, INTEGRATORS, LeastSquares, edge_slopes, normals_to_gradient

DTYPES = [torch.float64, torch.float32]
ANCHORED = [name for name in INTEGRATORS if "anchor" in INTEGRATORS[name].accepts]
WEIGHTED = [name for name in INTEGRATORS if "weight" in INTEGRATORS[name].accepts]
MASKED = [name for name in INTEGRATORS if "mask" in INTEGRATORS[name].accepts]
SCALING = [name for name in INTEGRATORS if "scales_with_the_slopes" not in method(name).no]


def steady(name, **more):
    """The method with solves so tight, and so few iterations, that its result is a smooth map."""
    options = dict(next(iter(method(name).exact.values()))) if name in METHODS else {}
    return INTEGRATORS[name](**{**options, **more})


def off(height, expected, inside=None):
    """Largest difference by the relief of what is expected."""
    difference, expected = (height.double() - expected.double()).abs(), expected.double()
    inside = torch.ones_like(difference, dtype=torch.bool) if inside is None else inside.expand_as(difference)
    values = expected[inside]
    return float(difference[inside].max() / (values.max() - values.min()))


def rounding(dtype, largest, z):
    """One unit in the last place of the largest height, by the relief: what adding the offset rounds."""
    return torch.finfo(dtype).eps * largest / float(z.max() - z.min())


def held(dtype, weight, n=(16, 14)):
    r = torch.zeros(1, 1, *n, dtype=dtype)
    r[..., 0] = weight
    return r


@pytest.mark.parametrize("name", ANCHORED)
@pytest.mark.parametrize("dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)], ids=str)
def test_anchors_of_any_weight_carry_any_offset(name, dtype):
    g = bumps().to(dtype)
    anchor = random_field(1, 1, 16, 14, seed=4).to(dtype)
    # HornBrooks finds the constant at once, but a surface bent by weights between only in more than 10,000 sweeps.
    for weight in (1e-9, 1.0) if name == "horn_brooks" else (1e-9, 1e-4, 1.0, 1e6, 1e12):
        r = held(dtype, weight)
        low = steady(name)(g.double(), anchor=anchor.double(), anchor_weight=r.double())
        for offset in (0.0, 500.0, -1e6):
            high = steady(name)(g, anchor=anchor + offset, anchor_weight=r)
            lifted = (anchor + offset).double() - offset  # what the dtype keeps of the anchors
            expected = low if dtype == torch.float64 or not offset else steady(name)(
                g.double(), anchor=lifted, anchor_weight=r.double())  # fmt: skip
            limit = max(1e-5, rounding(dtype, abs(offset) + 3, low))
            assert off(high.double() - offset, expected) < limit, (weight, offset)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_dls_meets_firm_anchors_far_away(dtype):
    g = bumps().to(dtype)
    r = held(dtype, 1e8)
    for offset in (0.0, 500.0, 1e6):
        height = method("dls").build("dls")(g, anchor=torch.full_like(r, offset), anchor_weight=r)
        assert float((height[..., 0] - offset).abs().max()) < max(1e-4, torch.finfo(dtype).eps * offset)


@pytest.mark.parametrize("name", ANCHORED)
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_metres(name, dtype):
    """Pixels of .01 mm and anchors .25 m away, against the same in pixels."""
    g, r = bumps().to(dtype), held(dtype, 1e8 if name == "dls" else 1.0)
    anchor = 3 * random_field(1, 1, 16, 14, seed=4).to(dtype)
    in_pixels = steady(name)(g.double(), anchor=anchor.double() + 25000, anchor_weight=r.double())
    in_metres = steady(name, pixel_size=1e-5)(g, anchor=anchor * 1e-5 + 0.25, anchor_weight=r * 1e10)
    limit = max(1e-5, 2 * rounding(dtype, 25000, in_pixels))  # of the anchors, and of the heights
    assert off(in_metres.double() / 1e-5, in_pixels) < limit


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_three_known_depths_in_perspective(dtype):
    """Log depths of about 700, as depths written in another unit have, held by three points of weight 1e6."""
    n, camera = 40, torch.tensor([[50.0, 0, 20], [0, 50, 20], [0, 0, 1]], dtype=torch.float64)
    normals = torch.nn.functional.normalize(
        torch.cat([0.3 * random_field(1, 2, n, n, seed=8), torch.ones(1, 1, n, n, dtype=torch.float64)], 1), dim=1
    )
    u = normals_to_gradient(normals, camera=camera).gradient
    r, anchor = torch.zeros(1, 1, n, n, dtype=torch.float64), torch.zeros(1, 1, n, n, dtype=torch.float64)
    for (y, x), depth in zip([(3, 4), (30, 8), (17, 35)], [700.0, 700.3, 699.9], strict=True):
        r[..., y, x], anchor[..., y, x] = 1e6, depth
    expected = torch.from_numpy(sparse_solve(edge_slopes(u)[0][0], None, anchor[0] - 700, r[0]))[None, None]
    height = LeastSquares()(u.to(dtype), anchor=anchor.to(dtype), anchor_weight=r.to(dtype)).double() - 700
    assert off(height, expected) < max(1e-5, 2 * rounding(dtype, 700, expected))  # of the anchors, and of the heights


# Those whose minimum for exact slopes of a quadratic is the quadratic; HornBrooks says that it has not converged.
@pytest.mark.parametrize("name", ["least_squares", "weighted_least_squares", "total_variation", "l1", "huber"])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_two_parts_of_very_different_slopes(name, dtype):
    y, x = torch.meshgrid(*(torch.arange(40, dtype=torch.float64),) * 2, indexing="ij")
    inside = torch.ones(1, 1, 40, 40, dtype=torch.bool)
    inside[..., 19] = False
    scale = torch.where(x < 20, 1.0, 1e-6)
    z = (0.01 * (x - 20).square() - 0.02 * (y - 13).square() + 0.3 * x) * scale
    g = torch.stack([0.02 * (x - 20) + 0.3, -0.04 * (y - 13)])[None] * scale
    height = INTEGRATORS[name]()(g.to(dtype), inside)[0, 0].double()
    for part in (slice(0, 19), slice(20, 40)):
        truth = z[:, part] - z[:, part].mean()
        assert off(height[:, part], truth) < 1e-5, part


@pytest.mark.parametrize("name", WEIGHTED)
@pytest.mark.parametrize("dtype, power", [(torch.float32, -80), (torch.float32, 80), (torch.float64, 260),
                                          (torch.float64, -664)], ids=str)  # fmt: skip
def test_weights_of_any_scale(name, dtype, power):
    """Equal weights say nothing, however large; weights that vary say the same."""
    g, inside = bumps().to(dtype), MASKS["disk"](16, 14)
    for weight in (torch.ones(1, 1, 16, 14), 0.5 + uniform_field(1, 1, 16, 14, seed=2)):
        weight = weight.to(dtype)
        integrator = steady(name, **({"lam": "auto", "select": False} if name == "dls" else {}))  # a number has a unit
        height = integrator(g, inside, weight * 2.0**power)
        assert off(height, integrator(g, inside, weight), inside) < 1e-5


@pytest.mark.parametrize("name", SCALING)
@pytest.mark.parametrize("dtype, scale", [(torch.float32, 1e-20), (torch.float32, 1e20), (torch.float64, 1e-150),
                                          (torch.float64, 1e150)], ids=str)  # fmt: skip
def test_slopes_of_any_scale(name, dtype, scale):
    g, integrator = bumps().to(dtype), steady(name)
    expected, height = integrator(g), integrator(g * scale)
    assert bool(height.isfinite().all())
    assert off(height.double() / scale, expected) < 1e-4


@pytest.mark.parametrize("name", ["spectral_path", "bilateral", "piecewise"])
@pytest.mark.parametrize("dtype, scale", [(torch.float32, 1e-20), (torch.float32, 1e20), (torch.float64, 1e-150),
                                          (torch.float64, 1e150)], ids=str)  # fmt: skip
def test_slopes_of_any_scale_where_the_rule_has_one(name, dtype, scale):
    """These compare slopes with a pixel: they do not scale, but stay within their dtype."""
    assert bool(steady(name)(bumps().to(dtype) * scale).isfinite().all())


@pytest.mark.parametrize("select", [False, "guard"])
@pytest.mark.parametrize("dtype, scale", [(torch.float32, 1e-20), (torch.float32, 1e20), (torch.float64, 1e-150),
                                          (torch.float64, 1e150)], ids=str)  # fmt: skip
def test_slopes_of_any_scale_by_dls(select, dtype, scale):
    """With a threshold from the noise; a number is a height."""
    g, integrator = bumps().to(dtype), DLS(n_iter=2, patch_size=4, n_atoms=16, select=select)
    expected, found = integrator.solve(g), integrator.solve(g * scale)
    assert off(found.height.double() / scale, expected.height) < 1e-4
    torch.testing.assert_close(found.mu.double() / scale, expected.mu.double(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("name", ANCHORED)
@pytest.mark.parametrize("dtype, weight", [(torch.float32, 1e-42), (torch.float64, 1e-320)], ids=str)
def test_denormal_anchor_weights(name, dtype, weight):
    g = bumps().to(dtype)
    anchor = torch.full((1, 1, 16, 14), 7.0, dtype=dtype)
    r = torch.zeros_like(anchor)
    r[..., 5, 6] = weight
    height = steady(name)(g, anchor=anchor, anchor_weight=r)
    free = steady(name)(g)
    assert bool(height.isfinite().all())
    if name != "dls":
        assert off(height - 7, free - free[0, 0, 5, 6]) < 1e-4


# Not of those whose trusts follow the surface (they amplify rounding), nor of what thresholds or relaxes.
@pytest.mark.parametrize(
    "name", [n for n in INTEGRATORS if n not in ("dls", "bilateral", "anisotropic_diffusion", "horn_brooks")]
)
def test_a_ripple_on_a_steep_tilt_in_single_precision(name):
    """A ripple of 5e-3 on slopes of 100: what float32 holds of it, against float64 on the same slopes."""
    y, x = torch.meshgrid(*(torch.arange(32, dtype=torch.float64),) * 2, indexing="ij")
    along, down = 0.5 * torch.cos(0.5 * x) * torch.cos(0.4 * y), -0.4 * torch.sin(0.5 * x) * torch.sin(0.4 * y)
    g = (5e-3 * torch.stack([along, down])[None] + torch.tensor([100.0, 0.0]).view(1, 2, 1, 1)).float()
    height, expected = (steady(name)(slopes).double() for slopes in (g, g.double()))
    assert float((height - expected).abs().max()) < 16 * torch.finfo(torch.float32).eps * 1600
