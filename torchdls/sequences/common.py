"""What the methods for sequences share: the call, and the height of one frame or of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchdls._checks import check_real, require
from torchdls._registry import LEARNERS
from torchdls.dictionary.learners import Learner
from torchdls.noise import noise_level
from torchdls.operators import GradientOperator, as_pixel_size, edge_slopes
from torchdls.solvers import solve


def check_sequence(name: str, gradient: Tensor) -> Tensor:
    """The sequence (N, T, 2, H, W), batched."""
    check_real(name, "gradient", gradient)
    fits = gradient.ndim in (4, 5) and gradient.shape[-3] == 2 and gradient.numel() > 0
    require(fits, f"{name}: gradient {tuple(gradient.shape)} given, (N, T, 2, H, W) or (T, 2, H, W) is needed")
    finite = bool(gradient.detach().isfinite().all())
    require(finite, f"{name}: gradient {tuple(gradient.shape)} is not finite")
    return gradient if gradient.ndim == 5 else gradient[None]


def choose_learner(name: str, learner: str | Learner) -> Learner:
    """A learner by its name, or the one that is given."""
    if isinstance(learner, str):
        require(learner in LEARNERS, f"{name}: learner={learner!r} is unknown; choose from {', '.join(LEARNERS)}")
        return LEARNERS[learner]()
    return learner


def strength(name: str, label: str, value: float | str) -> float | str:
    """The value, if it is "auto" or a number of at least 0."""
    good = value == "auto" or (isinstance(value, int | float) and value >= 0)
    require(good, f"{name}: {label}={value!r} given, 'auto' or a number of at least 0 is needed")
    return value


def positive(name: str, **numbers: Any) -> None:
    """ValueError unless all are positive integers."""
    for label, value in numbers.items():
        good = isinstance(value, int) and not isinstance(value, bool) and value > 0
        require(good, f"{name}: {label}={value!r} given, a positive integer is needed")


class Frames:
    """The data term of T frames: 1/2 sum_t ||A z_t - v_t||^2 for (N, T, 2, H, W), heights in pixels."""

    def __init__(self, gradient: Tensor, pixel_size: float | Sequence[float]) -> None:
        dx, dy = as_pixel_size(pixel_size)
        self.unit = (dx * dy) ** 0.5
        self.steps = dx / self.unit, dy / self.unit
        self.shape = gradient.shape
        self.slopes = edge_slopes(gradient.flatten(0, 1))[0]

    def noise(self, gradient: Tensor) -> Tensor:
        """(N,) standard deviation of one slope, over all frames."""
        level = noise_level(gradient.flatten(0, 1), pixel_size=self.steps)
        return level.view(self.shape[0], -1).square().mean(1).sqrt()

    def height(self, less: Tensor | None = None, anchor: Tensor | None = None, weight: Tensor | None = None) -> Tensor:
        """argmin over z of the data term of z + less, with anchors: (N, T, 1, H, W)."""
        v, whole = self.slopes, (*self.shape[:2], 1, *self.shape[-2:])
        v = v if less is None else v - GradientOperator("forward", self.steps)(less.flatten(0, 1))
        held = [None if t is None else t.expand(whole).flatten(0, 1) for t in (anchor, weight)]
        tol = 1e-12 if v.dtype == torch.float64 else 1e-6
        found = solve(v, None, *held, tol=tol, pixel_size=self.steps).height
        return found.unflatten(0, self.shape[:2])


def centred(z: Tensor) -> Tensor:
    """Of zero mean in each frame."""
    return z - z.mean((-2, -1), keepdim=True)


def codes_like(R: Tensor, D: Tensor) -> Tensor:
    """Codes of 0."""
    return torch.zeros(len(R), D.shape[-1], R.shape[-1], dtype=R.dtype, device=R.device)
