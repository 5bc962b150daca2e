"""Frankot-Chellappa, line integrals, Horn-Brooks and known borders, against closed forms and dense solutions."""

import math

import numpy as np
import pytest
import torch

from torchdls import SURFACES, FrankotChellappa, GradientOperator, HornBrooks, LeastSquares, LineIntegral, edge_slopes
from torchdls.metrics import rmse
from torchdls.noise import averaging_error, noise_sigma
from torchdls.solvers import ConvergenceWarning


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def sampled(shape, f, *, periodic=False):
    """Heights and slopes of f(x, y) on [0, 1]^2, without their mean, and the pixel size; a period ends before 1."""
    steps = [1 / n if periodic else 1 / (n - 1) for n in shape]
    axes = [torch.arange(n, dtype=torch.float64) * d for n, d in zip(shape, steps, strict=True)]
    y, x = torch.meshgrid(*axes, indexing="ij")
    x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
    z = f(x, y)
    gradient = torch.stack(torch.autograd.grad(z.sum(), (x, y)))[None]
    return (z - z.mean()).detach()[None, None], gradient, (steps[1], steps[0])


def smooth(x, y):
    return torch.sin(3 * x + y) * torch.exp(x - y)


def rate(method, f=smooth, sizes=(16, 32, 64, 128), **options):
    """Order of convergence: minus the slope of log error over log size."""
    errors = []
    for n in sizes:
        z, g, step = sampled((n, n), f)
        errors.append((method(**options, pixel_size=step)(g) - z).square().mean().sqrt().item())
    return -np.polyfit(np.log(sizes), np.log(errors), 1)[0]


# --- Frankot-Chellappa ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(16, 16), (15, 16), (21, 17)])
def test_a_periodic_surface_is_exact(shape):
    t = 2 * math.pi
    z, g, step = sampled(shape, lambda x, y: torch.sin(t * (2 * x - y)) + torch.cos(t * (x + 3 * y)), periodic=True)
    torch.testing.assert_close(FrankotChellappa(pixel_size=step)(g), z, atol=1e-12, rtol=0)


def test_a_noisy_periodic_field_is_projected():
    """The slopes of the result, by its own derivative, leave a residual without divergence."""
    g = noise(1, 2, 9, 11)
    z = FrankotChellappa()(g)
    wx, wy = 2 * math.pi * torch.fft.fftfreq(11).double(), 2 * math.pi * torch.fft.fftfreq(9).double()[:, None]
    G, Z = torch.fft.fft2(g), torch.fft.fft2(z)
    residual = torch.stack([G[0, 0] - 1j * wx * Z[0, 0], G[0, 1] - 1j * wy * Z[0, 0]])
    divergence = wx * residual[0] + wy * residual[1]
    assert divergence.abs().max() < 1e-5  # frequencies above are in single precision


@pytest.mark.parametrize("shape", [(16, 16), (17, 12)])
def test_mirrored_equals_periodic_on_the_reflected_field(shape):
    h, w = shape
    g = noise(1, 2, *shape)
    gx = torch.cat([g[:, :1], -g[:, :1].flip(-1)], -1)
    gy = torch.cat([g[:, 1:], g[:, 1:].flip(-1)], -1)
    full = torch.cat([torch.cat([gx, gx.flip(-2)], -2), torch.cat([gy, -gy.flip(-2)], -2)], 1)
    torch.testing.assert_close(FrankotChellappa("mirrored")(g), FrankotChellappa()(full)[..., :h, :w])


@pytest.mark.parametrize("n", [16, 65, 200])
def test_mirrored_plane_as_documented(n):
    slope = 2.0
    g = torch.tensor([slope, 0.0], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, n, n)
    z = slope * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2)
    error = (FrankotChellappa("mirrored")(g) - z).abs()
    assert error.max() < slope / 8
    assert error[..., n // 4 : -n // 4].max() < slope / n
    assert FrankotChellappa()(g).abs().max() < 1e-12


def test_mirrored_converges_where_periodic_does_not():
    assert rate(FrankotChellappa, extension="mirrored") > 1.3
    assert rate(FrankotChellappa) < 0.2


# --- line integrals ------------------------------------------------------------------------------------------------


def test_line_integral_is_the_average_over_paths():
    h, w = 4, 5
    g = noise(1, 2, h, w)
    (vx, vy), total = edge_slopes(g)[0][0], torch.zeros(h, w, dtype=torch.float64)

    def along(v, a, b):
        return v[a:b].sum() if a <= b else -v[b:a].sum()

    for r in range(h):
        for c in range(w):
            for i in range(h):
                for j in range(w):
                    total[i, j] += along(vx[r], c, j) + along(vy[:, j], r, i)
                    total[i, j] += along(vy[:, c], r, i) + along(vx[i], c, j)
    expected = total / (2 * h * w)
    torch.testing.assert_close(LineIntegral()(g)[0, 0], expected - expected.mean())


@pytest.mark.parametrize("shape", [(16, 16), (7, 12)])
@pytest.mark.parametrize("method", [LeastSquares, LineIntegral])
def test_quadratics_are_exact(method, shape):
    z, g, step = sampled(shape, lambda x, y: x**2 - 3 * x * y + 2 * y**2 + x)
    torch.testing.assert_close(method(pixel_size=step)(g), z, atol=1e-12, rtol=0)


@pytest.mark.parametrize("method", [LeastSquares, LineIntegral])
def test_second_order(method):
    assert rate(method) == pytest.approx(2, abs=0.2)


# --- Horn-Brooks ---------------------------------------------------------------------------------------------------


def disk(h, w):
    y, x = torch.meshgrid(torch.arange(h) - (h - 1) / 2, torch.arange(w) - (w - 1) / 2, indexing="ij")
    return ((x / w) ** 2 + (y / h) ** 2 < 0.2)[None, None] & ((x - 2).abs() + y.abs() > 1)


def test_plain_horn_brooks_tends_to_least_squares():
    g = noise(2, 2, 6, 7)
    torch.testing.assert_close(HornBrooks(1e-8)(g), LeastSquares()(g), atol=1e-6, rtol=0)


def test_horn_brooks_tends_to_least_squares():
    h, w = 8, 11
    g, mask, weight = noise(2, 2, h, w), disk(h, w), noise(2, 2, h, w, seed=1).square() + 0.1
    anchor, trust = noise(2, 1, h, w, seed=2), (noise(2, 1, h, w, seed=3) > 1).double()
    plain = HornBrooks(1e-8, relaxation=1.6, pixel_size=(0.5, 2.0))
    direct = LeastSquares(1e-12, pixel_size=(0.5, 2.0))
    for options in [
        {},
        {"mask": mask},
        {"weight": weight},
        {"mask": mask, "weight": weight, "anchor": anchor, "anchor_weight": trust},
        {"anchor": anchor, "anchor_weight": 0.1},
    ]:
        torch.testing.assert_close(plain(g, **options), direct(g, **options), atol=1e-6, rtol=0)


def test_horn_brooks_says_when_it_did_not_arrive():
    with pytest.warns(ConvergenceWarning, match="HornBrooks: 1 of 2 surfaces above tol=1e-06 after 3 iterations"):
        HornBrooks(max_iter=3)(torch.stack([noise(2, 9, 9), torch.zeros(2, 9, 9).double()]))


def test_horn_brooks_derivative_is_exact():
    g = noise(1, 2, 3, 3).requires_grad_()
    assert torch.autograd.gradcheck(HornBrooks(1e-10, relaxation=1.3), g)


# --- known borders -------------------------------------------------------------------------------------------------


def dense_dirichlet(g, steps, known, held, mask=None, weight=None, r=None, a=None):
    """The minimiser of (*) over the pixels that are not known, by dense normal equations."""
    h, w = g.shape[-2:]
    A = GradientOperator("forward", steps)
    matrix = A(torch.eye(h * w, dtype=torch.float64).view(-1, 1, h, w)).flatten(1).T
    inside = torch.ones(1, 1, h, w, dtype=torch.bool) if mask is None else mask
    error = None if weight is None else averaging_error(g, inside, weight, steps)
    v, t = edge_slopes(g, inside, weight, error=error)
    inside = (torch.ones_like(known) if mask is None else mask).flatten()
    free, fixed = inside & ~known.flatten(), held.flatten().clone()
    W = t.flatten()[:, None]
    H, b = matrix.T @ (W * matrix), matrix.T @ (t * v).flatten()
    if r is not None:
        H, b = H + r.flatten().diag(), b + (r * a).flatten()
    z = fixed * known.flatten()
    z[free] = torch.linalg.solve(H[free][:, free], (b - H @ z)[free])
    return z.view(1, 1, h, w)


def frame(h, w):
    known = torch.ones(1, 1, h, w, dtype=torch.bool)
    known[..., 1:-1, 1:-1] = False
    return known


@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 2.0)])
@pytest.mark.parametrize("shape", [(8, 11), (3, 5)])
@pytest.mark.parametrize("case", ["zero", "held", "held and pulled", "sparse", "weighted"])
def test_dirichlet_equals_dense(case, shape, pixel_size):
    g, anchor = noise(1, 2, *shape), noise(1, 1, *shape, seed=1)
    known = frame(*shape)
    options, dense = {}, {"held": torch.zeros_like(anchor)}
    if case != "zero":
        trust = {"held": known.double(), "held and pulled": torch.full_like(anchor, 0.3)}.get(case)
        trust = known.double() + 0.7 * (noise(1, 1, *shape, seed=2) > 1) if trust is None else trust
        options = {"anchor": anchor, "anchor_weight": 0.3 if case == "held and pulled" else trust}
        dense = {"held": anchor, "r": trust, "a": anchor}
    if case == "weighted":
        options["weight"] = dense["weight"] = noise(1, 2, *shape, seed=3).square()
    method = LeastSquares(1e-12, boundary="dirichlet", pixel_size=pixel_size)
    torch.testing.assert_close(method(g, **options), dense_dirichlet(g, pixel_size, known, **dense), atol=1e-9, rtol=0)


def test_dirichlet_on_a_mask_equals_dense():
    h, w = 12, 14
    g, anchor, mask = noise(1, 2, h, w), noise(1, 1, h, w, seed=1), disk(h, w)
    inner = mask.clone()
    for shift, dim in [(1, -1), (-1, -1), (1, -2), (-1, -2)]:
        inner &= mask.roll(shift, dim)  # the disk is clear of the image's border
    known = mask & ~inner
    g = torch.where(mask, g, torch.nan)
    z = LeastSquares(1e-12, boundary="dirichlet")(g, mask=mask, anchor=anchor, anchor_weight=known.double())
    expected = dense_dirichlet(g.nan_to_num(), (1.0, 1.0), known, anchor, mask, None, known.double(), anchor)
    torch.testing.assert_close(z, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (2, 2)])
def test_all_border(shape):
    g, anchor = noise(1, 2, *shape), noise(1, 1, *shape, seed=1)
    method = LeastSquares(boundary="dirichlet")
    torch.testing.assert_close(method(g, anchor=anchor, anchor_weight=1.0), anchor)
    assert (method(g, weight=torch.ones_like(g)) == 0).all()


def test_dirichlet_of_a_harmonic_surface_is_exact():
    z, g, step = sampled((20, 30), lambda x, y: x**2 - y**2 + x)
    method = LeastSquares(boundary="dirichlet", pixel_size=step)
    torch.testing.assert_close(method(g, anchor=z, anchor_weight=frame(20, 30).double()), z, atol=1e-12, rtol=0)


@pytest.mark.parametrize("weighted", [False, True])
def test_dirichlet_derivatives(weighted):
    g, anchor = noise(1, 2, 4, 5).requires_grad_(), noise(1, 1, 4, 5, seed=1).requires_grad_()
    weight = noise(1, 2, 4, 5, seed=2).square() + 0.1 if weighted else None
    method = LeastSquares(1e-13, boundary="dirichlet")

    def f(g, a):
        return method(g, weight=weight, anchor=a, anchor_weight=frame(4, 5).double())

    assert torch.autograd.gradcheck(f, (g, anchor))


def test_dirichlet_is_no_data_term():
    from torchdls import DLS

    with pytest.raises(ValueError, match="not built on the weighted solve"):
        DLS(data_term=LeastSquares(boundary="dirichlet"))


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: LeastSquares(boundary="even"), "boundary='even' is unknown"),
        (lambda: FrankotChellappa("even"), "extension='even' is unknown"),
        (lambda: HornBrooks(relaxation=2.0), "relaxation=2.0"),
        (lambda: HornBrooks(max_iter=0), "max_iter=0"),
        (lambda: FrankotChellappa()(noise(2, 5, 5), weight=noise(1, 5, 5)), "FrankotChellappa: takes no weight"),
        (lambda: LineIntegral()(noise(2, 5, 5), mask=noise(1, 5, 5) > 0), "LineIntegral: takes no mask"),
    ],
)
def test_bad_options(build, message):
    with pytest.raises(ValueError, match=message):
        build()


# --- weights ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tent", "vase", "peaks", "cone", "fractal"])
def test_true_inverse_variances_help(name):
    """Noise of 1:25 from pixel to pixel, of 1:8 from half to half: never worse, and better where noise rules."""
    surface = SURFACES[name](48, dtype=torch.float64)
    generator = torch.Generator().manual_seed(7)
    wild = (3.2 * torch.rand(1, 1, 48, 48, generator=generator, dtype=torch.float64) - 1.6).exp()
    halves = torch.where(torch.arange(48) < 24, 1.0, 8.0).double().expand(1, 1, 48, 48)
    for sd, gain in ((wild, 1.1), (halves, 1.0)):
        sd = sd / sd.square().mean().sqrt()
        for snr in (5, 20, 40):
            noise_ = torch.randn(12, 2, 48, 48, generator=generator, dtype=torch.float64)
            g = surface.gradient + noise_sigma(surface.gradient, snr) * sd * noise_
            weight = sd.square().reciprocal().expand(12, -1, -1, -1)
            plain, weighted = (rmse(z, surface.height.expand_as(z)).mean() for z in
                               (LeastSquares()(g), LeastSquares()(g, weight=weight)))  # fmt: skip
            assert plain / weighted > (gain if snr == 5 else 0.995), (snr, float(plain / weighted))
