"""What a run says: a line of JSON for each map, and how far it is."""

from __future__ import annotations

import errno
import json
import os
import sys
import time
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Any, Self

DONE, KEPT, FAILED = "done", "kept", "failed"


class Report:
    """Lines of JSON at the end of a file, each written at once; a line that a killed process tore is closed first."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
        size = os.fstat(self._file).st_size
        if size and _last_byte(path) != b"\n":
            os.write(self._file, b"\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def line(self, **entries: Any) -> None:
        """Add one line.

        Raises:
            OSError: it cannot be written, or not all of it; it names the report.
        """
        line = (json.dumps(entries) + "\n").encode()
        try:
            written = os.write(self._file, line)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from error
        if written < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))


def _last_byte(path: Path) -> bytes:
    with open(path, "rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1)


class Progress:
    """How many maps of how many, in a line on standard error: on a terminal every half second, else every minute."""

    def __init__(self, total: int, quiet: bool = False) -> None:
        self.total, self.counts = total, Counter({DONE: 0, KEPT: 0, FAILED: 0})
        self.failures: list[str] = []
        self.start = self._last = time.monotonic()
        self._quiet, self._terminal = quiet, sys.stderr.isatty()

    def count(self, status: str, reason: str = "") -> None:
        """One map more; says so if it is time."""
        self.counts[status] += 1
        if status == FAILED:
            self.failures.append(reason)
        now = time.monotonic()
        if not self._quiet and now - self._last > (0.5 if self._terminal else 60.0):
            self._last = now
            print(self.line(), end="\r" if self._terminal else "\n", file=sys.stderr, flush=True)

    @property
    def rate(self) -> float:
        """Maps done per second."""
        return self.counts[DONE] / max(time.monotonic() - self.start, 1e-9)

    def line(self) -> str:
        """Where it is."""
        seen = sum(self.counts.values())
        left = max(self.total - seen, 0) / self.rate if self.rate > 0 else 0.0
        clock = f"{int(left // 3600)}:{int(left % 3600 // 60):02d}:{int(left % 60):02d}"
        kept = f", {self.counts[KEPT]} kept" if self.counts[KEPT] else ""
        return (
            f"{seen} of {self.total} maps{kept}, {self.counts[FAILED]} failed, {self.rate:.1f} a second, {clock} left"
        )
