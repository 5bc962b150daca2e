"""The part of the image that a mask leaves alive, on the grid of the patches."""

from __future__ import annotations

from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor

from torchdls._tracing import is_concrete
from torchdls.integrators.base import Fields
from torchdls.operators import Patches


class Window(NamedTuple):
    """A rectangle of pixels, and the rectangle of the patch grid that lies within it.

    Cut to the window, an image has just these patches. All others hold no valid pixel, so that their codes are 0 and
    they have no say in the dictionary: DLS finds the same surface within the window as on the whole image.
    """

    pixels: tuple[slice, slice]
    patches: tuple[slice, slice]
    shape: tuple[int, int]
    grid: tuple[int, int]

    def crop(self, fields: Fields) -> Fields:
        """The fields within the window."""

        def cut(t: Tensor | None) -> Tensor | None:
            return t if t is None or t.shape[-2:] == (1, 1) else t[(..., *self.pixels)]

        return Fields(
            fields.gradient[(..., *self.pixels)],
            cut(fields.mask),
            cut(fields.weight),
            cut(fields.anchor),
            cut(fields.anchor_weight),
            fields.steps,
            fields.on_edges,
        )

    def put_back(self, image: Tensor) -> Tensor:
        """(.., H, W), zero outside the window."""
        (top, bottom), (left, right) = ((s.start, m - s.stop) for s, m in zip(self.pixels, self.shape, strict=True))
        return F.pad(image, (left, right, top, bottom))

    def crop_codes(self, codes: Tensor) -> Tensor:
        """(N, K, L') codes of the patches within the window, out of those of all patches."""
        return codes.unflatten(-1, self.grid)[(..., *self.patches)].flatten(-2)

    def put_codes_back(self, codes: Tensor) -> Tensor:
        """(N, K, L) codes of all patches of the image, zero outside the window."""
        rows, columns = self.patches
        (top, bottom), (left, right) = ((s.start, m - s.stop) for s, m in zip(self.patches, self.grid, strict=True))
        codes = codes.unflatten(-1, (rows.stop - rows.start, columns.stop - columns.start))
        return F.pad(codes, (left, right, top, bottom)).flatten(-2)


def live_window(mask: Tensor | None, patches: Patches) -> Window | None:
    """The smallest window that holds every patch with a valid pixel, on any surface of the batch.

    None where it would be the whole image, or where the values of the mask cannot be looked at.
    """
    if mask is None or not is_concrete(mask):
        return None
    shape = (mask.shape[-2], mask.shape[-1])
    grid = patches.grid(shape)
    live = mask.any(0)[0]
    (rows, down), (columns, across) = (_touching(patches, axis, live.any(1 - axis)) for axis in (0, 1))
    if (rows, columns) == (slice(0, shape[0]), slice(0, shape[1])):
        return None
    return Window((rows, columns), (down, across), shape, grid)


def _touching(patches: Patches, axis: int, hit: Tensor) -> tuple[slice, slice]:
    found = hit.nonzero()
    return patches.touching(axis, len(hit), int(found[0]), int(found[-1]))
