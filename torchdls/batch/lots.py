"""Lots: surfaces of exactly one size that are integrated together, and which may be, without a bit that changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import TypeVar

from torchdls.integrators import Integrator, LeastSquares
from torchdls.operators.cosine import MATRIX_LIMIT

# Bytes that a method takes for each pixel (measured: SlopeDLS 330, float32), and those of a pixel that waits.
BYTES_IN_WORK, BYTES_AT_REST = 512, 16
# Pixels after which a lot gains nothing more (measured: 16 maps of 64 x 64): it leaves the cache.
ENOUGH = 2**16
_STEP = 16

T = TypeVar("T")


def same_bits(integrator: Integrator, size: Sequence[int]) -> bool:
    """Whether a surface of this size may have the same bits alone and in any batch.

    That holds for least squares with sides of 16, 32, 48 or 64 pixels: the transforms are then products with matrices,
    whose sums run in one order for every row as long as the sides are whole vectors. The arithmetic after FFTs, on
    longer sides, rounds by where in the batch a number stands, and so do the sums of other methods (SlopeDLS changed
    the bits of 5 surfaces in 30, and gains little). Found by trial (not one in 19,558 surfaces differed), kept by
    `tests/batch/test_bits.py`, and tried anew in every process (`together`).
    """
    plain = type(integrator) is LeastSquares and integrator.boundary == "neumann"
    return plain and not any(n % _STEP or n > MATRIX_LIMIT for n in size)


def most_together(pixels: int, memory: int, exact: bool = True) -> int:
    """How many surfaces of so many pixels make a lot."""
    room = memory // (2 * BYTES_IN_WORK)
    return max(1, (min(room, ENOUGH) if exact else room) // pixels)


def in_lots(
    items: Iterable[T], key: Callable[[T], Hashable | None], pixels: Callable[[T], int], memory: int, exact: bool = True
) -> Iterator[list[T]]:
    """Items of one key together, as many as make a lot; those with key None alone.

    When what waits outgrows a quarter of the memory, the largest unfinished lot goes first.
    """
    waiting: dict[Hashable, list[T]] = {}
    room, held = memory // (4 * BYTES_AT_REST), 0
    for item in items:
        kind = key(item)
        if kind is None:
            yield [item]
            continue
        lot = waiting.setdefault(kind, [])
        lot.append(item)
        held += pixels(item)
        if len(lot) < most_together(pixels(item), memory, exact):
            if held <= room:
                continue
            kind = max(waiting, key=lambda k: len(waiting[k]) * pixels(waiting[k][0]))
        lot = waiting.pop(kind)
        held -= sum(map(pixels, lot))
        yield lot
    yield from waiting.values()
