"""Slopes and trusts of the edges of a field on disk, a band of rows at a time, equal to those of the whole."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array, as_tensor
from torchdls._statistics import NORMAL_MEDIAN
from torchdls.large.files import Field
from torchdls.large.transform import Passes
from torchdls.noise.averaging import error_of, third_differences
from torchdls.noise.level import _CUT, _TRIMMED_VARIANCE, normalised
from torchdls.operators import edge_slopes
from torchdls.operators.edges import cell_curl, mean_trust


class Edges:
    """The edges of a field, as `edge_slopes` of the whole would find them.

    With weights that needs two numbers of the whole: the mean trust, and what averaging errs by.

    Args:
        passes: over the field.
    """

    def __init__(self, passes: Passes) -> None:
        self._field, self._height = passes.field, passes.size[0]
        self._mean, self._error = 1.0, 0.0
        self._trust: tuple[Array, Array] | None = None
        if passes.field.weight is None:
            return
        self._mean = _mean_trust(passes)
        self._error = averaging_error(passes, self._mean)
        self._trust = passes.scratch("trust-x"), passes.scratch("trust-y")
        for rows in passes.bands():
            more = self.more(rows)
            _, w = self.slopes(more)
            assert w is not None
            part = slice(rows.start - more.start, rows.stop - more.start)
            for array, own in zip(self._trust, w[0], strict=True):
                array[rows] = own[part].numpy()

    def more(self, rows: slice) -> slice:
        """A band with one more row on either side, where there is one."""
        return slice(max(rows.start - 1, 0), min(rows.stop + 1, self._height))

    def slopes(self, rows: slice) -> tuple[Tensor, Tensor | None]:
        """v and w (1, 2, rows, W) of a band; the edges below its last row are missing."""
        field = self._field
        mask = None if field.mask is None else field.inside(rows)[None]
        if field.weight is None:
            return edge_slopes(field.slopes(rows)[None], mask)
        trust = field.trusts(rows)[None]
        local = float(mean_trust(trust.expand(1, 2, -1, -1)))
        # `edge_slopes` takes the error by the mean trust of what it is given: here that of the whole.
        error = self._error * local / self._mean
        v, w = edge_slopes(field.slopes(rows)[None], mask, trust, error=torch.full((1, 1, 1, 1), error).to(trust))
        assert w is not None
        return v, w * ((1 + 2 * self._error) / (1 + 2 * error))

    def trusts(self, rows: slice) -> Tensor:
        """w (1, 2, rows, W) of a band, again without the edges below its last row."""
        if self._trust is not None:
            w = torch.stack([as_tensor(np.array(array[rows])) for array in self._trust])[None]
            if rows.stop < self._height:
                w[:, 1, -1] = 0
            return w
        like = torch.zeros(1, 2, rows.stop - rows.start, self._field.shape[1], dtype=self._dtype)
        mask = None if self._field.mask is None else self._field.inside(rows)[None]
        return edge_slopes(like, torch.ones_like(like[:, :1], dtype=torch.bool) if mask is None else mask)[1]  # type: ignore[return-value]

    @property
    def _dtype(self) -> torch.dtype:
        return torch.float64 if self._field.dtype is np.float64 else torch.float32


def _mean_trust(passes: Passes) -> float:
    """Of the samples that are trusted at all, both slopes of each pixel; 1 where none is."""
    total, count = 0.0, 0
    for rows in passes.bands():
        trust = passes.field.trusts(rows).expand(2, -1, -1)
        total, count = total + float(trust.sum(dtype=torch.float64)), count + int((trust > 0).sum())
    return total / count if total > 0 else 1.0


def averaging_error(passes: Passes, mean: float) -> float:
    """`torchdls.noise.averaging_error` of a field on disk with weights, whose mean trust is known.

    The one order statistic that it needs, a median, is found in a file.
    """
    if min(passes.size) < 2 or max(passes.size) < 4:
        return 0.0
    curls, count = passes.scratch("curl"), 0
    for rows, gradient, trust in _bands(passes, mean, below=1):
        curl, cells = normalised(cell_curl(edge_slopes(gradient)[0], passes.step), trust, *passes.step)
        found = torch.where(cells, curl, torch.inf)[0].numpy()
        curls[rows] = np.inf
        curls[rows.start : rows.start + len(found), : found.shape[1]] = found
        count += int(cells.sum())
    power = _robust_scale(passes, curls, count) ** 2
    sums = torch.zeros(3, dtype=torch.float64)
    for rows, gradient, trust in _bands(passes, mean, below=3):
        own = rows.stop - rows.start
        across = third_differences(gradient[:, 0, :own], trust[:, 0, :own], -1)
        down = third_differences(gradient[:, 1], trust[:, 1], -2)
        sums += torch.stack([(a + b).double()[0] for a, b in zip(across, down, strict=True)])
    square, noise, total = sums[:, None]
    return float(error_of(square, noise, total, sums.new_tensor([power]), torch.tensor([count > 0])))


def _bands(passes: Passes, mean: float, below: int) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Bands with their slopes and trusts over the mean (1, 2, rows, W), with so many rows below, where they are."""
    field: Field = passes.field
    for rows in passes.bands():
        more = slice(rows.start, min(rows.stop + below, passes.size[0]))
        trust = field.trusts(more).expand(2, -1, -1)[None] / mean
        yield rows, field.slopes(more)[None], trust


def _robust_scale(passes: Passes, values: Array, count: int) -> float:
    """`robust_scale` of the finite values of a file (which is sorted in part); 0 where there is none."""
    if count == 0:
        return 0.0
    flat = values.reshape(-1)
    for rows in passes.bands():
        np.abs(values[rows], out=values[rows])
    flat.partition((count - 1) // 2)
    limit = _CUT * float(flat[(count - 1) // 2]) / NORMAL_MEDIAN
    square, kept = 0.0, 0
    for rows in passes.bands():
        inside = values[rows][values[rows] <= limit].astype(np.float64)
        square, kept = square + float(np.dot(inside, inside)), kept + inside.size
    return float((square / (_TRIMMED_VARIANCE * max(kept, 1))) ** 0.5)
