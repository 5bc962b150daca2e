"""`python -m tests.fuzz`: so many cases of one seed, the failures with their calls, and a table of what was tried."""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter

import torch

from tests.fuzz.run import draw, judge


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="one case again")
    parser.add_argument("--slowest", action="store_true", help="name the slowest cases")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    numbers = range(chosen.cases) if chosen.only is None else [chosen.only]
    tried: Counter[str] = Counter()
    served: Counter[str] = Counter()
    failed, times = 0, []
    for i in numbers:
        began = time.perf_counter()
        case = draw(chosen.seed, i)
        what = case.label or "errors"
        if chosen.only is not None:
            print(case)
        flaw, answered = judge(case)
        times.append((time.perf_counter() - began, i, what))
        tried[what] += 1
        served[what] += answered
        if flaw:
            failed += 1
            print(f"seed {chosen.seed}, case {i}: {flaw}\n{case}\n", flush=True)
    for what, count in sorted(tried.items()):
        print(f"{what:24} {count:6} calls, {count - served[what]:6} refused")
    if chosen.slowest:
        for took, i, what in sorted(times, reverse=True)[:15]:
            print(f"{took:8.2f} s  case {i}, {what}")
    print(f"{sum(tried.values())} cases of seed {chosen.seed} in {sum(t for t, *_ in times):.0f} s: {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    random.seed(0)
    sys.exit(main())
