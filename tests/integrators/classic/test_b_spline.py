"""BSpline against dense least squares over SciPy's splines, and where it is exact."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline as SciPySpline

from tests.helpers import assert_gradients, random_field
from torchdls import BSpline


def design(n, spacing, x=None):
    """Values and derivatives of cubic splines with equal knots from pixel 0 to n - 1, at x (the pixels, if None)."""
    pieces = min(int((n - 1) / spacing), n - 3)
    step = (n - 1) / pieces
    knots = step * np.arange(-3, pieces + 4)
    spline = SciPySpline(knots, np.eye(pieces + 3), 3)
    at = np.arange(n) if x is None else x
    return spline(at), spline.derivative()(at)


def dense(g, spacing, steps=(1.0, 1.0)):
    h, w = g.shape[-2:]
    (by, dy), (bx, dx) = design(h, spacing), design(w, spacing)
    system = np.concatenate([np.kron(by, dx / steps[0]), np.kron(dy / steps[1], bx)])
    c = np.linalg.lstsq(system, g.numpy().ravel(), rcond=1e-10)[0]
    return c.reshape(by.shape[1], bx.shape[1])


@pytest.mark.parametrize("spacing", [1.1, 2.0, 3.7])
@pytest.mark.parametrize("shape", [(12, 15), (10, 10), (9, 7)])
def test_it_is_dense_least_squares(spacing, shape):
    g = random_field(1, 2, *shape)
    c = dense(g[0], spacing, (0.5, 2.0))
    z = design(shape[0], spacing)[0] @ c @ design(shape[1], spacing)[0].T
    found = BSpline(spacing, pixel_size=(0.5, 2.0))(g)[0, 0]
    np.testing.assert_allclose(found, z - z.mean(), atol=1e-9)


def test_heights_between_pixels_are_those_of_the_spline():
    g = random_field(1, 2, 12, 15)
    rows, columns = torch.tensor([0.0, 0.3, 10.9, 11.0]).double(), torch.tensor([7.25, 14.0]).double()
    c = dense(g[0], 2.0)
    pixels = design(12, 2.0)[0] @ c @ design(15, 2.0)[0].T
    z = design(12, 2.0, rows.numpy())[0] @ c @ design(15, 2.0, columns.numpy())[0].T
    np.testing.assert_allclose(BSpline().evaluate(g, rows, columns)[0, 0], z - pixels.mean(), atol=1e-9)


def line(end, count):
    return torch.linspace(0, end, count, dtype=torch.float64)


def test_cubic_surfaces_are_exact_at_pixels_and_between():
    y, x = torch.meshgrid(line(1, 43), line(2, 57), indexing="ij")
    z = x**3 - 2 * x**2 * y + y**3 + x * y
    g = torch.stack([3 * x**2 - 4 * x * y + y, -2 * x**2 + 3 * y**2 + x])[:, ::3, ::4]
    mean = z[::3, ::4].mean()
    method = BSpline(pixel_size=(2 / 14, 1 / 14))
    torch.testing.assert_close(method(g)[0], z[::3, ::4] - mean, rtol=0, atol=1e-12)
    fine = method.evaluate(g, line(14, 43), line(14, 57))
    torch.testing.assert_close(fine[0], z - mean, rtol=0, atol=1e-12)


def test_upsampling_keeps_the_pixels():
    g = random_field(2, 2, 9, 11, dtype=torch.float32)
    fine = BSpline().upsample(g, 3)
    assert fine.shape == (2, 1, 25, 31)
    torch.testing.assert_close(fine[..., ::3, ::3], BSpline()(g), rtol=0, atol=1e-4)
    torch.testing.assert_close(BSpline().upsample(g, 1), BSpline()(g), rtol=0, atol=1e-4)


def test_derivatives_of_heights_between_pixels():
    at = torch.tensor([0.5, 2.2]).double()
    assert_gradients(lambda g: BSpline(pixel_size=0.5).evaluate(g, at, at), random_field(1, 2, 5, 6))


@pytest.mark.parametrize("n", range(1, 9))
def test_narrow_fields(n):
    """One pixel, a line, and all sides at which the degree or the number of knots gives way; a line is exact."""
    g = torch.full((1, 2, n, 1), 0.5, dtype=torch.float64)
    expected = 0.5 * (torch.arange(n).double() - (n - 1) / 2)
    torch.testing.assert_close(BSpline(1.1)(g)[0, 0, :, 0], expected, rtol=0, atol=1e-10)
    assert BSpline(1.1)(random_field(1, 2, n, n)).abs().max() < 100  # nothing is nearly singular


def test_what_does_not_fit_is_named():
    g, at = random_field(1, 2, 6, 6), torch.arange(6).double()
    with pytest.raises(ValueError, match=r"spacing=1.0"):
        BSpline(1.0)
    with pytest.raises(ValueError, match=r"columns \(6,\) given"):
        BSpline().evaluate(g, at, at + 0.5)
    with pytest.raises(TypeError, match=r"rows has dtype torch\.float32"):
        BSpline().evaluate(g, at.float(), at)
    with pytest.raises(ValueError, match="factor=0"):
        BSpline().upsample(g, 0)
