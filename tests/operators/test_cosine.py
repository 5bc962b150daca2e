"""Cosine transforms against SciPy and sums of cosines, from matrices to FFT, and the Laplacian they diagonalise."""

import numpy as np
import pytest
import scipy.fft
import torch

from tests.helpers import assert_adjoint, assert_gradients, random_field
from torchdls import GradientOperator, dct2, idct2
from torchdls.operators import cosine, neumann_eigenvalues

SHAPES = [(1, 1), (1, 5), (6, 1), (2, 3), (8, 8), (64, 64), (64, 65), (65, 64), (66, 3), (3, 67), (128, 97), (129, 130)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_dct_is_scipys_orthonormal_one(shape, monkeypatch):
    """By PyTorch, as where something is recorded."""
    monkeypatch.setattr(cosine, "plain", lambda _: False)
    x = random_field(2, 3, *shape)
    expected = scipy.fft.dctn(x.numpy(), type=2, norm="ortho", axes=(-2, -1))
    np.testing.assert_allclose(dct2(x).numpy(), expected, atol=1e-11)
    np.testing.assert_allclose(idct2(x).numpy(), scipy.fft.idctn(x.numpy(), norm="ortho", axes=(-2, -1)), atol=1e-11)
    torch.testing.assert_close(idct2(dct2(x)), x, rtol=0, atol=1e-11)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("shape", [(65, 64), (3, 67), (129, 70)], ids=str)
def test_where_scipy_does_it_sums_of_cosines_come_out(shape, threads):
    x, gain = random_field(2, 3, *shape), random_field(*shape, seed=1)
    rows, columns = (cosine.cosine_matrix(n, like=x) for n in shape)
    assert cosine.plain(x)
    assert not cosine.plain(x.clone().requires_grad_())
    torch.set_num_threads(threads)
    try:
        there, back, both = dct2(x), idct2(x), cosine.filtered(x, gain)
    finally:
        torch.set_num_threads(1)
    torch.testing.assert_close(there, rows @ x @ columns.mT, rtol=0, atol=1e-11)
    torch.testing.assert_close(back, rows.mT @ x @ columns, rtol=0, atol=1e-11)
    torch.testing.assert_close(both, rows.mT @ (gain * (rows @ x @ columns.mT)) @ columns, rtol=0, atol=1e-11)


@pytest.mark.parametrize("shape", [(5, 4), (70, 3), (67, 66)], ids=str)
def test_inverse_is_the_transpose(shape):
    assert_adjoint(dct2, idct2, random_field(2, 1, *shape), random_field(2, 1, *shape, seed=1), tol=1e-11)


def test_derivatives_of_the_fft_form():
    x = random_field(1, 1, 65, 2)
    assert_gradients(lambda s: dct2(s * x), random_field(1, seed=1), forward=True)
    assert_gradients(lambda s: idct2(s * x), random_field(1, seed=1), forward=True)


@pytest.mark.parametrize("shape", [(20, 30), (100, 90)], ids=str)
def test_float32_is_accurate_and_stays_float32(shape):
    x = random_field(1, 1, *shape)
    small = dct2(x.float())
    assert small.dtype == torch.float32
    assert (small.double() - dct2(x)).abs().max() < 2e-5
    assert (idct2(small).double() - x).abs().max() < 2e-5


def test_transforms_take_views_and_leave_them_alone():
    x = random_field(1, 1, 90, 80)
    view = x.mT[..., ::2, 5:71]
    before = x.clone()
    torch.testing.assert_close(dct2(view), dct2(view.contiguous()))
    torch.testing.assert_close(idct2(view), idct2(view.contiguous()))
    assert torch.equal(x, before)


@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 3.0)], ids=str)
@pytest.mark.parametrize("stencil", ["forward", "backward"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (9, 7), (70, 66)], ids=str)
def test_dct_diagonalises_the_neumann_laplacian(shape, stencil, pixel_size):
    A = GradientOperator(stencil, pixel_size)
    z = random_field(1, 1, *shape)
    eigenvalues = neumann_eigenvalues(shape, z, pixel_size)
    assert eigenvalues[0, 0] == 0
    assert (eigenvalues.flatten()[1:] > 0).all()
    torch.testing.assert_close(dct2(A.adjoint(A(z))), eigenvalues * dct2(z), rtol=1e-9, atol=1e-9)


def test_eigenvalues_are_built_in_float64():
    like = torch.zeros((), dtype=torch.float32)
    expected = neumann_eigenvalues((700, 900), like.double())
    torch.testing.assert_close(neumann_eigenvalues((700, 900), like).double(), expected, rtol=1e-7, atol=0)
