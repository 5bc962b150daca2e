"""What every integrator refuses, and how it says so; driven by the registry as test_contract.py is."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.helpers.methods import bumps, method, needs
from torchdls import INTEGRATORS

pytestmark = pytest.mark.device


@pytest.fixture(params=list(INTEGRATORS))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def bad_calls(g: Tensor) -> list[tuple[type[Exception], str, Tensor, dict[str, Any]]]:
    n, _, h, w = g.shape
    mask = torch.ones(n, 1, h, w, dtype=torch.bool)
    empty = mask.clone()
    empty[1] = False
    hole = torch.ones(n, 1, h, w)
    ones = torch.ones(n, 1, h, w, dtype=g.dtype)
    nan, inf = g.clone(), g.clone()
    nan[1, 0, 3, 3], inf[0, 1, 2, 2] = torch.nan, torch.inf
    negative, infinite = ones.clone(), ones.clone()
    negative[0, 0, 1, 1], infinite[0, 0, 1, 1] = -1, torch.inf
    shape = rf"gradient \({n}, 2, {h}, {w}\)"
    return [
        (TypeError, "gradient is a ndarray", g.cpu().numpy(), {}),
        (TypeError, "gradient is a NoneType", None, {}),
        (TypeError, "gradient has dtype torch.float16", g.half(), {}),
        (TypeError, "gradient has dtype torch.int64", g.long(), {}),
        (ValueError, r"gradient \(14, 14\) given", g[0, 0, :14], {}),
        (ValueError, rf"gradient \({n}, 1, {h}, {w}\) given", g[:, :1], {}),
        (ValueError, r"gradient \(0, 2, ", g[:0], {}),
        (ValueError, r"gradient \(\d, 2, \d+, 0\)", g[..., :0], {}),
        (ValueError, rf"{shape} is not finite", nan, {}),
        (ValueError, rf"{shape} is not finite", inf, {}),
        (ValueError, "gradient .* not finite inside the mask", nan, {"mask": mask}),
        (TypeError, "mask has dtype torch.float32, torch.bool is needed", g, {"mask": hole}),
        (TypeError, "mask is a list", g, {"mask": [True]}),
        (ValueError, rf"{shape} and mask \({n}, 1, {h}, {w - 1}\) differ in width", g, {"mask": mask[..., 1:]}),
        (ValueError, rf"{shape} and mask \({n}, 1, {h - 2}, {w}\) differ in height", g, {"mask": mask[..., 2:, :]}),
        (ValueError, rf"{shape} and mask \({n}, 2, .*\) do not fit: 2 channels", g, {"mask": mask.expand(n, 2, h, w)}),
        (ValueError, "differ in batch size", g, {"mask": mask[:1].expand(n + 1, 1, h, w)}),
        (ValueError, "differ in the number of dimensions", g, {"mask": mask[0]}),
        (ValueError, "mask .* is False everywhere", g, {"mask": empty}),
        (TypeError, "weight has dtype torch.float32", g, {"weight": ones.float()}),
        (ValueError, "weight .* is negative", g, {"weight": negative}),
        (ValueError, "weight .* is not finite", g, {"weight": infinite}),
        (ValueError, "weight .* 3 channels", g, {"weight": ones.expand(n, 3, h, w)}),
        (ValueError, "anchor is given without anchor_weight", g, {"anchor": ones}),
        (ValueError, "anchor_weight is given without anchor", g, {"anchor_weight": 1.0}),
        (ValueError, "anchor_weight .* is negative", g, {"anchor": ones, "anchor_weight": -1.0}),
        (ValueError, "anchor_weight .* is not finite", g, {"anchor": ones, "anchor_weight": float("nan")}),
        (TypeError, "anchor_weight is a str", g, {"anchor": ones, "anchor_weight": "much"}),
        (ValueError, "anchor .* is not finite", g, {"anchor": ones * torch.nan, "anchor_weight": 1.0}),
        (ValueError, "anchor .* differ in width", g, {"anchor": ones[..., 1:], "anchor_weight": 1.0}),
        (ValueError, "anchor_weight .* differ in height", g, {"anchor": ones, "anchor_weight": ones[..., 1:, :]}),
    ]


@pytest.mark.parametrize("case", range(len(bad_calls(torch.zeros(2, 2, 16, 14)))))
def test_bad_input_is_named(name: str, case: int) -> None:
    error, message, gradient, optional = bad_calls(bumps(2))[case]
    integrator = method(name).build(name)
    needs(name, *({"anchor_weight": "anchor"}.get(key, key) for key in optional))
    with pytest.raises(error, match=f"{type(integrator).__name__}: .*{message}"):
        integrator(gradient, **optional)


def test_refuses_what_it_ignores(name: str) -> None:
    """An argument that a method cannot honour is an error, not a surface that ignores it."""
    g = bumps(1)
    ones = torch.ones(1, 1, 16, 14, dtype=g.dtype)
    calls = {"mask": {"mask": ones > 0}, "weight": {"weight": ones}, "anchor": {"anchor": ones, "anchor_weight": 1.0}}
    integrator = method(name).build(name)
    assert integrator.accepts <= calls.keys()
    for label in calls.keys() - integrator.accepts:
        with pytest.raises(ValueError, match=label):
            integrator(g, **calls[label])


@pytest.mark.parametrize("pixel_size", [0.0, -1.0, float("nan"), (1.0,), (1.0, 2.0, 3.0), "fine", None])
def test_bad_pixel_size_is_named(name: str, pixel_size: Any) -> None:
    with pytest.raises((ValueError, TypeError), match="pixel_size"):
        method(name).build(name, pixel_size=pixel_size)
