"""Where slopes are measured and how well, seen by patches: on surfaces with holes, unequal weights or anchors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdls.integrators.slope_dls.bases import Places
from torchdls.integrators.slope_dls.lines import inside


@dataclass(frozen=True)
class Known:
    """Measured slopes among continued ones.

    Args:
        valid: (N or 1, 2, H, W), 1 where a slope is measured, else 0.
        trust: (N or 1, 2, H, W) relative inverse variance, or None for 1 everywhere.
    """

    valid: Tensor
    trust: Tensor | None

    def weight(self, places: Places) -> Tensor:
        """(N, 2, rows, columns) of patches: the share of measured slopes squared; 0 for patches of continued ones."""
        return (_sums(places, self.valid) / places.size**2).square()

    def level(self, places: Places) -> Tensor:
        """(N, 2, rows, columns) of patches: noise level by the mean trust of the measured slopes, or 1."""
        if self.trust is None:
            return self.valid.new_ones(1, 1, 1, 1)
        count = _sums(places, self.valid)
        mean = _sums(places, self.valid * self.trust) / count.clamp(min=1)
        return torch.where(mean > 0, torch.where(mean > 0, mean, 1).rsqrt(), 1)


def _sums(places: Places, x: Tensor) -> Tensor:
    """Sums of (N, C, H, W) over the patches, (N, C, rows, columns)."""
    rows, columns = (inside(line, like=x) for line in places.lines)
    return rows @ x @ columns.mT
