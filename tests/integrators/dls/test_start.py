"""DLS from the result of the frame before."""

import pytest
import torch

from torchdls import DLS, SURFACES, LeastSquares, Unroll, add_noise, dls_objective, rmse

N = 40


def frame(k, size=N, dtype=torch.float64):
    """Noisy slopes and heights of a view that moves over a surface."""
    surface = SURFACES["tent"](size + 16, dtype=dtype)
    view = (..., slice(4 + k, 4 + k + size), slice(6, 6 + size))
    gradient = add_noise(surface.gradient[view], 10, generator=torch.Generator().manual_seed(k))
    height = surface.height[view]
    return gradient, height - height.mean()


def disk():
    y, x = torch.meshgrid(torch.arange(N), torch.arange(N), indexing="ij")
    return ((y - 12).square() + (x - 15).square() < 80)[None, None]


@pytest.mark.parametrize("mask", [None, disk()], ids=["whole", "disk"])
@pytest.mark.parametrize("learn", ["each", "shared", "fixed"])
def test_it_begins_with_the_codes_and_dictionary_of_before(learn, mask):
    dls = DLS(n_iter=4, tol=0.0, learn=learn, lam=0.5, mu=0.3, select=False)
    before = dls.solve(frame(0)[0], mask)
    gradient = frame(1)[0]
    found = dls.solve(gradient, mask, start=before)
    plain = LeastSquares()(gradient, mask)
    mu = torch.tensor([0.3], dtype=gradient.dtype)
    begin = dls_objective(plain, gradient, before.dictionary, before.codes, 0.5, mu, mask=mask)
    torch.testing.assert_close(found.objective[:, 0], begin, rtol=1e-5, atol=1e-6)
    assert (found.objective.diff() <= 1e-9).all()
    assert found.codes.shape == before.codes.shape


def test_few_iterations_go_further():
    gradient, height = frame(1, 64)
    before = DLS(n_iter=20).solve(frame(0, 64)[0])
    errors = [float(rmse(DLS(n_iter=5).solve(gradient, start=s).height, height)) for s in (None, before)]
    assert errors[1] < 0.995 * errors[0]


def test_codes_have_the_unit_of_the_height():
    dls, other = DLS(n_iter=3, tol=0.0, mu=0.3), DLS(n_iter=3, tol=0.0, mu=0.3, pixel_size=0.25)
    one, same = (d.solve(frame(1)[0], start=d.solve(frame(0)[0])) for d in (dls, other))
    torch.testing.assert_close(0.25 * one.height, same.height)


def test_it_is_a_guess_and_is_left_as_it_is():
    dls, gradient = DLS(n_iter=2, tol=0.0, mu=0.3), frame(0)[0].requires_grad_()
    before = dls.solve(gradient)
    copies = [x.detach().clone() for x in before]
    after = dls.solve(frame(1)[0], start=before)
    assert not after.height.requires_grad
    assert all(torch.equal(x, y) for x, y in zip(before, copies, strict=True))


def test_what_does_not_fit_is_named():
    dls, (gradient, _) = DLS(n_iter=1), frame(0)
    before = dls.solve(gradient)
    with pytest.raises(ValueError, match=r"start has .*codes \(1, 64, 289\); .*\(2, 64, 289\) are needed"):
        dls.solve(gradient.expand(2, -1, -1, -1), start=before)
    with pytest.raises(TypeError, match="start is a Tensor, a DLSResult is needed"):
        dls.solve(gradient, start=before.height)
    with pytest.raises(TypeError, match=r"start has dtype torch\.float32"):
        dls.solve(gradient, start=type(before)(*(x.float() for x in before)))
    with pytest.raises(ValueError, match=r"start does not go with derivative=Unroll\(checkpoint=True\)"):
        DLS(n_iter=1, derivative=Unroll(checkpoint=True)).solve(gradient, start=before)
