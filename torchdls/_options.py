"""Options as plain data: what a method was made with, in numbers, words, tuples and dicts, and as `repr` shows it.

A part such as a learner or a data term becomes {"name": its name, option: value, ...}. A tensor becomes
{"tensor": its shape, "dtype": ..., "kind": "buffer", "parameter" or "frozen parameter"}: a mark, since its values live
in the `state_dict` of the module.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn

from torchdls._registry import INTEGRATORS, LEARNERS, Registry

TABLES: tuple[Registry[Any], ...] = (INTEGRATORS, LEARNERS)


def plain(value: Any) -> Any:
    """The value of an option as plain data; TypeError for what has no such form."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return tuple(map(plain, value))
    if isinstance(value, Tensor):
        return {"tensor": tuple(value.shape), "dtype": str(value.dtype).removeprefix("torch."), "kind": _kind(value)}
    name = part_name(type(value))
    if name in INTEGRATORS:
        return {"name": name, **value.options()}
    if name is not None and is_dataclass(value):
        return {"name": name} | {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    raise TypeError(f"a {type(value).__name__} has no form as plain data; registered parts, numbers and words have")


def part_name(kind: type[Any]) -> str | None:
    """The name of a class in the tables; that of a public dataclass, such as an option object, is its own."""
    named = next((name for table in TABLES if (name := table.name_of(kind)) is not None), None)
    return named or (kind.__name__ if _public_dataclass(kind.__name__) is kind else None)


def part_class(name: object) -> type[Any] | None:
    """The class of that name; the inverse of `part_name`."""
    found: type[Any] | None = next((table[str(name)] for table in TABLES if name in table), None)
    return found or _public_dataclass(str(name))


def _public_dataclass(name: str) -> type[Any] | None:
    found = getattr(import_module("torchdls"), name, None)
    return found if isinstance(found, type) and is_dataclass(found) else None


def same(a: Any, b: Any) -> bool:
    """Whether two values of an option are equal; tensors by value, modules by their options."""
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return isinstance(a, Tensor) and isinstance(b, Tensor) and _kind(a) == _kind(b) and torch.equal(a, b)
    if isinstance(a, nn.Module) and isinstance(b, nn.Module):
        return type(a) is type(b) and repr(a) == repr(b)
    return bool(a == b)


def shown(value: Any) -> str:
    """The value of an option in a few words: of a tensor the shape, of a part what differs from its defaults."""
    if is_dataclass(value) and not isinstance(value, type):
        told = {f.name: v for f in fields(value) if (v := getattr(value, f.name)) != f.default}
        return f"{type(value).__name__}({', '.join(f'{name}={shown(v)}' for name, v in told.items())})"
    if not isinstance(value, Tensor):
        return repr(value)
    content = f"{value.item():g}" if value.numel() == 1 else "x".join(map(str, value.shape))
    return f"{type(value).__name__}({content})"


def _kind(value: Tensor) -> str:
    if not isinstance(value, nn.Parameter):
        return "buffer"
    return "parameter" if value.requires_grad else "frozen parameter"
