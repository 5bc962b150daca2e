"""How each integrator is tested: the one table that drives the tests of contract, derivatives and robust methods."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.helpers.fields import MASKS, random_field, uniform_field
from torchdls import INTEGRATORS, Exact, Integrator, LeastSquares, Proximal, SoupDIL
from torchdls.integrators.robust import Robust

Options = dict[str, Any]


@dataclass(frozen=True)
class Method:
    """How one integrator is tested.

    `options` make it small and quick. `tol` is the relative error up to which promises hold in float64 (solvers stop,
    thresholds switch). `smallest` is the smallest side of an image it takes. `no` maps a promise (a test's name
    without `test_`) to the reason why the method does not make it. `exact` are forms whose derivative finite
    differences can follow: few iterations without an early stop, solves to the last digits.
    """

    options: Options = field(default_factory=dict)
    tol: float = 1e-6
    smallest: int = 1
    no: dict[str, str] = field(default_factory=dict)
    exact: dict[str, Options] = field(default_factory=lambda: {"default": {}})

    def build(self, name: str, **more: Any) -> Integrator:
        return INTEGRATORS[name](**{**self.options, **more})


ONE_SCALE = {"components_are_independent": "one scale of slopes is read from the whole surface"}
ONE_DICTIONARY = {
    "components_are_independent": "they share one dictionary",
    "follows_a_transpose": "atoms are updated one after the other, and a transpose permutes them",
    "follows_a_quarter_turn": "as for the transpose",
}
SPLITTING = {"reweighting_never_raises_the_objective": "it does not reweigh: ADMM"}
HELD = {
    "majoriser_touches_and_is_nowhere_below": "its quadratic holds the trusts, and bounds nothing",
    "reweighting_never_raises_the_objective": "as it bounds nothing",
    "dls_with_it_never_raises_its_objective": "as it bounds nothing",
}
TIGHT = {"tol": 1e-13}
FEW: Options = {"n_iter": 2, "tol": 0.0, "solve_tol": 1e-13}
DLS_EXACT: Options = {
    "patch_size": 3, "n_atoms": 9, "lam": 0.4, "mu": 0.35, "n_iter": 2, "tol": 0.0, "height_step": Exact(1e-13),
    "data_term": LeastSquares(**TIGHT),
}  # fmt: skip
SLOPE_DLS_EXACT: Options = {"recipe": "plain", "patch_sizes": (3, 5), "tau": 0.8, "n_iter": 2, "z_tol": 1e-13}

METHODS: dict[str, Method] = {
    "least_squares": Method(
        {"tol": 1e-12},
        exact={
            "default": TIGHT,
            "pixel_size": {**TIGHT, "pixel_size": (0.5, 2.0)},
            "dirichlet": {**TIGHT, "boundary": "dirichlet"},
        },
    ),
    "frankot_chellappa": Method(no={"plane_is_exact": "a plane is not periodic"}),
    "horn_brooks": Method(
        {"tol": 1e-5, "relaxation": 1.8},
        tol=2e-3,
        exact={"default": {"relaxation": 1.5}},
    ),
    "shapelets": Method(no={"plane_is_exact": "a plane is not periodic"}),
    "alpha_surface": Method(
        {"n_iter": 10},
        tol=1e-3,
        no={
            **ONE_SCALE,
        },
        exact={"default": {"n_iter": 3, "solve_tol": 1e-13}},
    ),
    "partial_integrability": Method(
        tol=1e-3,
        no={
            **ONE_SCALE,
        },
        exact={"default": {"solve_tol": 1e-13}},
    ),
    "spectral_path": Method(
        tol=1e-4,
        no={
            "scales_with_the_slopes": "bends depend on how steep the surface is",
        },
        exact={"default": {"solve_tol": 1e-13}},
    ),
    "spectral_regularization": Method(no={"plane_is_exact": "a few cosines do not make a plane"}),
    "weighted_least_squares": Method(
        {"floor": 0.1}, tol=1e-4, no=ONE_SCALE, exact={"default": {"floor": 0.1, **TIGHT}}
    ),
    "total_variation": Method({"n_iter": 10}, tol=1e-4, no=ONE_SCALE | SPLITTING, exact={"default": FEW}),
    "l1": Method({"n_iter": 10}, tol=1e-4, no=ONE_SCALE | SPLITTING, exact={"default": FEW}),
    "huber": Method({"n_iter": 10}, tol=1e-4, no=ONE_SCALE | SPLITTING, exact={"default": FEW}),
    "m_estimator": Method(
        {"n_iter": 5, "floor": 0.1},
        tol=1e-3,
        no=ONE_SCALE,
        exact={
            "default": {"floor": 0.1, **FEW},
            "tukey": {"loss": "tukey", "floor": 0.1, **FEW},
            "joint": {"joint": True, "floor": 0.1, **FEW},
        },
    ),
    "anisotropic_diffusion": Method(
        {"beta": 0.2, "n_iter": 10},
        tol=1e-4,
        no={
            **ONE_SCALE,
            "outliers_do_little_harm": "a wrong slope that the surface follows keeps some trust",
            "jumps_do_little_harm": "as for outliers",
            **HELD,
        },
        exact={"default": FEW, "field": {"beta": 0.2, "follow": "field", **FEW}},
    ),
    "edge_preserving": Method(
        {"n_iter": 5},
        tol=1e-3,
        no={
            **ONE_SCALE,
            "plane_is_exact": "it flattens slopes",
            "outliers_do_little_harm": "its data term is quadratic: wrong slopes keep their pull",
            "jumps_do_little_harm": "as for outliers",
        },
        exact={"default": FEW},
    ),
    "bilateral": Method(
        {"n_iter": 4, "tol": 0.0, "solve_tol": 1e-10},
        tol=1e-3,
        no={
            "scales_with_the_slopes": "the rule compares with one pixel",
            **HELD,
        },
        exact={"default": FEW},
    ),
    "mumford_shah": Method(
        {"n_iter": 5, "floor": 0.1}, tol=1e-3, no=ONE_SCALE, exact={"default": {"floor": 0.1, **FEW}}
    ),
    "piecewise": Method(
        tol=1e-4,
        no={
            **ONE_SCALE,
            "follows_flips": "the grids of the patches begin at one side; without noise see test_piecewise.py",
            "follows_a_transpose": "where nothing jumps it is SlopeDLS, which does not",
            "follows_a_quarter_turn": "as for the transpose",
            "scales_with_the_slopes": "the rule compares with one pixel",
            "derivatives_equal_finite_differences": "jumps are held fixed (see test_piecewise.py)",
        },
        exact={"default": {"noise": 0.0, "solve_tol": 1e-13}},
    ),
    "dls": Method(
        {
            "patch_size": 4,
            "stride": 2,
            "n_atoms": 16,
            "mu": 0.3,
            "n_iter": 3,
            "tol": 0.0,
            "learner": SoupDIL(unused="keep"),
        },
        tol=1e-4,
        no={
            **ONE_DICTIONARY,
            "plane_is_exact": "codes below mu are lost; it holds for mu='auto' and the block order (see test_dls.py)",
            "scales_with_the_slopes": "mu is a fixed height; with mu='auto' it holds (tested in test_dls.py)",
        },
        exact={
            "default": DLS_EXACT,
            "block": {**DLS_EXACT, "learner": SoupDIL("block", n_sweeps=2, bound=3.0)},
            "shared": {**DLS_EXACT, "learn": "shared", "pixel_size": (0.5, 1.5)},
            "proximal": {**DLS_EXACT, "height_step": Proximal(2)},
            "soft": {**DLS_EXACT, "learner": SoupDIL(threshold="soft"), "mu": "auto", "select": False},
            "firm": {**DLS_EXACT, "learner": SoupDIL("block", threshold="firm")},
            "fixed": {**DLS_EXACT, "learn": "fixed", "derivative": "unroll"},
        },
    ),
    "slope_dls": Method(
        {"patch_sizes": (4, 8), "n_iter": 3},
        tol=1e-4,
        no={**ONE_DICTIONARY, "follows_flips": "the grid of the patches shifts to one side"},
        exact={
            "default": SLOPE_DLS_EXACT,
            "quick": {**SLOPE_DLS_EXACT, "recipe": "quick", "guard": None},  # its blend by risk holds weights fixed
            "cosines": {**SLOPE_DLS_EXACT, "learn": False, "aggregate": "sparsity", "pixel_size": (0.5, 1.5)},
        },
    ),
}


def method(name: str) -> Method:
    return METHODS.get(name, Method(tol=1e-4))


# Every form for finite differences, by name and label; a method outside the table with its defaults.
EXACT = [(name, label) for name in INTEGRATORS for label in method(name).exact]


def exact(name: str, label: str = "default") -> Integrator:
    """One of them, in float64."""
    return INTEGRATORS[name](**method(name).exact[label]).double()


# The loops around the solve, with each loss, as functions of their options.
ROBUST: dict[str, tuple[str, Options]] = {
    **{name: (name, {}) for name in INTEGRATORS if issubclass(INTEGRATORS[name], Robust)},
    "geman_mcclure": ("m_estimator", {"loss": "geman_mcclure"}),
    "tukey": ("m_estimator", {"loss": "tukey"}),
    "joint": ("m_estimator", {"joint": True}),
    "field": ("anisotropic_diffusion", {"follow": "field"}),
    "four_indicators": ("mumford_shah", {"indicators": 4}),
}


# Promises that a form makes although its integrator by default does not.
KEPT = {"field": set(HELD)}


def promising(name: str, promise: str, form: str = "") -> str:
    """The name, unless the method does not make the promise: then the test is skipped with the reason."""
    if promise in KEPT.get(form, ()):
        return name
    if reason := method(name).no.get(promise):
        pytest.skip(f"{name}: {reason}")
    return name


def needs(name: str, *arguments: str) -> None:
    """Skip where the method does not take an argument; that it then refuses it is `test_refuses_what_it_ignores`."""
    if missing := set(arguments) - INTEGRATORS[name].accepts:
        pytest.skip(f"{name} takes no {', '.join(sorted(missing))}")


def bumps(n: int = 1, h: int = 16, w: int = 14, noise: float = 0.05) -> Tensor:
    """Slopes (n, 2, h, w) of smooth waves, different on each surface, with some noise."""
    y, x = torch.meshgrid(torch.arange(h, dtype=torch.float64), torch.arange(w, dtype=torch.float64), indexing="ij")
    slopes = [
        torch.stack([torch.cos(x / 3 + i) * torch.cos(y / 5), torch.sin(x / 3 + i) * torch.sin(y / 5) + 0.1 * i])
        for i in range(n)
    ]
    return torch.stack(slopes) + noise * random_field(n, 2, h, w, seed=11)


def everything(integrator: Integrator, g: Tensor) -> dict[str, Tensor]:
    """All the optional arguments that a method takes."""
    n, _, h, w = g.shape
    known = {
        "mask": {"mask": MASKS["disk"](h, w)},
        "weight": {"weight": uniform_field(n, 1, h, w, seed=5, dtype=g.dtype) + 0.5},
        "anchor": {
            "anchor": random_field(n, 1, h, w, seed=6).to(g.dtype),
            "anchor_weight": torch.full((n, 1, h, w), 0.5, dtype=g.dtype),
        },
    }
    return {key: value for label in integrator.accepts for key, value in known[label].items()}
