"""Timing that neighbours on the machine disturb least: candidates take turns, and medians are compared."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median, quantiles
from typing import Any

# Threads of OpenBLAS that have nothing to do keep a core busy for about a tenth of a second, at the cost of whoever
# comes next; so every candidate waits for the last one's threads to go to sleep, and then warms up.
_PAUSE = 0.15
_TURN = 0.05


def interleaved(
    candidates: dict[str, Callable[[], Any]],
    seconds: float = 4.0,
    least: int = 3,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Times of every candidate, in turns (A B C A B C ..) until the time is up.

    With `time.process_time` as the clock, what neighbours take of the processor does not count.

    A turn is an untimed run and a timed one, or as many timed ones as a twentieth of a second holds.
    """
    times: dict[str, list[float]] = {name: [] for name in candidates}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(next(iter(times.values()))) < least:
        for name, run in candidates.items():
            time.sleep(_PAUSE)
            run()
            begin = start = clock()
            while start < begin + _TURN:
                run()
                now = clock()
                times[name].append(now - start)
                start = now
    return times


def statistics(times: list[float]) -> dict[str, float]:
    """Median and quartiles in milliseconds."""
    low, _, high = quantiles(times, n=4) if len(times) > 1 else (times[0],) * 3
    return {"median_ms": 1e3 * median(times), "q1_ms": 1e3 * low, "q3_ms": 1e3 * high, "runs": len(times)}


def peak_megabytes() -> float:
    """Largest resident size of this process so far."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage hands a new process the peak of the one that started it
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM")) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fresh_process(module: str, *arguments: str) -> str:
    """What a script of this folder, named as a module, prints in a process of its own."""
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(
        command, cwd=Path(__file__).resolve().parents[2], capture_output=True, text=True, check=True
    ).stdout
