"""`torch.compile` gives what eager gives, forward and backward."""

import pytest
import torch

from tests.helpers import random_field
from torchdls import DLS, LeastSquares, SoupDIL

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning"),
]


@pytest.mark.parametrize(
    "integrator",
    [LeastSquares(), DLS(4, 2, 9, mu=0.3, n_iter=1, tol=0.0, height_step="proximal", learner=SoupDIL("block"))],
    ids=["least_squares", "dls"],
)
def test_compiled_equals_eager(integrator):
    g = random_field(1, 2, 12, 12, dtype=torch.float32)
    compiled = torch.compile(integrator, backend="aot_eager")
    a, b = g.clone().requires_grad_(), g.clone().requires_grad_()
    z, expected = compiled(a), integrator(b)
    torch.testing.assert_close(z, expected, rtol=1e-4, atol=1e-4)
    z.square().sum().backward()
    expected.square().sum().backward()
    torch.testing.assert_close(a.grad, b.grad, rtol=1e-3, atol=1e-3)
