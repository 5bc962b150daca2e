"""Object stores, by fsspec: fetched before reading; written beside their place, then published."""

from __future__ import annotations

import os
import re
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from torchdls._files import require
from torchdls.batch.maps import CAMERA, MASK, NORMALS, Source
from torchdls.io.formats import SIGNATURES


def is_url(path: str) -> bool:
    """Whether a path is one in a store, such as s3://bucket/maps."""
    return re.match(r"[a-zA-Z][a-zA-Z0-9+.-]+://", path) is not None


def _store(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    found: tuple[Any, str] = require("fsspec", "stores").core.url_to_fs(url)
    return found


def exists(path: str) -> bool:
    """Whether there is a file of that name, or anything in its place."""
    if not is_url(path):
        return os.path.lexists(path)
    store, place = _store(path)
    return bool(store.exists(place))


def find_in_store(url: str) -> list[tuple[str, Source]]:
    """The maps below a URL with their names, by the rules of `find_maps`.

    Raises:
        FileNotFoundError: there is nothing.
        ValueError: there is no map. ImportError: fsspec, or the library of the store, is not installed.
    """
    store, top = _store(url)
    if store.isfile(top):
        return [(PurePosixPath(top).stem, Source(url))]
    folders: dict[str, list[str]] = defaultdict(list)
    for path in sorted(store.find(top)):
        folders[path.rpartition("/")[0]].append(path)
    if not folders:
        raise FileNotFoundError(f"{url}: there is nothing of this name")
    maps = [entry for folder, paths in folders.items() for entry in _maps(folder, paths)]
    if not maps:
        raise ValueError(f"{url}: holds no map: neither normal_map.png nor a file that can be read")
    base = top.rstrip("/")
    return [
        (
            (name[len(base) :].strip("/") or PurePosixPath(base).name),
            Source._make(part and store.unstrip_protocol(part) for part in source),
        )
        for name, source in maps
    ]


def _maps(folder: str, paths: list[str]) -> Iterator[tuple[str, Source]]:
    """What one folder holds: the map that it is, or its files."""
    files = {PurePosixPath(path): path for path in paths}
    pictures = {pure: path for pure, path in files.items() if pure.suffix.lower() in SIGNATURES}
    of = {stem: [path for pure, path in pictures.items() if pure.stem == stem] for stem in (NORMALS, MASK)}
    if of[NORMALS]:
        camera = next((path for pure, path in files.items() if pure.name == CAMERA), None)
        yield folder, Source(of[NORMALS][0], of[MASK][0] if of[MASK] else None, camera)
        return
    for pure, path in pictures.items():
        if pure.stem != MASK and not pure.name.startswith("."):
            yield str(pure.with_suffix("")), Source(path)


@contextmanager
def fetched(source: Source) -> Iterator[Source]:
    """The files of a map on this machine."""
    if not any(part is not None and is_url(part) for part in source):
        yield source
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Source(*(None if part is None else _fetch(part, folder) for part in source))  # type: ignore[arg-type]


def _fetch(path: str, folder: str) -> str:
    if not is_url(path):
        return path
    store, place = _store(path)
    here = os.path.join(folder, PurePosixPath(place).name)
    store.get_file(place, here)
    return here


@contextmanager
def placed(output: str) -> Iterator[str]:
    """A path on this machine for a result; when the block ends without an error, it is in its place."""
    if not is_url(output):
        folder = os.path.dirname(output) or "."
        if not os.path.isdir(folder):
            os.makedirs(folder, exist_ok=True)
        yield output
        return
    store, place = _store(output)
    with tempfile.TemporaryDirectory() as folder:
        here = os.path.join(folder, PurePosixPath(place).name)
        yield here
        draft = f"{place}.{Path(folder).name}.draft"
        store.makedirs(place.rpartition("/")[0], exist_ok=True)
        try:
            store.put_file(here, draft)
            store.mv(draft, place)
        except BaseException:
            if store.exists(draft):
                store.rm_file(draft)
            raise
