"""The ground under reading and writing: raw arrays, complaints of one line, files that are whole or not at all."""

from __future__ import annotations

import glob
import os
import secrets
import stat
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Array = NDArray[Any]


def check_output(
    path: str | os.PathLike[str], overwrite: bool = False, *, suffixes: Sequence[str] | None = None
) -> Path:
    """Say before the work what would fail after it: unknown format, missing directory, file that exists.

    Raises:
        ValueError: the suffix is not one of `suffixes` (default: any is).
        FileNotFoundError: the directory does not exist.
        FileExistsError: the file exists and `overwrite` is False.
    """
    path = Path(path)
    if suffixes is not None and path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: unknown format {path.suffix!r}, choose from {', '.join(suffixes)}")
    name = os.fspath(path)  # strings: paths made and parted cost more than what is asked of the system
    parent = os.path.dirname(os.path.realpath(name) if overwrite and os.path.islink(name) else name) or "."
    if not os.path.isdir(parent):
        raise FileNotFoundError(f"{path}: the directory {parent} does not exist")
    if os.path.lexists(name) and (not overwrite or os.path.isdir(name)):
        raise FileExistsError(f"{path}: exists already; only --force (overwrite=True) replaces a file")
    return path


@contextmanager
def atomic_file(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[BinaryIO]:
    """A binary file that takes its place when the block ends without an error, and else leaves no trace.

    What replaces a file keeps its permissions, and a symbolic link goes on pointing to it. Of several writers without
    `overwrite` exactly one succeeds. A draft that a killed writer left is removed by the next write to the same name
    (that of one beside another: by the next that finds the name taken).

    Raises:
        FileNotFoundError: the directory does not exist.
        FileExistsError: the file exists and `overwrite` is False.
        OSError: writing fails; it names the path.
    """
    path = check_output(path, overwrite)
    place = Path(os.path.realpath(path)) if overwrite else path
    try:
        file = _draft(place)
    except OSError as error:
        raise _naming_output(path, error) from error
    try:
        with file:
            yield file
            file.flush()
            if overwrite and place.exists():
                os.chmod(file.name, stat.S_IMODE(os.stat(place).st_mode))
            if fcntl is None:
                file.close()  # an open file cannot be moved there
            _publish(Path(file.name), place, overwrite)
    except FileExistsError:
        _remove(file.name)
        check_output(path, overwrite)  # says it in its own words
        raise
    except BaseException as error:
        _remove(file.name)
        failure = _failed_write(error)
        if failure is None:
            raise
        raise _naming_output(path, failure) from error


def _draft(place: Path) -> BinaryIO:
    """A new file beside its place, locked while its writer lives.

    Each place has one name for its draft, and only a writer that finds it taken lists the folder to look for the dead.
    """
    tries, folder = 0, os.path.dirname(place)
    while True:
        name = "0" * 8 if tries < 2 else secrets.token_hex(4)
        tries += 1
        try:
            file = open(os.path.join(folder, f".{place.name}.{name}.draft"), "xb")  # noqa: SIM115 (the caller closes it)
        except FileExistsError:
            _sweep(place)
            continue
        if fcntl is None:
            return file
        with suppress(OSError):  # a file system without locks: nobody can sweep there either
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.path.exists(file.name):  # nobody swept it up before it was locked
            return file
        file.close()


def _sweep(place: Path) -> None:
    """Remove the drafts of this name whose writers are dead: nobody holds their locks."""
    for draft in place.parent.glob(f".{glob.escape(place.name)}.{'[0-9a-f]' * 8}.draft"):
        with suppress(OSError):
            if fcntl is None:
                draft.unlink()  # refused while it is open
                continue
            with open(draft, "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                draft.unlink()


def _publish(draft: Path, place: Path, overwrite: bool) -> None:
    """Move a finished draft to its place; FileExistsError if there is a file that must not be replaced."""
    if not overwrite:
        try:
            os.link(draft, place)
        except FileExistsError:
            raise
        except OSError:  # no hard links on this file system: claim the name instead
            os.close(os.open(place, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        else:
            return draft.unlink()
    os.replace(draft, place)
    return None


def _remove(name: str) -> None:
    with suppress(OSError):
        os.unlink(name)


def _failed_write(error: BaseException | None) -> OSError | None:
    """The failure of the system behind an error; archives that cannot be closed after it hide it."""
    while error is not None and not isinstance(error, OSError):
        error = error.__context__ if isinstance(error, Exception) else None
    return error


def _naming_output(path: Path, error: OSError) -> OSError:
    if error.errno is None:
        return OSError(f"{path}: cannot be written whole: {error}")
    return OSError(error.errno, error.strerror, str(path))


@contextmanager
def naming(path: Path, form: str) -> Iterator[None]:
    """Every complaint of a decoder about the content becomes one ValueError that names the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (FileNotFoundError, PermissionError, IsADirectoryError, ImportError):
        raise
    except Exception as error:
        raise ValueError(f"{path}: cannot be read as {form}: {_reason(path, error)}") from error


def _reason(path: Path, error: Exception) -> str:
    """What a decoder says, where it speaks to the reader and not to the programmer."""
    if isinstance(error, MemoryError):
        return "there is not enough memory"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    stumbled = (LookupError, AttributeError, AssertionError, TypeError, ArithmeticError, UnicodeError, struct.error)
    reason = next(iter(str(error).strip().splitlines()), "")
    foreign = not reason.isprintable() or str(path) in reason or "b'" in reason
    return "its content is damaged" if isinstance(error, stumbled) or foreign or not reason else reason


def require(name: str, extra: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} is not installed: pip install 'torchdls[{extra}]'") from error


def one_of(path: Path, content: Mapping[str, Any], names: Sequence[str]) -> str:
    for name in names:
        if name in content:
            return name
    raise ValueError(f"{path}: holds {', '.join(content) or 'nothing'}, {' or '.join(names)} is needed")


def pair(path: Path, value: Any) -> tuple[float, float]:
    try:
        numbers = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.size not in (1, 2) or not (np.isfinite(numbers) & (numbers > 0)).all():
        given = " x ".join(f"{number:g}" for number in numbers[:3]) or "nothing of use"
        raise ValueError(f"{path}: pixel_size: {given} given, one or two positive numbers are needed")
    return float(numbers[0]), float(numbers[-1])


def as_tensor(array: Array) -> Tensor:
    """Bool, float32 or float64 in native byte order; half precision is widened."""
    wanted = array.dtype if array.dtype.kind == "b" else np.float64 if array.dtype.itemsize >= 8 else np.float32
    return torch.from_numpy(np.ascontiguousarray(array, dtype=wanted))


def as_array(value: Tensor | Array | float) -> Array:
    return value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)


def single_map(name: str, tensor: Tensor) -> Array:
    array = as_array(tensor)
    if array.ndim not in (2, 3, 4) or array.size != np.prod(array.shape[-2:]) or not array.size:
        raise ValueError(f"{name}: shape {tuple(array.shape)} given, one surface (1, 1, H, W) or (H, W) is needed")
    return array.reshape(array.shape[-2:])
