"""The contract that every integrator keeps, driven by the registry.

A new integrator is tested as soon as it is registered, with its defaults. A line in the table `METHODS` of
helpers/methods.py says otherwise: how to build it small and quick, how exactly it keeps the promises, and which it does
not make (with the reason). The arguments it takes are read from its `accepts`.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.helpers import MASKS, assert_unchanged, random_field
from tests.helpers.methods import bumps, everything, method, needs, promising
from torchdls import INTEGRATORS, edge_slopes
from torchdls.solvers import connected_components

pytestmark = pytest.mark.device


@pytest.fixture(params=list(INTEGRATORS))
def name(request: pytest.FixtureRequest) -> str:
    return promising(request.param, request.node.originalname.removeprefix("test_"))


@pytest.fixture
def close(name: str) -> Callable[..., None]:
    """Heights agree up to the tolerance of the method, relative to the largest height."""

    def check(actual: Tensor, expected: Tensor, tol: float | None = None) -> None:
        tol = method(name).tol if tol is None else tol
        assert actual.shape == expected.shape
        assert actual.dtype == expected.dtype
        error = float((actual - expected).abs().max() / (1e-12 + expected.abs().max()))
        assert error <= tol, f"{name}: relative error {error:.1e}"

    return check


def plane(p: float, q: float, shape: tuple[int, int], steps: tuple[float, float] = (1.0, 1.0)) -> tuple[Tensor, Tensor]:
    """Slopes and zero-mean height of a plane."""
    h, w = shape
    g = torch.tensor([p, q], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, h, w)
    y, x = torch.meshgrid(torch.arange(h, dtype=torch.float64), torch.arange(w, dtype=torch.float64), indexing="ij")
    z = (p * steps[0] * x + q * steps[1] * y)[None, None]
    return g.clone(), z - z.mean()


# Shapes, dtypes, devices


def test_shapes_and_dtypes(name: str) -> None:
    integrator, least = method(name).build(name), max(3, method(name).smallest)
    for shape in [(1, 16, 16), (2, least, least + 4), (3, 17, least), (1, 13, 15)]:
        g = bumps(*shape)
        for dtype in (torch.float32, torch.float64):
            z = integrator(g.to(dtype))
            assert z.shape == (shape[0], 1, *shape[1:])
            assert z.dtype == dtype
            assert z.device == g.device
            assert z.isfinite().all()


def test_smallest_image(name: str) -> None:
    least = method(name).smallest
    g = bumps(2, least, least)
    assert method(name).build(name)(g).shape == (2, 1, least, least)


def test_unbatched_is_a_batch_of_one(name: str) -> None:
    integrator, g = method(name).build(name), bumps()
    assert torch.equal(integrator(g[0]), integrator(g)[0])
    if "mask" in integrator.accepts:
        mask = MASKS["disk"](16, 14)
        assert torch.equal(integrator(g[0], mask[0]), integrator(g, mask)[0])


def test_each_surface_of_a_batch_is_its_own(name: str, close: Callable[..., None]) -> None:
    """Whatever its neighbours are: calm, wild, of another scale."""
    integrator = method(name).build(name)
    g = bumps(3) * torch.tensor([1.0, 0.0, 30.0], dtype=torch.float64).view(3, 1, 1, 1)
    together = integrator(g)
    for i in range(3):
        close(together[i : i + 1], integrator(g[i : i + 1]))


def test_one_mask_serves_the_batch(name: str, close: Callable[..., None]) -> None:
    needs(name, "mask")
    integrator, g, mask = method(name).build(name), bumps(2), MASKS["disk"](16, 14)
    close(integrator(g, mask), integrator(g, mask.expand(2, -1, -1, -1)), 1e-12)


def test_float32_agrees_with_float64(name: str, close: Callable[..., None]) -> None:
    integrator, g = method(name).build(name), bumps(2)
    close(integrator(g.float()).double(), integrator(g), max(1e-4, 10 * method(name).tol))


def test_views_are_taken_as_they_are(name: str, close: Callable[..., None]) -> None:
    integrator, g = method(name).build(name), bumps(2)
    strided = torch.stack([g, g], -1)[..., 0]
    assert not strided.is_contiguous()
    close(integrator(strided), integrator(g), 1e-10)


def test_two_calls_are_identical(name: str) -> None:
    integrator, g = method(name).build(name), bumps(2)
    first = integrator(g)
    integrator(bumps(1, 12, 12))
    assert torch.equal(integrator(g), first)
    assert torch.equal(method(name).build(name)(g), first)


def test_no_randomness_and_no_global_state(name: str) -> None:
    state, dtype = torch.get_rng_state(), torch.get_default_dtype()
    method(name).build(name)(bumps())
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_default_dtype() == dtype


def test_inputs_are_left_alone(name: str) -> None:
    integrator, g = method(name).build(name), bumps(2)
    optional = everything(integrator, g)
    with assert_unchanged(g, *optional.values()):
        integrator(g, **optional)


def test_cpu_inputs_inside_a_meta_device_context(name: str) -> None:
    """Finds every factory call that forgets its device, with no GPU."""
    g = bumps(2)
    expected = method(name).build(name)
    optional = everything(expected, g)
    with torch.device("meta"):
        integrator = method(name).build(name)
        z = integrator(g)
        full = integrator(g, **optional)
        integrator(bumps_like(g))
    assert z.device == full.device == g.device
    assert torch.equal(z, expected(g))
    assert torch.equal(full, expected(g, **optional))


def bumps_like(g: Tensor) -> Tensor:
    """The same field at a size whose tables no earlier test has cached."""
    return g[..., :11, :13]


def test_float64_as_the_default_dtype_changes_nothing(name: str) -> None:
    g = bumps().float()
    expected = method(name).build(name)(g)
    torch.set_default_dtype(torch.float64)
    try:
        z = method(name).build(name)(g)
    finally:
        torch.set_default_dtype(torch.float32)
    assert z.dtype == torch.float32
    torch.testing.assert_close(z, expected, rtol=1e-4, atol=1e-4)


def test_state_dict_and_copies(name: str) -> None:
    integrator, g = method(name).build(name), bumps()
    expected = integrator(g)
    again = method(name).build(name)
    again.load_state_dict(integrator.state_dict())
    assert torch.equal(again(g), expected)
    assert torch.equal(copy.deepcopy(integrator)(g), expected)
    assert name.replace("_", "") in repr(integrator).lower().replace("_", "")


def test_inference_mode_and_no_grad_agree_with_grad(name: str, close: Callable[..., None]) -> None:
    integrator, g = method(name).build(name), bumps()
    with torch.inference_mode():
        inferred = integrator(g.clone())
    with torch.no_grad():
        quiet = integrator(g)
    recorded = integrator(g.clone().requires_grad_())
    close(inferred.clone(), recorded.detach(), 1e-8)
    close(quiet, recorded.detach(), 1e-8)
    assert recorded.requires_grad


# Geometry


def test_plane_is_exact(name: str, close: Callable[..., None]) -> None:
    for shape in [(12, 15), (16, 16)]:
        g, z = plane(0.3, -0.7, shape)
        close(method(name).build(name)(g), z)


def test_plane_is_exact_on_a_mask(name: str, close: Callable[..., None]) -> None:
    needs(name, "mask")
    if "plane_is_exact" in method(name).no:
        pytest.skip(method(name).no["plane_is_exact"])
    g, z = plane(0.3, -0.7, (16, 14))
    mask = MASKS["disk"](16, 14)
    height = method(name).build(name)(torch.where(mask, g, torch.nan), mask)
    close(height, torch.where(mask, z - z[mask].mean(), 0))


def test_a_flat_field_is_flat(name: str) -> None:
    assert method(name).build(name)(torch.zeros(1, 2, 16, 16)).abs().max() == 0


def test_mean_is_zero(name: str) -> None:
    """The free constant: zero mean, on each connected component of a mask."""
    integrator, g = method(name).build(name), bumps(2)
    z = integrator(g)
    scale = float(z.abs().max())
    assert (z.mean((-2, -1)).abs() <= 1e-9 * scale).all()
    if "mask" in integrator.accepts:
        inside = MASKS["ring_and_islands"](16, 14)
        z = integrator(g, inside)
        _, w = edge_slopes(g[:1], inside)
        labels = connected_components(w > 0)
        for label in labels[inside[0]].unique():
            assert (z[:, 0, labels[0] == label].mean(1).abs() <= 1e-9 * scale).all()


def test_an_anchor_fixes_the_constant(name: str) -> None:
    """One known height, trusted without limit: the mean is then whatever it takes."""
    needs(name, "anchor")
    integrator, g = method(name).build(name), bumps(2)
    trust = torch.zeros(2, 1, 16, 14, dtype=g.dtype)
    trust[0, :, 4, 4] = 1e6
    z = integrator(g, anchor=torch.full_like(trust, 10.0), anchor_weight=trust)
    assert abs(float(z[0, 0, 4, 4]) - 10) < 1e-3
    assert abs(float(z[1].mean())) < 1e-9 * float(z.abs().max())


def test_scales_with_the_slopes(name: str, close: Callable[..., None]) -> None:
    integrator, g = method(name).build(name), bumps(2)
    close(integrator(8.0 * g), 8.0 * integrator(g))
    close(integrator(-g), -integrator(g))


def test_scales_with_the_pixels(name: str, close: Callable[..., None]) -> None:
    """Slopes have no unit: a pixel of 0.25 mm gives the height in mm, and its square shape changes nothing else."""
    g = bumps(2)
    z = method(name).build(name)(g)
    close(method(name).build(name, pixel_size=0.25)(g), 0.25 * z, 1e-9)
    close(method(name).build(name, pixel_size=(4.0, 4.0))(g), 4.0 * z, 1e-9)


def test_oblong_pixels(name: str, close: Callable[..., None]) -> None:
    if "plane_is_exact" in method(name).no:
        pytest.skip(method(name).no["plane_is_exact"])
    g, z = plane(0.3, -0.7, (16, 14), (0.5, 2.0))
    close(method(name).build(name, pixel_size=(0.5, 2.0))(g), z)


def test_follows_flips(name: str, close: Callable[..., None]) -> None:
    """Left to right (the slopes dz/dx change their sign), and upside down."""
    integrator, g = method(name).build(name), bumps(2)
    z = integrator(g)
    mirrored = g.flip(-1) * torch.tensor([-1.0, 1.0], dtype=g.dtype).view(1, 2, 1, 1)
    close(integrator(mirrored), z.flip(-1))
    upside_down = g.flip(-2) * torch.tensor([1.0, -1.0], dtype=g.dtype).view(1, 2, 1, 1)
    close(integrator(upside_down), z.flip(-2))


def test_follows_a_transpose(name: str, close: Callable[..., None]) -> None:
    integrator, g = method(name).build(name), bumps(2)
    close(integrator(g.flip(1).mT), integrator(g).mT)


def test_follows_a_quarter_turn(name: str, close: Callable[..., None]) -> None:
    """Columns become rows, and rows columns counted from the other end."""
    integrator, g = method(name).build(name), bumps(2)
    turned = torch.rot90(torch.stack([g[:, 1], -g[:, 0]], 1), 1, (-2, -1))
    close(integrator(turned), torch.rot90(integrator(g), 1, (-2, -1)))


# Masks, weights, anchors


@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS.keys())
def test_the_outside_never_leaks_in(name: str, close: Callable[..., None], mask: Callable[..., Tensor]) -> None:
    """NaN, infinite and wild values outside give the same heights and derivatives inside; outside is 0."""
    needs(name, "mask")
    integrator, g, inside = method(name).build(name), bumps(2), mask(16, 14)
    optional = everything(integrator, g) | {"mask": inside}
    z = integrator(g, **optional)
    assert z.isfinite().all()
    assert (z[~inside.expand_as(z)] == 0).all()
    for outside in (torch.nan, torch.inf, -1e30):
        filled = {k: v if k == "mask" else torch.where(inside, v, outside) for k, v in optional.items()}
        leaf = torch.where(inside, g, outside).requires_grad_()
        again = integrator(leaf, **filled)
        close(again.detach(), z, 1e-9)
        again.square().sum().backward()
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
        assert (leaf.grad[~inside.expand_as(g)] == 0).all()


def test_components_are_independent(name: str, close: Callable[..., None]) -> None:
    """Two islands: each as if the other were not there."""
    needs(name, "mask")
    integrator, g = method(name).build(name), bumps(1, 16, 28)
    left, right = torch.zeros(2, 1, 1, 16, 28, dtype=torch.bool)
    left[..., 1:15, 1:11] = True
    right[..., 2:14, 16:27] = True
    close(integrator(g, left | right), integrator(g, left) + integrator(g, right))


def test_full_mask_and_equal_weights_change_nothing(name: str, close: Callable[..., None]) -> None:
    integrator, g = method(name).build(name), bumps(2)
    expected = integrator(g)
    if "mask" in integrator.accepts:
        close(integrator(g, torch.ones(1, 1, 16, 14, dtype=torch.bool)), expected)
    if "weight" in integrator.accepts:
        close(integrator(g, weight=torch.ones(2, 1, 16, 14, dtype=g.dtype)), expected)
        close(integrator(g, weight=torch.ones(2, 2, 16, 14, dtype=g.dtype)), expected)


def test_weight_zero_ignores_a_sample(name: str, close: Callable[..., None]) -> None:
    needs(name, "weight")
    integrator, g = method(name).build(name), bumps(1)
    weight = torch.ones(1, 1, 16, 14, dtype=g.dtype)
    weight[..., 5, 6] = 0
    spoilt = g.clone()
    spoilt[..., 5, 6] = 40.0
    close(integrator(spoilt, weight=weight), integrator(g, weight=weight))


def test_firm_anchors_are_met(name: str) -> None:
    """Four known heights, trusted without limit; then the constant is no longer free."""
    needs(name, "anchor")
    integrator, g = method(name).build(name), bumps(1)
    anchor = torch.full((1, 1, 16, 14), torch.nan, dtype=g.dtype)
    trust = torch.zeros(1, 1, 16, 14, dtype=g.dtype)
    for (y, x), height in zip([(2, 3), (2, 11), (13, 3), (12, 12)], [5.0, 5.5, 6.0, 5.2], strict=True):
        anchor[..., y, x], trust[..., y, x] = height, 1e6
    z = integrator(g, anchor=anchor, anchor_weight=trust)
    known = trust > 0
    assert (z[known] - anchor[known]).abs().max() < 1e-3
    by_number = integrator(g, anchor=torch.full_like(trust, 3.0), anchor_weight=1e6)
    assert (by_number - 3).abs().max() < 1e-3


def test_anchor_weights_scale_with_the_pixels(name: str, close: Callable[..., None]) -> None:
    """The height in mm for anchors in mm: their trust, per mm squared, is another number but the same belief."""
    needs(name, "anchor")
    g, anchor = bumps(1), random_field(1, 1, 16, 14, seed=3)
    z = method(name).build(name)(g, anchor=anchor, anchor_weight=0.7)
    small = method(name).build(name, pixel_size=0.5)(g, anchor=0.5 * anchor, anchor_weight=0.7 / 0.5**2)
    close(small, 0.5 * z, 1e-8)


def test_is_quiet(name: str) -> None:
    """With the settings of this table no warning, not even about convergence."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        integrator, g = method(name).build(name), bumps(2)
        integrator(g, **everything(integrator, g))
