"""Small pictures of one size read together: the same normals, slopes and decisions, with one call in the place of many.

A picture of 64 x 64 pixels is read in a fifth of a millisecond; to find its packing and convention takes ten times as
long by itself, nearly all of it the cost of calls. What is done here to a stack is arithmetic on single numbers, with
the same bits as for one; what is decided holds with a margin, so that sums that round otherwise decide alike. Whatever
is not plain (a mask, a camera, background, another packing, a doubtful convention) is left to `read_map`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchdls._files import Array
from torchdls.batch.lots import ENOUGH
from torchdls.batch.maps import Manner, Map, Source
from torchdls.geometry import NORMAL_CONVENTIONS
from torchdls.geometry.normals import convention_residuals, normals_to_gradient
from torchdls.io.formats import ARRAYS, SIGNATURES, read_file
from torchdls.io.packing import unpack_rgb
from torchdls.io.reading import says_nothing

_PICTURES = tuple(suffix for suffix in SIGNATURES if suffix not in ARRAYS)


def read_plain(sources: Sequence[Source], manner: Manner) -> list[Map | None]:
    """Of each source what `read_map` finds, or None where it is to be asked."""
    found: list[Map | None] = [None] * len(sources)
    name = manner.convention or next(iter(NORMAL_CONVENTIONS))
    if manner.packing is not None or manner.camera is not None or name not in NORMAL_CONVENTIONS:
        return found
    stacks: dict[tuple[tuple[int, ...], np.dtype], dict[int, Array]] = {}
    for k, source in enumerate(sources):
        codes = _codes(source, manner)
        if codes is not None:
            stacks.setdefault((codes.shape, codes.dtype), {})[k] = codes
    for stack in stacks.values():
        gradient, plain = _slopes(np.stack(list(stack.values())), name, manner)
        for k, slopes, sure in zip(stack, gradient.split(1), plain.tolist(), strict=True):
            if sure:
                size = manner.pixel_size or (1.0, 1.0)
                found[k] = Map(slopes, None, None, size, None, "normals", "rgb", name, ())
    return found


def _codes(source: Source, manner: Manner) -> Array | None:
    """(H, W, 3) of a small picture in colours that comes without a mask or a camera."""
    path = Path(source.path)
    beside = source.mask is not None or (source.camera is not None and manner.own_camera)
    if beside or path.suffix.lower() not in _PICTURES:
        return None
    try:
        content = read_file(path, _PICTURES)
    except (ValueError, OSError, ImportError, MemoryError):  # `read_map` says it
        return None
    codes = isinstance(content, np.ndarray) and content.dtype in (np.uint8, np.uint16)
    usable = codes and content.ndim == 3 and content.shape[-1] == 3 and 4 <= content.size <= ENOUGH  # type: ignore[union-attr]
    return content if usable else None  # type: ignore[return-value]


def _slopes(codes: Array, name: str, manner: Manner) -> tuple[Tensor, Tensor]:
    """(N, 2, H, W) of pictures (N, H, W, 3), and which of them (N,) are plain."""
    unpacked, sure = unpack_rgb(codes)
    normals = torch.from_numpy(unpacked).to(torch.float64 if manner.double else torch.float32)
    field = normals_to_gradient(normals, name)
    full = (normals != 0).any(1).all((-2, -1)) & field.mask.all((-3, -2, -1))
    facing = [other for other in NORMAL_CONVENTIONS if NORMAL_CONVENTIONS[other][2] == NORMAL_CONVENTIONS[name][2]]
    quiet = says_nothing(convention_residuals(field, name, facing), name)
    return field.gradient, torch.from_numpy(sure) & full & quiet
