"""Thresholds of the codes: each is the minimiser that its penalty says, found here by brute force."""

import itertools

import pytest
import torch

from torchdls.dictionary import soup_dil_sweep
from torchdls.dictionary.thresholds import THRESHOLDS, penalty, shrink

MU = torch.tensor(0.7, dtype=torch.float64)
X = torch.linspace(-3, 3, 401, dtype=torch.float64)  # holds neither mu nor 2 mu exactly


@pytest.mark.parametrize("bound", [float("inf"), 1.1])
@pytest.mark.parametrize("rule", THRESHOLDS)
def test_shrink_minimises_its_penalty(rule: str, bound: float) -> None:
    b = torch.linspace(-4, 4, 16001, dtype=torch.float64)[:, None]
    b = b[b.abs()[:, 0] <= bound]
    # The paper thresholds, then clips: that is the minimiser while x itself is within the bound.
    reach = X[X.abs() <= bound] if rule == "hard" else X
    cost = (b - reach).square() + penalty(b, MU, rule)
    found = shrink(reach, MU, bound, rule)
    best = (found - reach).square() + penalty(found, MU, rule)
    assert (best <= cost.min(0).values + 1e-12).all()
    assert found.abs().max() <= bound


@pytest.mark.parametrize("rule", ["soft", "firm"])
def test_smooth_thresholds_have_a_derivative_in_mu(rule: str) -> None:
    x, mu = X.clone().requires_grad_(), MU.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, mu: shrink(x, mu, 1.9, rule), (x, mu), check_forward_ad=True)
    assert torch.autograd.grad(shrink(x, mu, rule=rule).square().sum(), mu)[0] < 0


def test_firm_lies_between_hard_and_soft_and_is_continuous() -> None:
    hard, soft, firm = (shrink(X, MU, rule=rule).abs() for rule in THRESHOLDS)
    assert ((soft <= firm) & (firm <= hard)).all()
    assert firm.diff().abs().max() < 2.1 * X.diff()[0]


@pytest.mark.usefixtures("sweep_by")
@pytest.mark.parametrize("order", ["atom", "block"])
@pytest.mark.parametrize("rule", THRESHOLDS)
def test_sweep_never_raises_its_objective(rule: str, order: str, generator: torch.Generator) -> None:
    P = torch.randn(2, 6, 30, generator=generator, dtype=torch.float64)
    D = torch.nn.functional.normalize(torch.randn(2, 6, 9, generator=generator, dtype=torch.float64), dim=1)
    B = torch.zeros(2, 9, 30, dtype=torch.float64)
    costs = []
    for _ in range(6):
        D, B = soup_dil_sweep(P, D, B, MU, order=order, threshold=rule)
        costs.append(((P - D @ B).square().sum() + penalty(B, MU, rule).sum()).item())
    assert all(after <= before + 1e-9 for before, after in itertools.pairwise(costs))


def test_unknown_threshold_is_refused() -> None:
    P = torch.zeros(1, 4, 3)
    with pytest.raises(ValueError, match="threshold: 'medium' is unknown"):
        soup_dil_sweep(P, torch.eye(4)[None], torch.zeros(1, 4, 3), 1.0, threshold="medium")
