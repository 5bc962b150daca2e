"""Options of DLS that are objects: how the height step is taken, and what the derivative is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


def _check_tol(name: str, tol: float) -> None:
    if not tol > 0:
        raise ValueError(f"{name}: tol={tol!r} given, a positive number is needed")


@dataclass(frozen=True)
class Exact:
    """Solve for the height that the patches and the data term agree on: (nupdate) to the end.

    Args:
        tol: relative residual of the solve.

    Raises:
        ValueError: tol is not positive.

    Example:
        >>> torchdls.DLS(height_step=torchdls.Exact(tol=1e-9))
        DLS(height_step=Exact(tol=1e-09))
    """

    tol: float = 1e-6

    def __post_init__(self) -> None:
        _check_tol("Exact", self.tol)


@dataclass(frozen=True)
class Proximal:
    """Proximal gradient steps for the height, as in the paper: (nproxupdate) with tau = 1 / ||A||^2.

    tau is 1/8 for unit weights and square pixels.

    Args:
        steps: per iteration, at least 1.
        accelerated: take each step from a point ahead of the last one (Nesterov 1983; Beck, Teboulle 2009), from the
            second step of an iteration on. The objective may then rise a little.

    Raises:
        ValueError: steps is not an integer of at least 1.
        ValueError: accelerated=True with one step, where it would have no effect.

    Example:
        >>> torchdls.DLS(height_step=torchdls.Proximal(steps=5, accelerated=True))
        DLS(height_step=Proximal(steps=5, accelerated=True))
    """

    steps: int = 1
    accelerated: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"Proximal: steps={self.steps!r} given, an integer of at least 1 is needed")
        if self.accelerated and self.steps == 1:
            raise ValueError("Proximal: accelerated=True has no effect with steps=1")


@dataclass(frozen=True)
class Unroll:
    """The derivative of the iterations that were run, exact.

    Args:
        checkpoint: save memory: only heights, dictionaries and nonzero codes are kept, of one iteration in
            sqrt(n_iter), and iterations are run again in the backward pass. First derivatives only.

    Example:
        >>> slopes = torch.zeros(1, 2, 12, 12, requires_grad=True)
        >>> height = torchdls.DLS(mu=0.1, n_iter=2, derivative=torchdls.Unroll(checkpoint=True))(slopes)
        >>> torch.autograd.grad(height.square().sum(), slopes)[0].shape
        torch.Size([1, 2, 12, 12])
    """

    checkpoint: bool = False


@dataclass(frozen=True)
class Implicit:
    """The derivative of the fixed point, at the cost of one linear solve whatever the number of iterations.

    Args:
        tol: relative residual of that solve.
        frozen_dictionary: for a learned dictionary, take the derivative as if it did not move: an approximation. For a
            fixed one it is exact, and this must be False.

    Raises:
        ValueError: tol is not positive.

    Example:
        >>> torchdls.DLS(learn="fixed", derivative=torchdls.Implicit(tol=1e-6))
        DLS(learn='fixed', derivative=Implicit(tol=1e-06))
    """

    tol: float = 1e-3
    frozen_dictionary: bool = False

    def __post_init__(self) -> None:
        _check_tol("Implicit", self.tol)


HEIGHT_STEPS: dict[str, Exact | Proximal] = {"exact": Exact(), "proximal": Proximal()}
DERIVATIVES: dict[str, Unroll | Implicit | None] = {
    "unroll": Unroll(),
    "implicit": Implicit(),
    "frozen_dictionary": Implicit(frozen_dictionary=True),
    "none": None,
}


def meant(name: str, value: object, words: Mapping[str, T], kinds: tuple[type, ...]) -> T:
    """What a word stands for, or the object that was given in its place."""
    if isinstance(value, str) and value in words:
        return words[value]
    if isinstance(value, kinds):
        return value  # type: ignore[return-value]
    choice = f"{', '.join(map(repr, words))}, or make a {' or '.join(kind.__name__ for kind in kinds)}"
    kind = ValueError if isinstance(value, str) else TypeError
    raise kind(f"DLS: {name}={value!r} is unknown; choose from {choice}")
