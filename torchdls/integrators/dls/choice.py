"""DLS with its threshold chosen among several by predicted risk; least squares where none is worth it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchdls._tracing import is_concrete
from torchdls.integrators.base import Integrator
from torchdls.integrators.classic.least_squares import LeastSquares
from torchdls.integrators.dls.problem import Problem
from torchdls.integrators.fields import has_even_trust
from torchdls.selection import select

# Over 15 surfaces from 1 to 40 dB this norm and cut gained the most in RMSE and in SSIM, and did the least harm.
_NORM, _LEAST_CUT = 0.0, 0.35
_FACTORS = (1.0, 1.5, 2.25)  # of the noise of one sample: the thresholds that mu="auto" is chosen from


def check_selectable(data_term: Integrator, learn: str, mu: object) -> None:
    """ValueError for options with which the risk cannot be predicted."""
    if type(data_term) is not LeastSquares:
        raise ValueError(f"DLS: select=True predicts the risk of least squares, not of {type(data_term).__name__}")
    if learn == "shared":
        raise ValueError("DLS: select=True chooses per surface and does not go with learn='shared'")
    if isinstance(mu, tuple):
        raise ValueError("DLS: select=True chooses one threshold and does not go with a schedule of mu")


def choose_threshold(model: Problem, automatic: bool, run: Callable[[Tensor, Tensor], Tensor]) -> Problem:
    """The model with the threshold of least predicted risk; lam = 0, which is least squares, where none is chosen.

    Args:
        model: constants of the run.
        automatic: whether mu is free to choose; else the one given is set against least squares.
        run: gradient (N, 2, H, W) and mu (N,) -> height (N, 1, H, W).

    Raises:
        ValueError: a surface has a mask with holes, unequal weights or an anchor.
    """
    fields = model.fields
    if is_concrete(fields.gradient) and not bool(has_even_trust(fields).all()):
        what = "select=True predicts the risk on full rectangles with equal weights and no anchor"
        raise ValueError(f"DLS: {what}; gradient {tuple(fields.gradient.shape)} has others")
    factors = _FACTORS if automatic else (1.0,)
    mus = [factor * model.mu for factor in factors]

    def heights(gradient: Tensor) -> Tensor:
        parts = gradient.chunk(len(mus))
        return torch.cat([run(g, mu) for g, mu in zip(parts, mus, strict=True)])

    with torch.no_grad():
        chosen = select(
            heights, fields.gradient, len(mus),
            noise=model.noise, norm=_NORM, least_cut=_LEAST_CUT, pixel_size=fields.steps,
        )  # fmt: skip
    scale = torch.tensor(factors, dtype=model.mu.dtype, device=model.mu.device)[chosen.choice.clamp(min=0)]
    return model._replace(mu=scale * model.mu, lam=torch.where(chosen.choice < 0, 0, model.lam))
