"""`torchdls methods`, and how a command builds and runs one."""

from __future__ import annotations

import argparse
import ast
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from torchdls._registry import INTEGRATORS, camera_options

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.integrators import Integrator


def list_methods(arguments: argparse.Namespace) -> None:
    """Print the integrators with their options."""
    indent = " " * (max(map(len, INTEGRATORS)) + 2)
    for name in INTEGRATORS:
        print(f"{name:<{len(indent)}}{INTEGRATORS.summary(name)}")
        options = ", ".join(f"{option}={default!r}" for option, default in INTEGRATORS.parameters(name).items())
        print(textwrap.fill(options, 110, initial_indent=indent, subsequent_indent=indent))


def check_method(name: str, settings: Sequence[str] = (), option: str = "--method") -> None:
    """ValueError, in the words of the command line, for a method or options that cannot be used."""
    if name not in INTEGRATORS:
        raise ValueError(f"{option}: {name!r} is unknown; choose from {', '.join(INTEGRATORS)}")
    known = {key: default for key, default in INTEGRATORS.parameters(name).items() if key != "pixel_size"}
    for key, value in options_of(settings).items():
        if key == "pixel_size":
            raise ValueError("--set: pixel_size has an option of its own, --pixel-size")
        if key not in known:
            options = ", ".join(f"{option}={_word(default)}" for option, default in known.items()) or "none"
            raise ValueError(f"--set: {name} has no option {key!r}; its options and their defaults: {options}")
        _check_option(name, key, value, known[key])
    INTEGRATORS[name](**options_of(settings))  # a ValueError of what does not go together, before any work


def _check_option(name: str, key: str, value: Any, default: Any) -> None:
    """One option by itself: a number for a number, and else what the method itself says."""
    given = f"--set: {key}={_word(value)} given"
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, bool) and not isinstance(value, bool):
        raise ValueError(f"{given}, True or False is needed")
    numeric = isinstance(default, (int, float)) and not isinstance(default, bool)
    if numeric and not number and not isinstance(value, tuple):  # a pair, where one number stands for both
        raise ValueError(f"{given}, a number is needed (default: {default})")
    try:
        INTEGRATORS[name](**{key: value})
    except ValueError:
        pass  # together with the other options it may be right; if not, that is said when the method is built
    except Exception as error:
        raise ValueError(f"{given}, which is not usable (default: {_word(default)})") from error


def _word(value: Any) -> str:
    """A value as one writes it after --set."""
    return value if isinstance(value, str) else repr(value)


def options_of(settings: Sequence[str], option: str = "--set") -> dict[str, Any]:
    """The values of words `name=value`: numbers, True, False, None, tuples, or words such as learner=k_svd."""
    options: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or not key.isidentifier():
            raise ValueError(f"{option}: {setting!r} given, NAME=VALUE is needed")
        try:
            options[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            options[key] = value
    return options


def build_method(
    name: str,
    pixel_size: tuple[float, float],
    settings: Sequence[str] = (),
    option: str = "--method",
    camera: Tensor | None = None,
) -> Integrator:
    """The integrator of that name, with options given as words `name=value`, and the focal length of a camera."""
    check_method(name, settings, option)
    return INTEGRATORS[name](pixel_size=pixel_size, **camera_options(name, camera) | options_of(settings))


@contextmanager
def _bar(label: str, method: Integrator, quiet: bool) -> Iterator[Any]:
    """A callback that moves a progress bar, or None for methods without iterations to show."""
    steps = getattr(method, "n_iter", None)
    if quiet or not steps or not sys.stderr.isatty():
        yield None
        return
    from torchdls._files import require

    tqdm = require("tqdm", "plots")
    form = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]{postfix}"
    with tqdm.tqdm(total=steps, desc=label, leave=False, bar_format=form) as bar:

        def step(iteration: int, objective: Tensor) -> None:
            bar.set_postfix_str(f"objective {float(objective.sum()):.6g}", refresh=False)
            bar.update(iteration - bar.n)
            if iteration == steps:
                bar.refresh()  # the last step shows, however quick

        yield step


def run_method(label: str, method: Integrator, quiet: bool, gradient: Tensor, **fields: Tensor | None) -> Any:
    """What `solve` of the method returns, with a progress bar."""
    with _bar(label, method, quiet) as step:
        return method.solve(gradient, **fields, callback=step)
