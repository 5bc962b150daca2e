"""pytest-benchmark suites: `python -m pytest benchmarks/speed/bench_core.py --benchmark-group-by=func`."""

import pytest
import torch

from torchdls import DLS, GradientOperator, LeastSquares, Patches, add_noise, dct2, dct_dictionary, solve
from torchdls.dictionary.soup_dil import residual_sweep
from torchdls.surfaces import SURFACES

SIZES = [(1, 64), (16, 64), (64, 64), (1, 256), (4, 256), (1, 512), (1, 1024), (1, 2048)]
SMALL = [case for case in SIZES if case[1] <= 512]
DTYPES = [torch.float32, torch.float64]

sizes = pytest.mark.parametrize("n, size", SIZES)
small = pytest.mark.parametrize("n, size", SMALL)
dtypes = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])


def field(n, size, dtype):
    surface = SURFACES["tent"](size, dtype=dtype)
    return add_noise(surface.gradient.expand(n, -1, -1, -1), 10, generator=torch.Generator().manual_seed(0))


@sizes
@dtypes
def test_dct2(benchmark, n, size, dtype):
    benchmark(dct2, field(n, size, dtype)[:, :1])


@sizes
@dtypes
def test_gradient_and_adjoint(benchmark, n, size, dtype):
    a, z = GradientOperator(), field(n, size, dtype)[:, :1]
    benchmark(lambda: a.adjoint(a(z)))


@small
@dtypes
def test_patches_and_adjoint(benchmark, n, size, dtype):
    patches, z = Patches(), field(n, size, dtype)[:, :1]
    benchmark(lambda: patches.adjoint(patches.extract(z), z.shape))


@sizes
@dtypes
def test_least_squares(benchmark, n, size, dtype):
    benchmark(LeastSquares(), field(n, size, dtype))


@small
@dtypes
def test_least_squares_backward(benchmark, n, size, dtype):
    g, method = field(n, size, dtype).requires_grad_(), LeastSquares()
    benchmark(lambda: torch.autograd.grad(method(g).square().sum(), g))


@small
def test_anchored_solve(benchmark, n, size):
    v = field(n, size, torch.float32)
    strength = 32.0 + v[:, :1].abs()
    benchmark(lambda: solve(v, None, v[:, :1], strength))


@small
@pytest.mark.parametrize("order", ["atom", "block"])
def test_sweep(benchmark, n, size, order):
    P = Patches().extract(LeastSquares()(field(n, size, torch.float32)))
    D = dct_dictionary(8, 64).expand(n, -1, -1)
    state = P.clone(), D, torch.zeros(n, 64, P.shape[-1])

    def run():
        nonlocal state
        state = residual_sweep(*state, 0.2, order=order)

    benchmark(run)


@small
def test_dls(benchmark, n, size):
    dls, g = DLS(n_iter=3, tol=0.0), field(n, size, torch.float32)
    with torch.no_grad():
        benchmark(dls, g)


@pytest.mark.parametrize("n, size", [(1, 64), (16, 64), (1, 256)])
def test_dls_backward(benchmark, n, size):
    dls, g = DLS(n_iter=2, tol=0.0), field(n, size, torch.float32).requires_grad_()
    benchmark(lambda: torch.autograd.grad(dls(g).square().sum(), g))
