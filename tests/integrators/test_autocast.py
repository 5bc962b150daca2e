"""Inside `torch.autocast` an integrator gives what it gives outside, and trains there."""

import pytest
import torch

import torchdls
from tests.helpers import random_field
from tests.helpers.methods import bumps, everything, method
from torchdls import INTEGRATORS, SoupDIL, Unroll

pytestmark = pytest.mark.device
HALVES = [torch.bfloat16, torch.float16]


def autocast(dtype=torch.bfloat16):
    return torch.autocast(torch.empty(0).device.type, dtype=dtype)


def height_and_slopes(integrator, g, optional, inside, solve=False, backward=False):
    """The height, and the derivative of a fixed functional of it in every floating-point argument."""
    leaf = g.clone().requires_grad_()
    leaves = {k: v.clone().requires_grad_(v.is_floating_point()) for k, v in optional.items()}
    with autocast() if inside else torch.enable_grad():
        z = integrator.solve(leaf, **leaves).height if solve else integrator(leaf, **leaves)
        if backward:
            (z * random_field(*z.shape, seed=9, dtype=torch.float32)).sum().backward()
    if not backward:
        (z * random_field(*z.shape, seed=9, dtype=torch.float32)).sum().backward()
    return [z.detach(), *(t.grad for t in (leaf, *leaves.values()) if t.is_floating_point())]


@pytest.mark.parametrize("arguments", ["gradient", "everything"])
@pytest.mark.parametrize("name", INTEGRATORS)
def test_result_and_derivative_are_those_without(name, arguments):
    """Whether the backward pass is called inside as well or, as it should be, outside."""
    integrator, g = method(name).build(name), bumps(2).float()
    optional = everything(integrator, g) if arguments == "everything" else {}
    for solve in (False, True):
        without = height_and_slopes(integrator, g, optional, False, solve)
        for backward in (False, True):
            within = height_and_slopes(integrator, g, optional, True, solve, backward)
            for a, b in zip(within, without, strict=True):
                assert a.dtype == torch.float32
                assert torch.equal(a, b)


def test_what_stands_before_and_behind_keeps_its_autocast():
    """A backward pass inside is switched to full precision within the integrator, and nowhere else."""

    class Look(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, g):
            seen.append(torch.is_autocast_enabled(torch.empty(0).device.type))
            return g

    class Within(torchdls.LeastSquares):
        def _integrate(self, fields):
            return Look.apply(super()._integrate(fields))

    seen: list[bool] = []
    leaf = bumps(1).float().requires_grad_()
    with autocast():
        Look.apply(Within()(Look.apply(leaf))).sum().backward()
        assert torch.is_autocast_enabled(torch.empty(0).device.type)
    assert seen == [True, False, True]


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("name", INTEGRATORS)
def test_half_precision_is_taken_up(name, dtype):
    """As it leaves a layer: to float32 inside autocast, refused outside; float64 stays what it is."""
    integrator, g = method(name).build(name), bumps(2).to(dtype)
    optional = everything(integrator, g)
    with autocast(dtype):
        z = integrator(g, **optional)
        wide = integrator(bumps(1))
    expected = integrator(g.float(), **{k: v.float() if v.is_floating_point() else v for k, v in optional.items()})
    assert z.dtype == torch.float32
    assert torch.equal(z, expected)
    assert torch.equal(wide, integrator(bumps(1)))
    with pytest.raises(TypeError, match="float32 or float64 is needed"):
        integrator(g, **optional)


@pytest.mark.parametrize("options", [
    {"learner": "k_svd"}, {"learner": "unitary"}, {"learner": "dino_kat"}, {"learn": "fixed"},
    {"derivative": Unroll(checkpoint=True)},
    {"select": True}, {"height_step": "proximal"}, {"learn": "shared", "learner": SoupDIL("block")},
])  # fmt: skip
@pytest.mark.filterwarnings("ignore::torchdls.ConvergenceWarning")  # of a NaN, see below
def test_each_form_of_dls(options):
    integrator, g = torchdls.DLS(4, 2, 16, mu=0.3, n_iter=2, tol=0.0, **options), bumps(2).float()
    without = height_and_slopes(integrator, g, {}, False)
    for backward in (False, True):
        within = height_and_slopes(integrator, g, {}, True, backward=backward)
        for a, b in zip(within, without, strict=True):  # the derivative of an orthonormal dictionary may be NaN
            torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=options.get("learner") == "unitary")


def test_backward_of_a_solve_inside_autocast():
    """Not where it belongs, but the solves are as exact there."""
    g, mask = bumps(1).float(), torch.ones(1, 1, 16, 14, dtype=torch.bool).triu()
    grads = []
    for inside in (True, False):
        leaf = g.clone().requires_grad_()
        with autocast() if inside else torch.enable_grad():
            torchdls.LeastSquares()(leaf, mask).square().sum().backward()
        grads.append(leaf.grad)
    assert torch.equal(*grads)


@pytest.mark.parametrize("name", ["least_squares", "huber", "dls", "slope_dls"])
def test_a_convolution_in_front_of_it_trains(name):
    """Plane slopes from a noisy picture of them: the loss of the surface falls by half, in mixed precision."""
    torch_state = torch.random.get_rng_state()
    torch.manual_seed(0)
    net = torch.nn.Conv2d(2, 2, 3, padding=1)
    torch.random.set_rng_state(torch_state)
    integrator = method(name).build(name)
    g = bumps(2).float()
    truth = torchdls.LeastSquares()(g)
    optimizer = torch.optim.Adam(net.parameters(), 0.03)
    losses = []
    for _ in range(12):
        optimizer.zero_grad()
        with autocast():
            slopes = net(g)
            assert slopes.dtype == torch.bfloat16
            z = integrator(slopes)
        loss = (z - truth).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert all(p.grad.isfinite().all() for p in net.parameters())
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("integrator", [torchdls.LeastSquares(), torchdls.SlopeDLS.fast(patch_sizes=(8,), n_iter=1)])
def test_compiled_inside_autocast(integrator):
    g = bumps(1).float()
    compiled = torch.compile(integrator, backend="aot_eager")
    with autocast():
        z = compiled(g.bfloat16())
    torch.testing.assert_close(z, integrator(g.bfloat16().float()), rtol=1e-4, atol=1e-4)


def test_vmap_inside_autocast():
    g, long = bumps(3, 9, 8).float(), bumps(1, 140, 9).float()
    least = torchdls.LeastSquares()
    slopes = [
        torch.func.grad(lambda x: least(x).square().sum()),
        torch.func.vmap(torch.func.grad(lambda x: least(x).square().sum())),
        torch.func.grad(lambda x: torch.func.vmap(least)(x).square().sum()),
    ]
    with autocast():
        z = torch.func.vmap(least)(g.bfloat16())
        within = [slopes[0](long), *(f(g) for f in slopes)]
    torch.testing.assert_close(z, least(g.bfloat16().float()))
    for a, b in zip(within, [slopes[0](long), *(f(g) for f in slopes)], strict=True):
        torch.testing.assert_close(a, b)
