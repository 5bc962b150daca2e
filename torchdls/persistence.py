"""Integrators made from plain data, and kept in files: one safetensors file, without pickle.

The tensors of the file are the `state_dict` of the integrator; its metadata hold "format" (`torchdls.integrator`),
"version" (of the format), "torchdls" (the version that wrote it) and "integrator": the name and options, as JSON.
"""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

import torchdls
from torchdls._files import atomic_file, check_output, naming, require
from torchdls._options import TABLES, part_class
from torchdls._registry import INTEGRATORS
from torchdls.integrators import Integrator

FORMAT, VERSION = "torchdls.integrator", 1
_SUFFIX = ".safetensors"
Tensors = dict[str, Tensor]


def build(name: str, /, **options: Any) -> Integrator:
    """The integrator of that name with these options, as `Integrator.options` gives them.

    `build(name, **integrator.options())` makes an integrator again, as long as none of its options is a tensor: pass
    those beside the others, or keep the integrator by `save`.

    Args:
        name: in `INTEGRATORS`.
        options: of the class. A part may be given as {"name": "k_svd", "n_nonzero": 4}.

    Raises:
        ValueError: the name, the name of a part, or an option is unknown, or out of its range; or an option is the
            mark of a tensor, which holds no values.

    Example:
        >>> torchdls.build("dls", learner={"name": "k_svd", "n_nonzero": 4}, n_iter=10)
        DLS(n_iter=10, learner=KSVD(n_nonzero=4))
    """
    return _make_integrator(name, options, None)


def save(path: str | os.PathLike[str], integrator: Integrator, *, overwrite: bool = False) -> None:
    """Keep an integrator in a file: its name, its options and its tensors with their dtype, trained ones included.

    Args:
        path: ends in `.safetensors`; the file is whole or not there.
        integrator: of a class in `INTEGRATORS`.
        overwrite: replace a file.

    Raises:
        ValueError: the suffix or the class is another; that of a parametrised module is, too.
        TypeError: an option has no form as plain data, such as a learner of one's own.
        FileNotFoundError: the directory does not exist.
        FileExistsError: the file exists and `overwrite` is False.
        ImportError: safetensors is not installed.

    Example:
        >>> import tempfile
        >>> trained = torchdls.DLS(n_iter=2, lam=torch.nn.Parameter(torch.tensor(0.25)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torchdls.save(f"{folder}/dls.safetensors", trained)
        ...     torchdls.load(f"{folder}/dls.safetensors").lam
        Parameter containing:
        tensor(0.2500, requires_grad=True)
    """
    path = check_output(path, overwrite, suffixes=[_SUFFIX])
    name = INTEGRATORS.name_of(type(integrator))
    if name is None:
        raise ValueError(f"save: {type(integrator).__name__} is not one of {', '.join(INTEGRATORS)}")
    described = json.dumps({"name": name, "options": integrator.options()})
    metadata = {"format": FORMAT, "version": str(VERSION), "torchdls": torchdls.__version__, "integrator": described}
    tensors = {key: t.detach().cpu().contiguous().clone() for key, t in integrator.state_dict().items()}
    data: bytes = require("safetensors.torch", "files").save(tensors, metadata)
    with atomic_file(path, overwrite) as file:
        file.write(data)


def load(path: str | os.PathLike[str]) -> Integrator:
    """The integrator that `save` kept, on the CPU.

    Raises:
        ValueError: the file is of another kind, damaged, of a newer version, of an integrator or option that is
            unknown, or its tensors are not those of the integrator. The message names the file.
        FileNotFoundError: there is no such file.
        ImportError: safetensors is not installed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torchdls.save(f"{folder}/dls.safetensors", torchdls.DLS(n_iter=10))
        ...     torchdls.load(f"{folder}/dls.safetensors")
        DLS(n_iter=10)
    """
    path = Path(path)
    metadata, tensors = _read(path)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: holds no integrator of torchdls")
    version = metadata.get("version", "")
    if not version.isdecimal() or int(version) > VERSION:
        raise ValueError(f"{path}: has version {version!r} of the format, this torchdls reads up to {VERSION}")
    with naming(path, "an integrator"):
        description = json.loads(metadata["integrator"])
        integrator = _make_integrator(description["name"], description["options"], tensors)
        _check_tensors(integrator.state_dict(), tensors)
        integrator.load_state_dict(tensors, assign=True)
    return integrator


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    safetensors = require("safetensors", "files")
    with naming(path, "safetensors"), safetensors.safe_open(path, "pt") as file:
        return file.metadata() or {}, {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118


def _check_tensors(wanted: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> None:
    if missing := wanted.keys() - found.keys():
        raise ValueError(f"lacks the tensors {', '.join(sorted(missing))}")
    if extra := found.keys() - wanted.keys():
        raise ValueError(f"holds tensors that the integrator has not: {', '.join(sorted(extra))}")
    for key, t in wanted.items():
        if t.shape != found[key].shape:
            raise ValueError(f"{key}: shape {tuple(found[key].shape)} given, {tuple(t.shape)} is needed")


def _make(made: type[Any], name: str, options: Mapping[str, Any], tensors: Tensors | None, at: str = "") -> Any:
    """An integrator or part with options in their plain form, with its tensors where they are marks of some."""
    known = inspect.signature(made).parameters
    if unknown := options.keys() - known.keys():
        raise ValueError(f"{name}: no option {', '.join(sorted(unknown))}; it has {', '.join(known)}")
    return made(**{key: _value(value, tensors, f"{at}{key}") for key, value in options.items()})


def _make_integrator(name: str, options: Mapping[str, Any], tensors: Tensors | None) -> Integrator:
    if name not in INTEGRATORS:
        raise ValueError(f"{name!r} is unknown; choose from {', '.join(INTEGRATORS)}")
    integrator: Integrator = _make(INTEGRATORS[name], name, options, tensors)
    return integrator


def _make_part(part: Mapping[str, Any], tensors: Tensors | None, at: str) -> Any:
    """A part from {"name": ..., option: value}; `at` is its place in the state_dict."""
    if "name" not in part:
        raise ValueError(f"{at}: a dict without 'name' given, such as {{'name': 'k_svd', 'n_nonzero': 4}} is needed")
    name, made = part["name"], part_class(part["name"])
    if made is None:
        known = ", ".join(name for table in TABLES for name in table)
        raise ValueError(f"{at}: {name!r} is unknown; choose from {known}, or a public dataclass")
    return _make(made, name, {key: value for key, value in part.items() if key != "name"}, tensors, f"{at}.")


def _value(value: Any, tensors: Tensors | None, at: str) -> Any:
    """The value of an option from its plain form; `at` is its place in the state_dict."""
    if isinstance(value, list | tuple):
        return tuple(_value(v, tensors, at) for v in value)
    if not isinstance(value, dict):
        return value
    if "tensor" not in value:
        return _make_part(value, tensors, at)
    if tensors is None:
        raise ValueError(f"{at}: this is the mark of a tensor, not its values; pass the tensor itself, or use `load`")
    if at not in tensors:
        raise ValueError(f"lacks the tensors {at}")
    if value.get("kind") == "buffer":
        return tensors[at]
    return nn.Parameter(tensors[at], requires_grad=value.get("kind") == "parameter")
