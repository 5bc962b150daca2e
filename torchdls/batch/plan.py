"""Which maps there are, what their results are called, and what would go wrong, before any work."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from torchdls.batch.maps import MASK, Source, folder_source
from torchdls.batch.stores import find_in_store, is_url
from torchdls.io.formats import SIGNATURES


class Job(NamedTuple):
    """A map and its results: one name below the folder for results, one file for each format."""

    source: Source
    name: str
    outputs: tuple[str, ...]


def find_maps(inputs: Sequence[str], *, leave_out: str | None = None) -> list[tuple[str, Source]]:
    """The maps of files, patterns and folders with their names, in the order of the inputs, folders sorted.

    A file is named by its name without the suffix; what a folder or the fixed part of a pattern holds, by its path
    below that; a folder with normal_map.png by itself.

    Args:
        inputs: files, folders and patterns; files and folders in stores by their URL.
        leave_out: a folder that is not looked into: that of the results.

    Raises:
        FileNotFoundError: an input does not exist, or a pattern matches nothing.
        ValueError: a folder holds no map.
    """
    hidden = None if leave_out is None else os.path.realpath(leave_out)
    found: list[tuple[str, Source]] = []
    for given in inputs:
        if is_url(given):
            found += find_in_store(given)
        elif os.path.isdir(given):
            inside = list(_in_folder(given, hidden))
            if not inside:
                raise ValueError(f"{given}: holds no map: neither normal_map.png nor a file that can be read")
            found += inside
        elif os.path.lexists(given) or not glob.has_magic(given):
            os.stat(given)
            found.append((Path(given).stem, Source(given)))
        else:
            found += _matching(given)
    return found


def listed_maps(lines: Iterable[str]) -> list[tuple[str, Source]]:
    """The maps of a list of files and folders, one a line, named by their paths below the folder that holds them all.

    Raises:
        FileNotFoundError: one of them does not exist.
        ValueError: the list is empty, or a folder is not one map.
    """
    paths = [line.rstrip("\n") for line in lines if line.strip()]
    if not paths:
        raise ValueError("-: the list on standard input is empty")
    base = os.path.commonpath([os.path.dirname(os.path.abspath(path)) for path in paths])
    return [(_name(path, base), _one(path)) for path in paths]


def _one(path: str) -> Source:
    if not os.path.isdir(path):
        os.stat(path)
        return Source(path)
    source = folder_source(path)
    if source is None:
        raise ValueError(f"{path}: a folder without normal_map.png is not one map")
    return source


def _name(path: str, base: str) -> str:
    """The path below a folder, without the suffix of a file."""
    below = os.path.relpath(os.path.abspath(path), os.path.abspath(base))
    return below if os.path.isdir(path) else os.path.splitext(below)[0]


def _matching(pattern: str) -> list[tuple[str, Source]]:
    paths = sorted(glob.glob(pattern, recursive=True))
    if not paths:
        raise FileNotFoundError(f"{pattern}: matches no file")
    parts = Path(pattern).parts
    base = str(Path(*parts[: next(i for i, part in enumerate(parts) if glob.has_magic(part))]))
    folders = {path: folder_source(path) for path in paths if os.path.isdir(path)}
    kept = [path for path in paths if folders.get(path) is not None or _is_map(path)]
    if not kept:
        raise FileNotFoundError(f"{pattern}: matches no map")
    return [(_name(path, base), folders.get(path) or Source(path)) for path in kept]


def _is_map(path: str) -> bool:
    """A file of a format that is read, and no mask by its name."""
    stem, suffix = os.path.splitext(os.path.basename(path))
    return suffix.lower() in SIGNATURES and stem != MASK and not stem.startswith(".") and os.path.isfile(path)


def _in_folder(top: str, hidden: str | None) -> Iterator[tuple[str, Source]]:
    own = folder_source(top)
    if own is not None:
        yield os.path.basename(os.path.abspath(top)), own
        return
    for folder, below, files in os.walk(top):
        below[:] = sorted(d for d in below if not d.startswith(".") and _goes_in(os.path.join(folder, d), hidden))
        source = folder_source(folder) if folder != top else None
        if source is not None:
            below[:] = []
            yield os.path.relpath(folder, top), source
            continue
        for path in (os.path.join(folder, name) for name in sorted(files)):
            if _is_map(path):
                yield _name(path, top), Source(path)


def _goes_in(folder: str, hidden: str | None) -> bool:
    return hidden is None or os.path.realpath(folder) != hidden


def plan(found: Sequence[tuple[str, Source]], out: str, suffixes: Sequence[str]) -> list[Job]:
    """Where every result goes.

    Raises:
        ValueError: two maps would have one name, or a result would replace an input.
    """
    jobs, names = [], dict[str, str]()
    inputs = {os.path.realpath(source.path) for _, source in found}
    for name, source in found:
        if name in names:
            both = f"{names[name]} and {source.path}"
            raise ValueError(f"{both}: both results would be called {name}{suffixes[0]}; give them apart")
        names[name] = source.path
        outputs = tuple(os.path.join(out, name + suffix) for suffix in suffixes)
        for output in outputs:
            if os.path.realpath(output) in inputs:
                raise ValueError(f"{output}: the result of {source.path} would replace an input; choose another --out")
        jobs.append(Job(source, name, outputs))
    return jobs
