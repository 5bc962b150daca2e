"""Choice among candidates: predicted risks against the true ones, for a linear smoother whose risk is known."""

import pytest
import torch

from tests.helpers import seeded
from torchdls import DLS, SURFACES, LeastSquares, add_noise, rmse, select
from torchdls.noise import height_noise
from torchdls.operators import dct2, idct2, neumann_eigenvalues

STRENGTHS = (0.0, 3.0, 30.0, 3000.0)


def smoother(gradient):
    """Least squares, then a low-pass of four strengths, candidate after candidate."""
    heights = LeastSquares()(gradient).chunk(len(STRENGTHS))
    eigenvalues = neumann_eigenvalues((gradient.shape[-2], gradient.shape[-1]), gradient)
    smooth = [idct2(dct2(z) / (1 + t * eigenvalues.square())) for z, t in zip(heights, STRENGTHS, strict=True)]
    return torch.cat(smooth)


def fields(snr=5, n=48):
    surface = SURFACES["gaussians"](n, dtype=torch.float64)
    return surface, torch.cat([add_noise(surface.gradient, snr, seeded(k)) for k in range(6)])


@pytest.mark.parametrize("criterion, tol", [("sure", 0.06), ("r2r", 0.5)])
@pytest.mark.parametrize("norm", [0.5, 1.0])
def test_risk_is_the_true_one_on_average(criterion, tol, norm):
    surface, gradient = fields()
    sigma = (gradient - surface.gradient).std((1, 2, 3))
    found = select(smoother, gradient, 4, noise=sigma, criterion=criterion, norm=norm)
    heights = smoother(gradient.repeat(4, 1, 1, 1)).unflatten(0, (4, -1))
    variance = height_noise((48, 48), gradient)
    weight = torch.where(variance > 0, variance.clamp(min=1e-30).pow(-norm), 0)
    true = (weight * dct2(heights - surface.height).square()).sum((-3, -2, -1))
    true = true / (sigma.square() * (variance * weight).sum())
    # R2R predicts for data with a quarter more variance.
    assert ((found.risk.mean(1) - true.mean(1)).abs() < tol + 0.1 * true.mean(1)).all()


def test_choice_is_close_to_the_best():
    surface, gradient = fields()
    found = select(smoother, gradient, 4)
    heights = smoother(gradient.repeat(4, 1, 1, 1)).unflatten(0, (4, -1))
    best = torch.stack([rmse(z, surface.height) for z in heights]).amin(0)
    assert (rmse(found.height, surface.height) < 1.1 * best).all()
    again = select(smoother, gradient, 4)
    assert torch.equal(again.choice, found.choice)


def test_least_squares_is_kept_where_nothing_is_gained():
    _, gradient = fields()
    worse = select(lambda g: smoother(g.repeat(4, 1, 1, 1))[: len(g)] * 0.2, gradient, 1)
    assert (worse.choice == -1).all()
    torch.testing.assert_close(worse.height, LeastSquares()(gradient))
    with pytest.raises(ValueError, match="criterion"):
        select(smoother, gradient, 4, criterion="luck")
    with pytest.raises(ValueError, match="candidates"):
        select(smoother, gradient, 0)


def test_it_tunes_dls():
    surface = SURFACES["tent"](48, dtype=torch.float64)
    gradient = add_noise(surface.gradient, 1, seeded(0))
    sigma = (gradient - surface.gradient).std()
    factors = torch.tensor([0.3, 1.5], dtype=torch.float64)
    found = select(lambda g: DLS(lam=0.5, mu=factors * sigma, n_iter=8, tol=0)(g), gradient, 2, norm=1.0)
    assert found.choice.tolist() == [1]
    assert rmse(found.height, surface.height) < rmse(LeastSquares()(gradient), surface.height)
