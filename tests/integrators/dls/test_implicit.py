"""The implicit derivative of DLS, against finite differences of the converged map with the same support."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.helpers import random_field
from torchdls import (
    DLS,
    Exact,
    FixedDictionary,
    Huber,
    Implicit,
    LeastSquares,
    Unroll,
    WeightedLeastSquares,
    dct_dictionary,
)

H, W = 9, 8
MASK = torch.ones(1, 1, H, W, dtype=torch.bool)
MASK[..., 3:5, 3:5] = False
MASK[..., :2, 6:] = False


IMPLICIT = Implicit(1e-10)


def converged(derivative: Any = IMPLICIT, **options: Any) -> DLS:
    settings = {"patch_size": 3, "n_atoms": 9, "lam": 0.3, "mu": 0.8, "n_iter": 6000, "learn": "fixed"}
    settings |= {"tol": 1e-8, "height_step": Exact(1e-11)}
    return DLS(derivative=derivative, data_term=LeastSquares(tol=1e-13), **{**settings, **options})


def centred(z: Tensor, mask: Tensor | None) -> Tensor:
    """Without the free constant, which carries no derivative."""
    inside = torch.ones_like(z, dtype=torch.bool) if mask is None else mask
    return torch.where(inside, z - z[inside].mean(), 0)


overcomplete = dct_dictionary(3, 16, dtype=torch.float64)
CASES: dict[str, tuple[dict[str, Any], dict[str, Tensor]]] = {
    "rectangle": ({}, {}),
    "soft": ({"learner": FixedDictionary("soft"), "mu": 0.3}, {}),
    "bound": ({"learner": FixedDictionary(bound=1.5)}, {}),
    "overcomplete": ({"dictionary": overcomplete}, {}),
    "mask": ({}, {"mask": MASK}),
    "weight": ({}, {"weight": random_field(1, 2, H, W, seed=1).abs() + 0.3}),
    "anchor": ({}, {"anchor": random_field(1, 1, H, W, seed=2), "anchor_weight": 0.2 + 0 * random_field(1, 1, H, W)}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_equals_finite_differences_of_the_converged_map(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    options, fields = CASES[case]
    g, c = random_field(1, 2, H, W), random_field(1, 1, H, W, seed=9)
    D = options.get("dictionary", dct_dictionary(3, 9, dtype=torch.float64))
    lam, mu = (torch.tensor([options.get(name, value)]).double() for name, value in (("lam", 0.3), ("mu", 0.8)))
    values = {"gradient": g, "lam": lam, "mu": mu, "dictionary": D}
    values |= {k: v for k, v in fields.items() if v.is_floating_point()}
    directions = {k: random_field(*v.shape, seed=20 + i) for i, (k, v) in enumerate(values.items())}
    directions["mu"] = directions["mu"] * (0 if "soft" not in repr(options.get("learner")) else 1)

    def run(point: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        model = converged(**options)
        model.lam, model.mu, model.dictionary = point["lam"], point["mu"], point["dictionary"]
        inputs = {**fields, **{k: v for k, v in point.items() if k in ("gradient", *fields)}}
        result = model.solve(**inputs)
        assert result.converged.all()
        return (centred(result.height, fields.get("mask")) * c).sum(), result.codes != 0

    point = {k: v.clone().requires_grad_() for k, v in values.items()}
    loss, support = run(point)
    slopes = dict(zip(point, torch.autograd.grad(loss, list(point.values()), materialize_grads=True), strict=True))
    errors, step = {}, 1e-5
    for name in ("lam", "all"):
        moved = {k: directions[k] * (name in (k, "all")) for k in values}
        ends = [run({k: v + t * moved[k] for k, v in values.items()}) for t in (step, -step)]
        assert all(torch.equal(s, support) for _, s in ends), "the step left the support"
        wanted = ((ends[0][0] - ends[1][0]) / (2 * step)).item()
        found = sum((slopes[k] * moved[k]).sum().item() for k in values)
        errors[name] = abs(found - wanted) / max(abs(wanted), 1e-3)
    with capsys.disabled():
        print(
            f"\n  implicit DLS, {case}: relative error " + ", ".join(f"{k} {v:.0e}" for k, v in errors.items()), end=""
        )
    assert max(errors.values()) <= 1e-5


@pytest.mark.slow
def test_other_modes_and_what_they_promise(capsys: pytest.CaptureFixture[str]) -> None:
    """Unrolled to the end it is the implicit derivative; with a frozen dictionary it is not; without, there is none."""
    g, c = random_field(1, 2, H, W), random_field(1, 1, H, W, seed=9)

    def slope(**options: Any) -> Tensor:
        point = g.clone().requires_grad_()
        height = centred(converged(**options)(point), None)
        return torch.autograd.grad((height * c).sum(), point)[0]

    implicit, unrolled = slope(), slope(derivative="unroll", n_iter=200, tol=1e-6)
    torch.testing.assert_close(implicit, unrolled, rtol=1e-4, atol=1e-5)
    learned = {"learn": "each", "n_iter": 40, "tol": 0.0}
    exact, frozen = (slope(derivative=d, **learned) for d in ("unroll", Implicit(1e-10, frozen_dictionary=True)))
    error = float((frozen - exact).norm() / exact.norm())
    with capsys.disabled():
        print(f"\n  learned dictionary: 'frozen_dictionary' is {error:.0%} off 'unroll'", end="")
    assert 1e-3 < error < 1.5
    assert not converged("none")(g.clone().requires_grad_()).requires_grad


@pytest.mark.slow
def test_second_derivative_and_transforms() -> None:
    """Double backward, forward mode and vmap of the implicit solve."""
    model = converged()
    g, c, u = (random_field(1, n, H, W, seed=i) for i, n in ((0, 2), (9, 1), (3, 2)))
    lam = torch.tensor([0.3]).double()

    def slopes(g: Tensor, lam: Tensor, create_graph: bool = False) -> tuple[Tensor, ...]:
        model.lam = lam
        g, lam = (t if t.requires_grad else t.clone().requires_grad_() for t in (g, lam))
        model.lam = lam
        return torch.autograd.grad((centred(model(g), None).square() * c).sum(), (g, lam), create_graph=create_graph)

    point = g.clone().requires_grad_(), lam.clone().requires_grad_()
    first = slopes(*point, create_graph=True)
    second = torch.autograd.grad((first[0] * u).sum() + first[1].sum(), point)
    step = 1e-5
    ends = [slopes(g + t * u, lam + t) for t in (step, -step)]
    for found, up, down, v in zip(second, *ends, (u, torch.ones(1)), strict=True):
        wanted = (up - down) / (2 * step)
        if v is u:  # the mixed terms come from both
            torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-4 * float(wanted.abs().max()))
    model = converged(n_iter=20)  # vmap cannot see whether a surface has settled: it runs all iterations
    _, tangent = torch.func.jvp(model, (g,), (u,))
    _, pull = torch.func.vjp(model, g)
    torch.testing.assert_close((tangent * c).sum(), (pull(c)[0] * u).sum(), rtol=1e-6, atol=1e-8)
    both = torch.stack([g, g + 0.1 * u])
    torch.testing.assert_close(torch.vmap(model)(both), torch.stack([model(x) for x in both]), rtol=1e-6, atol=1e-7)
    assert torch.func.jacrev(lambda x: model(x)[..., 0, :2])(g).shape == (1, 1, 2, 1, 2, H, W)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"derivative": "implicit", "learn": "each"}, "take 'unroll' .* or 'frozen_dictionary'"),
        ({"derivative": "frozen_dictionary"}, "take 'implicit'"),
        (
            {"learner": FixedDictionary("firm")},
            "needs a data term that is one quadratic, free borders, and hard or soft",
        ),
        (
            {"derivative": "frozen_dictionary", "learn": "each", "dictionary": torch.nn.Parameter(torch.eye(9))},
            "gives a trained dictionary no derivative",
        ),
    ],
)
def test_modes_that_do_not_exist_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        converged(**options)


def test_automatic_mode() -> None:
    assert DLS(learn="fixed")._derivative == DLS(learner="fixed")._derivative == Implicit()
    assert DLS()._derivative == DLS(learner=FixedDictionary("firm"))._derivative == Unroll()
    assert DLS(derivative="none")._derivative is None


def test_trusts_that_do_not_depend_on_the_height_have_an_implicit_derivative() -> None:
    """Weighted least squares as data term: as unrolled to the end, the trusts' own derivative included."""
    g, c = random_field(1, 2, H, W), random_field(1, 1, H, W, seed=9)
    slopes = []
    for derivative, options in ((IMPLICIT, {}), ("unroll", {"n_iter": 300, "tol": 0.0})):
        settings: dict[str, Any] = {"patch_size": 3, "n_atoms": 9, "lam": 0.3, "mu": 0.8, "n_iter": 6000, "tol": 1e-9}
        data = WeightedLeastSquares(tol=1e-13)
        model = DLS(
            data_term=data, learner="fixed", height_step=Exact(1e-12), derivative=derivative, **settings | options
        )
        point = g.clone().requires_grad_()
        height = centred(model(point), None)
        slopes.append(torch.autograd.grad((height * c).sum(), point)[0])
    torch.testing.assert_close(*slopes, rtol=1e-5, atol=1e-6)
    assert DLS(learner="fixed", data_term=WeightedLeastSquares())._derivative == Implicit()
    with pytest.raises(ValueError, match="one quadratic"):
        DLS(learner="fixed", data_term=Huber(), derivative="implicit")
