"""Drawing a case by its number, and judging it."""

from __future__ import annotations

import traceback

from tests.fuzz import integrators, targets
from tests.fuzz.case import Case, Flaw, numbered

MAKERS = [*integrators.MAKERS, *targets.MAKERS]


def draw(seed: int, i: int) -> Case:
    """Case i of a seed."""
    rng = numbered(seed, i)
    makers, shares = zip(*MAKERS, strict=True)
    return rng.choices(makers, shares)[0](rng)


def judge(case: Case) -> tuple[str, bool]:
    """What an oracle objects to, or nothing; and whether the call gave a result."""
    try:
        return "", case.run()
    except Flaw as flaw:
        return str(flaw), False
    except Exception as error:  # whatever else a call raises is a flaw
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"raised {type(error).__name__}: {error} ({where.filename}:{where.lineno})", False
