"""Weighted global least squares against dense least squares with the whitened system."""

import numpy as np
import pytest
import torch

from tests.helpers.fields import random_field
from torchdls import SURFACES, HarkerOLeary, WeightedHarkerOLeary, rmse
from torchdls.operators.local_polynomials import derivative_matrix

F64 = torch.zeros((), dtype=torch.float64)


def covariance(n, seed):
    x = random_field(n, n, seed=seed)
    return x @ x.mT / n + 0.1 * torch.eye(n, dtype=torch.float64)


@pytest.mark.parametrize("border", ["free", "zero"])
@pytest.mark.parametrize("support, steps", [(3, (1.0, 1.0)), (5, (0.5, 2.0))])
def test_equals_dense_generalised_least_squares(border, support, steps):
    h, w = 8, 7
    g, rows, columns = random_field(1, 2, h, w), covariance(h, 1), covariance(w, 2)
    z = WeightedHarkerOLeary(rows, columns, border, support, pixel_size=steps)(g)[0, 0].numpy()
    D_y, D_x = (derivative_matrix(n, support, None, d, like=F64).numpy() for n, d in ((h, steps[1]), (w, steps[0])))
    white = np.linalg.inv(np.linalg.cholesky(np.kron(rows.numpy(), columns.numpy())))
    keep = np.zeros((h, w), bool)
    keep[1:-1, 1:-1] = True
    columns_kept = keep.ravel() if border == "zero" else slice(None)
    matrix = np.concatenate([white @ np.kron(D_y, np.eye(w)), white @ np.kron(np.eye(h), D_x)])[:, columns_kept]
    right = np.concatenate([white @ g[0, 1].numpy().ravel(), white @ g[0, 0].numpy().ravel()])
    found = np.linalg.lstsq(matrix, right, rcond=1e-12)[0]
    expected = np.zeros(h * w)
    expected[columns_kept] = found
    expected = expected if border == "zero" else expected - expected.mean()
    np.testing.assert_allclose(z.ravel(), expected, atol=1e-9)


def test_without_covariance_it_is_harker_oleary():
    g = random_field(2, 2, 9, 12)
    torch.testing.assert_close(WeightedHarkerOLeary(pixel_size=(2, 3))(g), HarkerOLeary(pixel_size=(2, 3))(g))


def test_the_unit_of_a_covariance_does_not_matter():
    g, rows = random_field(1, 2, 9, 12), covariance(9, 0)
    torch.testing.assert_close(WeightedHarkerOLeary(rows)(g), WeightedHarkerOLeary(1e4 * rows)(g))


def test_true_covariances_lower_the_error():
    surface, better = SURFACES["peaks"](24, dtype=torch.float64), 0
    rows = torch.linspace(0.1, 10, 24, dtype=torch.float64).square().diag()
    columns = 0.9 ** (torch.arange(24.0).double()[:, None] - torch.arange(24.0)).abs()
    for seed in range(8):
        noise = torch.linalg.cholesky(rows) @ random_field(1, 2, 24, 24, seed=seed) @ torch.linalg.cholesky(columns).mT
        g = surface.gradient + 0.1 * noise
        methods = WeightedHarkerOLeary(rows, columns), HarkerOLeary()
        weighted, plain = (float(rmse(m(g), surface.height)) for m in methods)
        better += weighted < plain
    assert better >= 7


def test_derivative():
    method = WeightedHarkerOLeary(covariance(4, 1), None, "zero")
    assert torch.autograd.gradcheck(method, [random_field(1, 2, 4, 5).requires_grad_()])


def test_bad_arguments():
    eye = torch.eye(5)
    for bad, match in (
        ({"rows": -eye}, "rows"), ({"columns": eye[:4]}, "columns"), ({"rows": eye + eye.roll(1, 0)}, "rows"),
        ({"border": "held"}, "border"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            WeightedHarkerOLeary(**bad)
    with pytest.raises(TypeError, match="columns"):
        WeightedHarkerOLeary(columns=eye.long())
    with pytest.raises(ValueError, match=r"rows \(5, 5\)"):
        WeightedHarkerOLeary(eye)(torch.zeros(1, 2, 6, 6))
    with pytest.raises(ValueError, match="border"):
        WeightedHarkerOLeary(border="zero")(torch.zeros(1, 2, 2, 6))
