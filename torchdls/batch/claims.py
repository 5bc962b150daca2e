"""Who does which map: claims by exclusive creation in a folder that all processes share, and no other talk.

A claim is a file `KEY.G` (G = 0, 1, ..) made exclusively, which names its owner; the highest G counts. An owner is a
file too: it is locked while its process lives and touched every few seconds. On the owner's own machine the lock tells
whether it lives, elsewhere the age of its last touch, by the clock of the file server. What a dead owner left is taken
over by making `KEY.G+1`, which of several ranks exactly one can. Nothing is ever deleted but by the one who holds it.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import threading
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_BEATS = 6  # touches of an owner's file in the age at which it counts as gone


class Claims:
    """The claims of one process on the maps of a folder; a context that keeps its owner's file alive.

    Args:
        folder: the folder for claims, shared by all processes; made if it is missing.
        age: seconds without a sign of life after which an owner on another machine is gone.

    Raises:
        OSError: the folder cannot be written to.
    """

    def __init__(self, folder: Path, age: float = 120.0) -> None:
        self._claims, self._owners, self._failed = (folder / part for part in ("claims", "owners", "failed"))
        self._age = age
        for part in (self._claims, self._owners, self._failed):
            part.mkdir(parents=True, exist_ok=True)
        self._id = f"{_kernel()}-{os.getpid()}-{secrets.token_hex(4)}"
        self._beat = self._owners / self._id
        self._held: dict[str, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)

    def __enter__(self) -> Self:
        self._file = open(self._beat, "x")  # it stays open, and locked, while the process lives
        if fcntl is not None:
            with suppress(OSError):  # a file system without locks: the age tells
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._began = self._beat.stat().st_mtime
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        for name in list(self._held):
            self.release(name)
        with suppress(OSError):
            self._beat.unlink()
        self._file.close()

    def forget(self) -> None:
        """Let go of the owner's file in a process that was forked: the lock shall end with its parent."""
        self._file.close()

    def take(self, name: str, done: Callable[[], bool]) -> bool:
        """Whether this process now holds the map; not where another does, did (`done`), or failed since we began."""
        key = _key(name)
        if self._failed_since(key):
            return False
        for generation in range(1 << 20):
            place = os.path.join(self._claims, f"{key}.{generation}")
            try:
                file = os.open(place, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
            except FileExistsError:
                if self._lives(Path(place)):
                    return False
                continue
            self._sign(file, place)
            self._held[name] = generation
            if done() or self._failed_since(key):  # by someone who let go between our look and our claim
                self.release(name)
                return False
            return True
        return False

    def _sign(self, file: int, place: str) -> None:
        """The owner's name into a claim just made; if it cannot be written, as on a full disk, nothing is claimed."""
        try:
            try:
                os.write(file, self._id.encode())  # so short that it is written whole or not at all
            finally:
                os.close(file)
        except OSError as error:
            with suppress(OSError):
                os.unlink(place)
            raise OSError(error.errno, error.strerror, place) from error

    def release(self, name: str) -> None:
        """Let go of a map that is done, or will not be."""
        key = _key(name)
        for generation in range(self._held.pop(name, -1) + 1):
            with suppress(OSError):
                os.unlink(os.path.join(self._claims, f"{key}.{generation}"))

    def fail(self, name: str) -> None:
        """Let go of a map that cannot be done; no process that runs now tries it again."""
        with suppress(OSError):
            (self._failed / _key(name)).touch()
        self.release(name)

    def succeed(self, name: str) -> None:
        """Let go of a map whose results are in their places."""
        with suppress(OSError):
            os.unlink(os.path.join(self._failed, _key(name)))
        self.release(name)

    def has_failed(self, name: str) -> bool:
        """Whether another process found, since this one began, that the map cannot be done."""
        return self._failed_since(_key(name))

    def _failed_since(self, key: str) -> bool:
        try:
            return os.stat(os.path.join(self._failed, key)).st_mtime > self._began
        except OSError:
            return False

    def _lives(self, claim: Path) -> bool:
        """Whether the owner of a claim lives; one that has not written its name yet does, for a while."""
        try:
            owner = claim.read_text()
            if not owner:
                return self._now() - claim.stat().st_mtime < self._age
        except OSError:  # let go just now
            return True
        beat = self._owners / owner
        if owner == self._id:
            return True
        if fcntl is not None and owner.startswith(f"{_kernel()}-"):
            try:
                with open(beat) as file:
                    fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                    return False
            except FileNotFoundError:
                return False
            except OSError:
                return True
        try:
            return self._now() - beat.stat().st_mtime < self._age
        except FileNotFoundError:
            return False

    def _now(self) -> float:
        """The time by the clock that stamps the files."""
        os.utime(self._beat)
        return self._beat.stat().st_mtime

    def _live(self) -> None:
        while not self._stop.wait(self._age / _BEATS):
            with suppress(OSError):
                os.utime(self._beat)


def _key(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:32]


def _kernel() -> str:
    """Processes that share it share their locks."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", "")
    except OSError:
        return f"{uuid.getnode():x}"
