"""The batch: maps are drawn, claimed, read, integrated in lots and written, all at once, by any number of ranks."""

from __future__ import annotations

import errno
import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from torchdls.batch.claims import Claims
from torchdls.batch.lots import BYTES_AT_REST, in_lots
from torchdls.batch.many import Integrated, Member, Trusted, lot_key, together
from torchdls.batch.maps import Manner, Map, read_map, write_map
from torchdls.batch.plain import read_plain
from torchdls.batch.plan import Job
from torchdls.batch.report import DONE, FAILED, KEPT, Progress, Report
from torchdls.batch.stores import exists, fetched, placed
from torchdls.integrators import Integrator

# Files read by a worker at a time: so many, or so many bytes.
_CHUNK, _CHUNK_BYTES = 16, 2**22
LARGE = 512**2  # pixels from which on threads pay (measured)
# Failures of the place for results, not of a map: the run ends.
_FATAL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}


@dataclass(frozen=True)
class Setting:
    """How a run goes.

    Attributes:
        manner: how maps are read.
        method: the name of the method, for the report.
        make: pixel size and camera -> integrator.
        overwrite: do all maps of the own share anew.
        memory: bytes for what waits, is in work and is being written, beside what one large map needs.
        workers: processes that read; 0 to read in this one.
        threads: for large maps, whose bits depend on them; small ones have one.
        use_threads: sets the number of threads.
        rank: which of the processes this is.
        world: how many there are.
        age: seconds without a sign of life after which a process elsewhere is gone.
    """

    manner: Manner
    method: str
    make: Callable[[tuple[float, float], Tensor | None], Integrator]
    overwrite: bool = False
    memory: int = 2**30
    workers: int = 0
    threads: int = 1
    use_threads: Callable[[int], None] = lambda n: None
    rank: int = 0
    world: int = 1
    age: float = 120.0


class _Read(NamedTuple):
    """A map as it comes from a reader: what it holds, or why it could not be read."""

    number: int
    content: Map | None
    reason: str = ""


class _Files(Dataset[list[Any]]):
    """Maps by their numbers; tensors travel as arrays, each of which would hold a file open as a tensor."""

    def __init__(self, jobs: Sequence[Job], manner: Manner) -> None:
        self.jobs, self.manner = jobs, manner

    def __getitem__(self, indices: list[int]) -> list[Any]:
        plain = read_plain([self.jobs[index].source for index in indices], self.manner)
        read = (self._read(i) if of is None else _Read(i, of) for i, of in zip(indices, plain, strict=True))
        return [_Read(*map(_as_array, part)) for part in read]

    def _read(self, index: int) -> _Read:
        try:
            with fetched(self.jobs[index].source) as source:
                return _Read(index, read_map(source, self.manner))
        except (ValueError, TypeError, OSError, ImportError, MemoryError) as error:
            return _Read(index, None, reason_of(error))


def _as_array(part: Any) -> Any:
    if isinstance(part, Map):
        return Map(*map(_as_array, part))
    return part.numpy() if isinstance(part, Tensor) else part


def _as_tensor(part: Any) -> Any:
    return torch.from_numpy(part) if isinstance(part, np.ndarray) else part


class _Chunks:
    """A sampler over whatever is drawn: a DataLoader asks it in this process, a little ahead of the work."""

    def __init__(self, drawn: Iterable[int], jobs: Sequence[Job]) -> None:
        self._drawn, self._jobs = drawn, jobs

    def __iter__(self) -> Iterator[list[int]]:
        chunk, size = list[int](), 0
        for index in self._drawn:
            chunk.append(index)
            size += _stored(self._jobs[index])
            if len(chunk) >= _CHUNK or size >= _CHUNK_BYTES:
                yield chunk
                chunk, size = [], 0
        if chunk:
            yield chunk


def _stored(job: Job) -> int:
    try:
        return os.stat(job.source.path).st_size
    except OSError:  # the reader says it
        return 0


def reason_of(error: BaseException) -> str:
    """An error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'a file'}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


class Run:
    """One process's part in the work on a folder of maps.

    Args:
        jobs: all maps, in the order that all processes share.
        setting: how the run goes.
        claims: of this process, entered.
        report: where each map gets its line.
        progress: told of each map.
    """

    def __init__(
        self, jobs: Sequence[Job], setting: Setting, claims: Claims, report: Report, progress: Progress
    ) -> None:
        self.jobs, self.setting, self.claims, self.report, self.progress = jobs, setting, claims, report, progress
        self._made: dict[tuple[tuple[float, float], float | None], Integrator] = {}
        self._trusted: Trusted = {}
        self._finished: set[int] = set()  # where all maps are done anew, files do not tell

    def all(self) -> int:
        """The own share, then what others have not begun or left behind; returns how many maps others still hold.

        Raises:
            OSError: the place for results is full or cannot be written to.
        """
        own = range(self.setting.rank, len(self.jobs), self.setting.world)
        self._pass(own, own=True)
        if self.setting.overwrite:
            return 0
        mine = set(own)
        self._pass([i for i in reversed(range(len(self.jobs))) if i not in mine])
        left, end = self._open(range(len(self.jobs))), time.monotonic() + 1.2 * self.setting.age
        while left and time.monotonic() < end:  # what a dead process elsewhere held is free by then
            if not self._pass(left):
                time.sleep(0.2)
            left = self._open(left)
        return len(left)

    def _open(self, indices: Iterable[int]) -> list[int]:
        return [i for i in indices if not self._is_done(i) and not self.claims.has_failed(self.jobs[i].name)]

    def _is_done(self, index: int) -> bool:
        if self.setting.overwrite:
            return index in self._finished
        return all(exists(output) for output in self.jobs[index].outputs)

    def _drawn(self, indices: Iterable[int], own: bool) -> Iterator[int]:
        """The maps that this process now holds."""
        for index in indices:
            if self._is_done(index):
                if own:
                    self._tell(index, KEPT)
            elif self.claims.take(self.jobs[index].name, lambda i=index: self._is_done(i)):  # type: ignore[misc]
                yield index

    def _pass(self, indices: Iterable[int], own: bool = False) -> bool:
        """Do those that are free; whether there were any."""
        drawn = self._drawn(indices, own)
        first = next(drawn, None)
        if first is None:
            return False
        with ThreadPoolExecutor(1) as writer:
            writing: deque[tuple[int, Future[None]]] = deque()
            maps = self._read(chain([first], drawn))
            try:
                for lot in in_lots(maps, self._kind, _pixels, self.setting.memory):
                    done, threads = self._integrate(lot), self._threads(lot)
                    writing.append((len(lot) * _pixels(lot[0]), writer.submit(self._write_all, done, threads)))
                    self._finish(writing, self.setting.memory // 4)
                self._finish(writing, 0)
            except BaseException:
                writer.shutdown(cancel_futures=True)
                raise
        return True

    def _read(self, drawn: Iterable[int]) -> Iterator[_Read]:
        setting = self.setting
        options = {"prefetch_factor": 2, "worker_init_fn": self._begin_reading} if setting.workers else {}
        loader = DataLoader(
            _Files(self.jobs, setting.manner),
            batch_size=None,
            sampler=_Chunks(drawn, self.jobs),
            collate_fn=list,
            num_workers=setting.workers,
            multiprocessing_context="fork" if setting.workers else None,
            **options,  # type: ignore[arg-type]
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads: readers touch none of them
            chunks = iter(loader)
        for chunk in chunks:
            for index, content, reason in chunk:
                if content is None:
                    self._fail(index, reason)
                else:
                    yield _Read(index, Map(*map(_as_tensor, content)))

    def _begin_reading(self, number: int) -> None:
        """In a reader: it neither keeps the claims of its parent nor outlives it, waiting to hand over what it read."""
        self.claims.forget()
        threading.Thread(target=_follow, args=(os.getppid(),), daemon=True).start()

    def _method(self, of: Map) -> Integrator:
        key = _seen(of)
        if key not in self._made:
            self._made[key] = self.setting.make(of.pixel_size, of.camera)
        return self._made[key]

    def _kind(self, read: _Read) -> Hashable | None:
        of = _content(read)
        key = lot_key(Member(0, of.gradient, of.mask, of.weight), self._method(of))
        return None if key is None else (key, *_seen(of))

    def _integrate(self, lot: Sequence[_Read]) -> list[tuple[Integrated, Map]]:
        """The results of a lot, ready to be written."""
        maps = {read.number: _content(read) for read in lot}
        self.setting.use_threads(self._threads(lot))
        members = [Member(i, of.gradient, of.mask, of.weight) for i, of in maps.items()]
        found: list[tuple[Integrated, Map]] = []
        for result, _ in together(members, self._method(_content(lot[0])), self._kind(lot[0]), self._trusted):
            if result.height is None:
                self._fail(result.number, f"{self.jobs[result.number].source.path}: {result.error}")
            else:
                found.append((result, maps[result.number]))
        return found

    def _threads(self, lot: Sequence[_Read]) -> int:
        return self.setting.threads if _pixels(lot[0]) >= LARGE else 1

    def _write_all(self, done: Sequence[tuple[Integrated, Map]], threads: int) -> None:
        """Handed to the writer as one piece of work: to hand over each map costs as much as half of its writing."""
        for result, of in done:
            self._write(result, of, threads)

    def _write(self, result: Integrated, of: Map, threads: int) -> None:
        job = self.jobs[result.number]
        assert result.height is not None
        try:
            for output in job.outputs:
                if self.setting.overwrite or not exists(output):
                    with placed(output) as here:
                        write_map(here, result.height[None], of, overwrite=self.setting.overwrite)
        except FileExistsError:  # another process was faster, where claims do not reach it
            self.claims.succeed(job.name)
            self._tell(result.number, KEPT)
            return
        except (OSError, ValueError, ImportError, MemoryError) as error:
            fatal = isinstance(error, OSError) and error.errno in _FATAL
            self._fail(result.number, reason_of(error), again=fatal)
            if fatal:
                raise
            return
        self._finished.add(result.number)
        self.claims.succeed(job.name)
        told: dict[str, Any] = {"noise": result.noise, "iterations": result.iterations, "converged": result.converged}
        told |= {"seconds": round(result.seconds, 6), "together": result.together, "threads": threads}
        told |= {"size": list(result.height.shape[-2:]), "convention": of.convention, "notes": list(of.notes)}
        self._tell(result.number, DONE, method=self.setting.method, **told)

    def _finish(self, writing: deque[tuple[int, Future[None]]], room: int) -> None:
        """Wait until no more than so many bytes are being written."""
        held = sum(pixels for pixels, _ in writing) * BYTES_AT_REST
        while writing and (held > room or writing[0][1].done()):
            pixels, future = writing.popleft()
            held -= pixels * BYTES_AT_REST
            future.result()

    def _fail(self, index: int, reason: str, again: bool = False) -> None:
        (self.claims.release if again else self.claims.fail)(self.jobs[index].name)
        self._tell(index, FAILED, reason=reason)

    def _tell(self, index: int, status: str, **more: Any) -> None:
        job = self.jobs[index]
        outputs = [] if status == FAILED else list(job.outputs)
        self.report.line(status=status, input=job.source.path, output=outputs, rank=self.setting.rank, **more)
        self.progress.count(status, more.get("reason", ""))


def _follow(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _seen(of: Map) -> tuple[tuple[float, float], float | None]:
    """Its pixel size and focal length."""
    return of.pixel_size, None if of.camera is None else float(of.camera[..., 0, 0])


def _content(read: _Read) -> Map:
    assert read.content is not None
    return read.content


def _pixels(read: _Read) -> int:
    h, w = _content(read).gradient.shape[-2:]
    return h * w
