"""Coding of patches by compiled loops (the extra `fast`), where nothing is recorded and the tensors are on the CPU.

They do what `Run` does otherwise by products of PyTorch, a few strips of patches at a time in memory that stays in the
cache: transform, threshold, count, weight, and sum of overlaps. Rounding differs, so a coefficient that is within it of
its threshold may be kept in one and not in the other.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, Literal

import torch
from torch import Tensor

from torchdls import _compiled
from torchdls._tracing import is_recorded
from torchdls.integrators.slope_dls.bases import PatchNoise, Places
from torchdls.integrators.slope_dls.coding import Coded
from torchdls.integrators.slope_dls.lines import Line, atoms
from torchdls.operators.tables import table

Weights = Literal["equal", "count", "size"]
_RULES: tuple[Weights, ...] = ("equal", "count", "size")
_LARGEST = 64  # side of a patch: products of larger ones are those of PyTorch
_FEW = 32  # patches of more than half that side: fewer do not fill the lanes
_AT_ONCE = 4096  # blocks times the side of a patch that are worked on at a time: they stay in the cache


def serves(places: Places, *tensors: Tensor) -> bool:
    """Whether the loops take patches of this size, of tensors on the CPU of which none is recorded."""
    if places.size % 2 or places.size > _LARGEST or not installed_for(*tensors):
        return False
    rows, columns = (len(line.positions) for line in places.lines)
    return 2 * places.size <= _LARGEST or rows * columns >= _FEW


def installed_for(*tensors: Tensor) -> bool:
    """Whether there are loops for tensors on the CPU of which none is recorded."""
    return _compiled.serves(*tensors) and not is_recorded(*tensors)


def _loops() -> ModuleType:
    """Loaded when first used: Numba takes half a second."""
    from torchdls.integrators.slope_dls import strip_loops

    return strip_loops


def code(
    places: Places,
    slopes: Tensor,
    level: Tensor,
    noise: PatchNoise,
    trust: Tensor | None,
    weights: Weights,
    so_far: Coded | None = None,
) -> Coded:
    """All patches coded once.

    Args:
        places: the patches.
        slopes: (N, 2, H, W).
        level: (N, 1 or 2, 1 or rows, 1 or columns) of patches; coefficients above level x noise are kept.
        noise: of the coefficients.
        trust: (N, 2, rows, columns) of patches, their weights times those of the rule; None for 1.
        weights: of a patch with K kept coefficients in the average: 1, 1 / (1 + K) or size^2 / (1 + K).
        so_far: sums to which these are added, in their memory; None for none.
    """
    loops, slopes = _loops(), slopes.detach().contiguous()
    prepared = _prepared(places, noise, like=slopes)
    halves, compact, tops, rows, starts, segments, columns, grid = (x.numpy() for x in prepared)
    own, shape = loops.by_blocks(compact, columns), (*slopes.shape[:2], *grid.tolist())
    level = level.detach().expand(shape).flatten(0, 1).contiguous()
    trust = slopes.new_ones(1, 1, 1) if trust is None else trust.detach().expand(shape).flatten(0, 1).contiguous()
    sums = _room(slopes, so_far)
    group, rule = _group(len(tops), len(starts), places.size), _RULES.index(weights)

    def one(fields: slice, strips: slice, total: Tensor, weight: Tensor) -> None:
        x, levels, trusts = slopes.flatten(0, 1)[fields], level[fields, strips], trust
        if len(trust) > 1:
            trusts = trust[fields, strips].contiguous()
        loops.code_strips(
            x.numpy(), halves, own, tops[strips], rows[strips], starts, segments, levels.contiguous().numpy(),
            trusts.numpy(), rule, group, total.numpy(), weight.numpy(),
        )  # fmt: skip

    _in_parts(one, [x.flatten(0, 1) for x in sums], len(tops), group)
    return sums


def turned_back(part: Coded, so_far: Coded | None) -> Coded:
    """Sums along the diagonals as those in x and y, whose components, now mixed, share one weight."""
    sums = _room(part.total, so_far)
    for k in range(len(part.total)):
        _loops().add_turned(*(x[k].flatten(1).numpy() for x in (*part, *sums)))
    return sums


def _room(like: Tensor, so_far: Coded | None) -> Coded:
    """Sums that may be added to."""
    if so_far is None:
        return Coded(*like.new_zeros(2, *like.shape))
    return so_far if so_far.weight.shape == like.shape else Coded(so_far.total, so_far.weight.expand_as(like).clone())


def _in_parts(one: Any, sums: list[Tensor], strips: int, group: int) -> None:
    """Both components of surfaces, and where there are more threads than those, bands of strips, which overlap."""
    with _compiled.Workers() as workers:
        pairs = len(sums[0]) // 2
        step = 2 * -(-pairs // workers.count)
        bands = min(max(1, workers.count // pairs), -(-strips // group))
        high = -(-strips // bands)
        fields = [slice(k, k + step) for k in range(0, 2 * pairs, step)]
        tasks = [(k, slice(first, first + high)) for k in fields for first in range(0, strips, high)]
        rooms = [[x[k] if part.start == 0 else torch.zeros_like(x[k]) for x in sums] for k, part in tasks]
        workers.map(lambda task, room: one(*task, *room), tasks, rooms)
    for (k, part), room in zip(tasks, rooms, strict=True):
        for total, own in zip(sums, room, strict=True):
            if part.start > 0:
                total[k] += own


def _group(strips: int, blocks: int, size: int) -> int:
    """How many strips are worked on together: much the same number each time."""
    most = max(1, min(512, max(128, _AT_ONCE // size)) // blocks)
    return -(-strips // -(-strips // most))


@table
def _prepared(places: Places, noise: PatchNoise) -> tuple[Tensor, ...]:
    """What the loops need of the patches.

    Returns:
        First halves of the even and of the odd atoms (2, size / 2, size / 2); the noise (2, rows, size, size, columns)
        of the patches, even atoms first, those in the middle of long sides once; first rows of the strips, and their
        rows in the noise; first columns of the blocks, the patches that they are the first half of (-1: none), and
        their columns in the noise; the number of strips and that of patches in each.
    """
    basis, size = atoms(places.size, places.smooth, like=torch.empty(0, dtype=torch.float64, device="cpu")), places.size
    even = (basis * basis.flip(1)).sum(1) > 0
    order = torch.cat([even.nonzero().flatten(), (~even).nonzero().flatten()])
    halves, found = basis[order, : size // 2], noise.shortened().build()
    found = found[order][..., order][:, 0].permute(1, 2, 0, 4, 3).contiguous()
    (rows, columns), (starts, segments) = places.lines, _blocks(places.lines[1])
    count = (len(rows.positions), len(columns.positions))
    at = _in_compact(torch.arange(count[0], device="cpu"), count[0], found.shape[1])
    across = _in_compact(segments.clamp(min=0), count[1], found.shape[-1])
    tops, grid = (torch.tensor(x, device="cpu") for x in (rows.positions, count))
    return halves.unflatten(0, (2, -1)).contiguous(), found, tops, at, starts, segments, across, grid


def _in_compact(patches: Tensor, count: int, known: int) -> Tensor:
    """Where the noise of patches stands among those of a shorter line, whose middle one stands for many."""
    spared = count - known
    middle = torch.full_like(patches, known // 2)
    return torch.where(patches <= middle, patches, torch.maximum(middle, patches - spared))


def _blocks(line: Line) -> tuple[Tensor, Tensor]:
    """First samples of blocks of half a segment, and the segment that each is the first half of, or -1."""
    starts: list[int] = []
    segments: list[int] = []
    for k, position in enumerate(line.positions):
        if starts and starts[-1] == position:
            segments[-1] = k
        else:
            starts.append(position)
            segments.append(k)
        starts.append(position + line.size // 2)
        segments.append(-1)
    return torch.tensor(starts, device="cpu"), torch.tensor(segments, device="cpu")
