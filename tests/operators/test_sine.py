"""The sine transform against SciPy and against the matrix that it diagonalises."""

import pytest
import scipy.fft
import torch

from torchdls.operators import dirichlet_eigenvalues, dst2


def field(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 8), (63, 64), (80, 30), (100, 131)])
def test_equals_scipy(shape):
    x = field(2, 1, *shape)
    expected = torch.from_numpy(scipy.fft.dstn(x.numpy(), type=1, axes=(-2, -1), norm="ortho"))
    torch.testing.assert_close(dst2(x), expected)
    torch.testing.assert_close(dst2(dst2(x)), x)
    torch.testing.assert_close(dst2(x.float()), expected.float(), atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (0.5, 2.0)])
def test_diagonalises_the_dirichlet_laplacian(pixel_size):
    h, w = 6, 9
    dx, dy = pixel_size
    x = field(1, 1, h, w)
    padded = torch.nn.functional.pad(x, (1, 1, 1, 1))
    laplacian = (2 * x - padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / dx**2
    laplacian += (2 * x - padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / dy**2
    torch.testing.assert_close(dst2(laplacian), dirichlet_eigenvalues((h, w), x, pixel_size) * dst2(x))


@pytest.mark.parametrize("shape", [(4, 5), (66, 3)])
def test_gradcheck(shape):
    x = field(*shape).requires_grad_()
    assert torch.autograd.gradcheck(dst2, x, check_forward_ad=True)
