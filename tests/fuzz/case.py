"""A case: a call as code, and how it is judged."""

from __future__ import annotations

import math
import random
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import torch
from torch import Tensor

import torchdls
from tests.fuzz import values

NAMES: dict[str, Any] = {**vars(values), "torch": torch, "torchdls": torchdls, "nan": math.nan, "inf": math.inf}
# Refusals that the docstrings promise, whatever the argument.
DOCUMENTED = (
    "holds no complete cell",  # noise_level
    "beyond",  # the height is beyond its dtype
    "no 2x2 cell",  # guess_convention
    "size: ",  # DLS: that of its patches, which `Patches` refuses
    "no cell",
    "without any valid pixel",
)
LIMIT = 60.0  # seconds of processor time after which a call counts as hanging


class Flaw(AssertionError):
    """What an oracle objects to."""


Judge = Callable[["Case", Callable[..., Any], dict[str, Any], Any], None]


@dataclass
class Case:
    """The call `target(**arguments)`; every argument is an expression.

    Attributes:
        target: an expression for what is called.
        arguments: name -> expression.
        spoilt: the argument that was made wrong, whose name the message must hold.
        must_raise: whether it must be refused.
        wild: whether numbers are so large that the height may be beyond its dtype.
        patient: whether relations are asked only of results that came without a `ConvergenceWarning`.
        judge: looks at a result: (case, function, values, result).
        label: of the judge, for the report.
    """

    target: str
    arguments: dict[str, str]
    spoilt: str | None = None
    must_raise: bool = False
    wild: bool = False
    patient: bool = False
    judge: Judge | None = None
    label: str = ""
    options: tuple[str, ...] = field(default=())

    def __str__(self) -> str:
        given = "".join(f"    {name}={code},\n" for name, code in self.arguments.items())
        return f"{self.target}(\n{given})  # {self.label or 'errors'}"

    def run(self) -> bool:
        """Judge the case; Flaw where an oracle objects. Whether a result came back."""
        try:
            f = eval(self.target, NAMES)
        except (ValueError, TypeError) as error:
            self._named(error, self.options)
            return False
        given = {name: eval(code, NAMES) for name, code in self.arguments.items()}
        before = [(name, t, t.clone(), t._version) for name, t in given.items() if isinstance(t, Tensor)]
        try:
            with bounded(), no_warning() as warned:
                result = f(**given)
        except (ValueError, TypeError) as error:
            self._named(error, (*self.arguments, *self.options))
            return False
        finally:
            for name, t, copy, version in before:
                if t._version != version or (t.device.type != "meta" and not same_bits(t, copy)):
                    raise Flaw(f"wrote to {name}")
        if self.must_raise:
            raise Flaw(f"{self.spoilt} was accepted")
        if self.spoilt is None:
            check_finite(result)
            with bounded(), no_warning() as told:
                if self.judge is not None:
                    try:
                        self.judge(self, f, given, result)
                    except Flaw:
                        if not self.patient or not (warned or told):
                            raise
        return True

    def _named(self, error: Exception, names: tuple[str, ...]) -> None:
        message = str(error)
        if self.wild and "not finite" in message:
            return
        if any(word in message for word in DOCUMENTED):
            return
        if self.spoilt is None:
            raise Flaw(f"refused input that is in order: {type(error).__name__}: {message}") from error
        wanted = (self.spoilt,) if self.spoilt in self.arguments else names
        if not any(name in message for name in wanted):
            raise Flaw(f"{type(error).__name__} names none of {wanted}: {message}") from error


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Equal, NaN included."""
    return a.shape == b.shape and bool(((a == b) | ((a != a) & (b != b))).all())


def tensors(result: Any) -> Iterator[tuple[str, Tensor]]:
    """The tensors of a result, by name."""
    if isinstance(result, Tensor):
        yield "result", result
    elif hasattr(result, "_asdict"):
        for name, value in result._asdict().items():
            yield from ((f"{name}", t) for _, t in tensors(value))
    elif isinstance(result, Mapping):
        for name, value in result.items():
            yield from ((str(name), t) for _, t in tensors(value))
    elif isinstance(result, tuple | list):
        for value in result:
            yield from tensors(value)


def check_finite(result: Any) -> None:
    for name, t in tensors(result):
        if t.is_floating_point() and t.device.type != "meta" and not bool(t.isfinite().all()):
            raise Flaw(f"{name} {tuple(t.shape)} is not finite")


def close(actual: Tensor, expected: Tensor, tol: float, what: str, floor: float = 0.0) -> None:
    """Equal up to tol times the largest value of each surface, and `floor`."""
    if actual.shape != expected.shape or actual.dtype != expected.dtype:
        raise Flaw(f"{what}: {actual.dtype} {tuple(actual.shape)}, not {expected.dtype} {tuple(expected.shape)}")
    size = expected.abs().amax() if expected.ndim < 3 else expected.abs().amax((-3, -2, -1), keepdim=True)
    difference, allowed = (actual - expected).abs(), tol * size + floor
    if not bool((difference <= allowed).all()):
        worst = float((difference / size.clamp(min=torch.finfo(expected.dtype).tiny)).max())
        raise Flaw(f"{what}: differs by {float(difference.max()):.2e}, {worst:.1e} of the size; {tol:.0e} is allowed")


@contextmanager
def no_warning() -> Iterator[list[warnings.WarningMessage]]:
    """Every warning but that about convergence is a flaw."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        yield seen
    for warning in seen:
        if not issubclass(warning.category, torchdls.ConvergenceWarning) and "torch.jit" not in str(warning.message):
            raise Flaw(f"warned: {warning.category.__name__}: {warning.message}")


@contextmanager
def bounded() -> Iterator[None]:
    """A call that runs for too long is a flaw."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Flaw(f"ran longer than {LIMIT:.0f} s")

    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def numbered(seed: int, i: int) -> random.Random:
    """The generator of case i."""
    return random.Random(f"{seed}:{i}")
