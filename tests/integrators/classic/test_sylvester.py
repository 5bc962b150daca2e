"""Global least squares against SciPy's Sylvester solver and dense least squares, and its exactness and order."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from scipy.linalg import solve_sylvester

from torchdls import HarkerOLeary, SpectralRegularization, TikhonovRegularization
from torchdls.operators.local_polynomials import cosine_basis, derivative_matrix, polynomial_basis

F64 = torch.zeros((), dtype=torch.float64)
SIZES = [(7, 7), (8, 11), (12, 5), (16, 16)]


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def derivatives(shape, support=3, degree=None, steps=(1.0, 1.0)):
    """D_y and D_x as NumPy arrays."""
    return [
        derivative_matrix(n, support, degree, d, like=F64).numpy() for n, d in zip(shape, reversed(steps), strict=True)
    ]


def dense(gradient, A_y, A_x, b_y, b_x, basis_y=None, basis_x=None):
    """argmin ||A_y Z - b_y||^2 + ||Z A_x^T - b_x||^2 over Z = B_y C B_x^T, the shortest one."""
    B_y = np.eye(A_y.shape[1]) if basis_y is None else basis_y
    B_x = np.eye(A_x.shape[1]) if basis_x is None else basis_x
    matrix = np.concatenate([np.kron(A_y @ B_y, B_x), np.kron(B_y, A_x @ B_x)])
    c = np.linalg.lstsq(matrix, np.concatenate([b_y.ravel(), b_x.ravel()]), rcond=1e-10)[0]
    return B_y @ c.reshape(B_y.shape[1], B_x.shape[1]) @ B_x.T


# --- the matrices --------------------------------------------------------------------------------------------------


def test_three_points():
    D = derivative_matrix(5, like=F64) * 2
    expected = [[-3, 4, -1, 0, 0], [-1, 0, 1, 0, 0], [0, -1, 0, 1, 0], [0, 0, -1, 0, 1], [0, 0, 1, -4, 3]]
    torch.testing.assert_close(D, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("n, support, degree", [(12, 3, 1), (12, 5, 2), (13, 5, 4), (20, 9, 8), (4, 7, 6), (2, 3, 2)])
def test_derivative_of_polynomials(n, support, degree):
    x = torch.linspace(-1, 1, n, dtype=torch.float64)
    D = derivative_matrix(n, support, degree, 2 / (n - 1), like=F64)
    for k in range(min(degree, n - 1) + 1):
        torch.testing.assert_close(D @ x**k, k * x ** max(k - 1, 0), atol=1e-10, rtol=1e-10)


def test_a_line_of_one_sample_has_no_slope():
    assert derivative_matrix(1, like=F64).item() == 0


@pytest.mark.parametrize("basis", [cosine_basis, polynomial_basis])
@pytest.mark.parametrize("n, modes", [(1, 1), (9, 9), (64, 64), (65, 20)])
def test_bases_are_orthonormal_and_alternate(basis, n, modes):
    B = basis(n, modes)
    torch.testing.assert_close(B.mT @ B, torch.eye(modes, dtype=torch.float64), atol=1e-12, rtol=0)
    signs = (-1.0) ** torch.arange(modes)
    torch.testing.assert_close(B.flip(0), B * signs, atol=1e-12, rtol=0)


def test_polynomial_basis_spans_polynomials():
    x = torch.linspace(-1, 1, 30, dtype=torch.float64)
    B = polynomial_basis(30, 6)
    torch.testing.assert_close(B @ (B.mT @ x**5), x**5)


# --- the solutions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("support, degree", [(3, None), (5, None), (5, 2), (5, 3), (3, 1)])
def test_harker_oleary_equals_dense_least_squares(shape, support, degree):
    g = noise(1, 2, *shape)
    D_y, D_x = derivatives(shape, support, degree)
    z = HarkerOLeary(support, degree)(g)
    expected = dense(g, D_y, D_x, g[0, 1].numpy(), g[0, 0].numpy())
    torch.testing.assert_close(z[0, 0], torch.from_numpy(expected), atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("shape", [(9, 9), (32, 21)])
@pytest.mark.parametrize("pixel_size", [1.0, (0.5, 2.0)])
def test_harker_oleary_solves_the_sylvester_equation(shape, pixel_size):
    """SciPy's solver needs a regular equation: r Z on top makes it one, and is taken back as a part of the right."""
    g = noise(1, 2, *shape)
    dx, dy = (pixel_size, pixel_size) if isinstance(pixel_size, float) else pixel_size
    D_y, D_x = derivatives(shape, steps=(dx, dy))
    z = HarkerOLeary(pixel_size=pixel_size)(g)[0, 0].numpy()
    right = D_y.T @ g[0, 1].numpy() + g[0, 0].numpy() @ D_x + z
    expected = solve_sylvester(D_y.T @ D_y + np.eye(shape[0]), D_x.T @ D_x, right)
    np.testing.assert_allclose(z, expected, atol=1e-9)


@pytest.mark.parametrize("shape", [(8, 11), (13, 9)])
@pytest.mark.parametrize("basis", ["cosine", "polynomial"])
@pytest.mark.parametrize("modes", [(3, 4), (6, 6), (1, 5), 0.5])
def test_spectral_regularization_equals_dense_least_squares(shape, basis, modes):
    g = noise(1, 2, *shape)
    z = SpectralRegularization(modes, basis)(g)
    counts = [round(modes * n) for n in shape] if isinstance(modes, float) else modes
    build = {"cosine": cosine_basis, "polynomial": polynomial_basis}[basis]
    B_y, B_x = (build(n, k).numpy() for n, k in zip(shape, counts, strict=True))
    D_y, D_x = derivatives(shape)
    expected = dense(g, D_y, D_x, g[0, 1].numpy(), g[0, 0].numpy(), B_y, B_x)
    torch.testing.assert_close(z[0, 0], torch.from_numpy(expected), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("basis", ["cosine", "polynomial"])
def test_all_modes_are_global_least_squares(basis):
    g = noise(2, 2, 14, 17)
    torch.testing.assert_close(SpectralRegularization(1.0, basis)(g), HarkerOLeary()(g))


@pytest.mark.parametrize("shape", [(9, 9), (8, 13)])
@pytest.mark.parametrize("order, lam, with_prior", [*product([0, 1, 2], [0.1, 3.0], [False, True])])
def test_tikhonov_equals_dense_least_squares_and_scipy(shape, order, lam, with_prior):
    g, z0 = noise(1, 2, *shape), noise(1, 1, *shape, seed=1) if with_prior else None
    z = TikhonovRegularization(lam, order)(g, prior=z0)[0, 0].numpy()
    D = derivatives(shape)
    S = [np.linalg.matrix_power(d, order) for d in D]
    prior = np.zeros(shape) if z0 is None else z0[0, 0].numpy()
    A_y, A_x = (np.concatenate([d, math.sqrt(lam) * s]) for d, s in zip(D, S, strict=True))
    b_y = np.concatenate([g[0, 1].numpy(), math.sqrt(lam) * S[0] @ prior])
    b_x = np.concatenate([g[0, 0].numpy(), math.sqrt(lam) * prior @ S[1].T], 1)
    expected = dense(g, A_y, A_x, b_y, b_x)
    expected += prior.mean() - expected.mean() if order else 0
    np.testing.assert_allclose(z, expected, atol=1e-8)
    sylvester = solve_sylvester(A_y.T @ A_y + np.eye(shape[0]), A_x.T @ A_x, A_y.T @ b_y + b_x @ A_x + z)
    np.testing.assert_allclose(z, sylvester, atol=1e-9)


def test_without_penalty_tikhonov_is_global_least_squares():
    g = noise(1, 2, 10, 12)
    torch.testing.assert_close(TikhonovRegularization(0.0)(g), HarkerOLeary()(g))


# --- exactness and order -------------------------------------------------------------------------------------------


def sampled(n, f):
    """Heights and slopes of f(x, y) on [0, 1]^2 at n x n points, with the spacing."""
    x = torch.linspace(0, 1, n, dtype=torch.float64)
    y, x = torch.meshgrid(x, x, indexing="ij")
    with torch.enable_grad():
        x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
        z = f(x, y)
        gx, gy = torch.autograd.grad(z.sum(), (x, y))
    return (z - z.mean()).detach()[None, None], torch.stack([gx, gy])[None], 1 / (n - 1)


@pytest.mark.parametrize("support, degree", [(3, 2), (5, 4), (7, 6)])
def test_polynomials_up_to_the_degree_are_exact(support, degree):
    z, g, step = sampled(16, lambda x, y: (1 + x - 2 * y) ** degree)
    torch.testing.assert_close(HarkerOLeary(support, degree, pixel_size=step)(g), z, atol=1e-8, rtol=0)


@pytest.mark.parametrize("method", [SpectralRegularization(3, "polynomial"), TikhonovRegularization(1.0, 2)])
def test_planes_are_exact(method):
    z, g, step = sampled(16, lambda x, y: 3 * x - 2 * y)
    torch.testing.assert_close(method(g) * step, z, atol=1e-9, rtol=0)


def test_polynomial_modes_hold_a_quadratic():
    z, g, step = sampled(20, lambda x, y: x * y - y**2)
    torch.testing.assert_close(SpectralRegularization(3, "polynomial", pixel_size=step)(g), z, atol=1e-9, rtol=0)


@pytest.mark.parametrize("support, order", [(3, 2), (5, 4)])
def test_convergence_rate(support, order):
    sizes, errors = [20, 40, 80, 160], []
    for n in sizes:
        z, g, step = sampled(n, lambda x, y: torch.sin(3 * x + y) * torch.exp(x - y))
        errors.append((HarkerOLeary(support, pixel_size=step)(g) - z).square().mean().sqrt().item())
    rate = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert rate == pytest.approx(order, abs=0.35)


# --- the call ------------------------------------------------------------------------------------------------------

METHODS = [
    HarkerOLeary(5),
    SpectralRegularization(0.5),
    SpectralRegularization(4, "polynomial"),
    TikhonovRegularization(0.3),
]


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_derivatives(method):
    g = noise(1, 2, 5, 4).requires_grad_()
    assert torch.autograd.gradcheck(method, g, check_forward_ad=True)


def test_derivative_in_the_prior():
    g, z0 = noise(1, 2, 5, 6), noise(1, 1, 5, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: TikhonovRegularization()(g, prior=p), z0)


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("with_prior", [False, True])
def test_derivatives_in_lam(order, with_prior):
    """First, second and mixed derivatives, reverse and forward, also through function transforms."""
    g, z0 = noise(1, 2, 4, 3).requires_grad_(), noise(1, 1, 4, 3, seed=1) if with_prior else None
    lam = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def height(g, lam):
        return torch.func.functional_call(method, {"lam": lam}, (g,), {"prior": z0})

    method = TikhonovRegularization(torch.nn.Parameter(lam.detach()), order)
    assert torch.autograd.gradcheck(height, (g, lam), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(height, (g, lam), fast_mode=True)
    expected = torch.autograd.functional.jacobian(lambda lam: height(g, lam), lam)
    torch.testing.assert_close(torch.func.jacrev(height, 1)(g, lam), expected)
    torch.testing.assert_close(torch.func.jacfwd(height, 1)(g, lam), expected)
    torch.testing.assert_close(method(g, prior=z0), TikhonovRegularization(0.3, order)(g, prior=z0))


def test_lam_is_trained_or_kept_with_the_module():
    g = noise(1, 2, 9, 8)
    trained = TikhonovRegularization(torch.nn.Parameter(torch.tensor(0.2)))
    trained(g).square().sum().backward()
    assert trained.lam.grad < 0
    kept = TikhonovRegularization(torch.tensor(0.2, dtype=torch.float64))
    assert "lam" in kept.state_dict()
    torch.testing.assert_close(kept(g), TikhonovRegularization(0.2)(g))


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_single_precision(method):
    g = noise(2, 2, 40, 33)
    torch.testing.assert_close(method(g.float()), method(g).float(), atol=1e-4, rtol=1e-4)


def test_prior_is_scaled_and_may_be_single():
    g, z0 = noise(2, 9, 8), noise(1, 9, 8, seed=1)
    method = TikhonovRegularization(0.7, 0)
    z = method(g, prior=z0)
    torch.testing.assert_close(TikhonovRegularization(0.7, 0, pixel_size=3.0)(g, prior=3 * z0), 3 * z)
    torch.testing.assert_close(method(g[None], prior=z0[None])[0], z)
    strong = TikhonovRegularization(1e9, 0)(g, prior=z0)
    torch.testing.assert_close(strong, z0, atol=1e-6, rtol=0)


def test_bad_prior():
    g, method = noise(2, 9, 8), TikhonovRegularization()
    with pytest.raises(
        ValueError, match=r"TikhonovRegularization: gradient \(2, 9, 8\) and prior \(1, 9, 7\) differ in width"
    ):
        method(g, prior=noise(1, 9, 7))
    with pytest.raises(ValueError, match=r"prior \(1, 9, 8\) is not finite"):
        method(g, prior=noise(1, 9, 8) / 0)
    with pytest.raises(TypeError, match="prior is a float"):
        method(g, prior=1.0)


@pytest.mark.parametrize("method", [HarkerOLeary(), SpectralRegularization(), TikhonovRegularization()])
def test_refuses_what_it_cannot_honour(method):
    g, name = noise(2, 9, 8), type(method).__name__
    with pytest.raises(ValueError, match=f"{name}: takes no mask"):
        method(g, mask=torch.ones(1, 9, 8, dtype=torch.bool))
    with pytest.raises(ValueError, match=f"{name}: takes no weight"):
        method(g, weight=torch.ones(1, 9, 8))
    with pytest.raises(ValueError, match=f"{name}: takes no anchor"):
        method(g, anchor=torch.ones(1, 9, 8), anchor_weight=1.0)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: HarkerOLeary(4), "support=4"),
        (lambda: HarkerOLeary(3, 3), "degree=3"),
        (lambda: SpectralRegularization(0), "modes=0"),
        (lambda: SpectralRegularization(1.5), "modes=1.5"),
        (lambda: SpectralRegularization(basis="haar"), "basis='haar'"),
        (lambda: SpectralRegularization(10)(noise(2, 9, 12)), "modes=10 given for 9 rows"),
        (lambda: TikhonovRegularization(-1.0), "lam=-1.0"),
        (lambda: TikhonovRegularization(torch.ones(2)), "lam=tensor"),
        (lambda: TikhonovRegularization(order=3), "order=3"),
    ],
)
def test_bad_options(build, message):
    with pytest.raises(ValueError, match=message):
        build()
