"""How the command line takes a normal map: its convention, what faces away, what is background."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, NamedTuple

from torchdls._conventions import AUTO, NORMAL_CONVENTIONS

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.io import Field

_CLEARLY = 2.0  # a reading this many times as integrable as another is worth a word
_SURELY = 0.99  # whatever sums round by
_FLAT = 0.02  # residuals below it are rounding, whichever is smaller


class Reading(NamedTuple):
    """Slopes in the library's convention, the mask of the valid ones, the convention, and what is to be said."""

    gradient: Tensor
    mask: Tensor
    convention: str
    notes: tuple[str, ...]


def read_normals(path: str, field: Field, asked: str | None, camera: Tensor | None = None) -> Reading:
    """Slopes of a normal map, under the convention asked for (default: the first of the table) or the best (`auto`).

    Raises:
        ValueError: the convention is unknown, no pixel holds a normal, or most normals face away from the viewer.
    """
    from torchdls.geometry import normals_to_gradient

    known = list(NORMAL_CONVENTIONS)
    if asked not in (None, AUTO, *known):
        raise ValueError(f"--convention: {asked!r} is not for normals; choose from {', '.join((*known, AUTO))}")
    given = field.values.isfinite().all(1, keepdim=True) & (field.values != 0).any(1, keepdim=True)
    inside = given if field.mask is None else given & field.mask
    if not inside.any():
        raise ValueError(f"{path}: no valid normal, all is background")
    name = known[0] if asked in (None, AUTO) else asked
    found = normals_to_gradient(field.values, name, mask=inside, camera=camera)
    if found.mask.sum() <= 0.5 * inside.sum():
        shares = {
            other: float(normals_to_gradient(field.values, other, mask=inside, camera=camera).mask.sum() / inside.sum())
            for other in known
        }
        facing = [other for other in known if shares[other] > 0.5]
        if asked != AUTO or not facing:
            _refuse(path, name, shares[name], facing)
        name = facing[0]
    # Of readings with the same sign of z all face the viewer, or none.
    facing = [other for other in known if NORMAL_CONVENTIONS[other][2] == NORMAL_CONVENTIONS[name][2]]
    best, clearer = _most_integrable(*_tiles(field.values, inside, camera), facing, name)
    notes = [f"torchdls: warning: {path}: {clearer}"] * bool(clearer and asked != AUTO)
    if asked == AUTO:
        name = best
        found = normals_to_gradient(field.values, name, mask=inside, camera=camera)
    background = int((~given if field.mask is None else ~given & field.mask).sum())
    notes += [f"{path}: {background} pixels of background are left out"] * bool(background)
    notes += [f"{path}: {int(found.invalid)} normals that face away or lie at grazing angle are left out"] * bool(
        found.invalid
    )
    return Reading(found.gradient, found.mask, name, tuple(notes))


def _refuse(path: str, name: str, share: float, facing: list[str]) -> None:
    away = f"{path}: {1 - share:.0%} of the normals face away from the viewer under convention {name!r}"
    way = f"they face it under {' and '.join(facing)}" if facing else "under no convention do most of them face it"
    raise ValueError(f"{away}; {way}" + (f": --convention {facing[0]}" if facing else ""))


def _most_integrable(
    normals: Tensor, mask: Tensor, camera: Tensor | None, candidates: list[str], name: str
) -> tuple[str, str]:
    """The convention under which the normals are most nearly those of a surface, and a word if `name` is far worse."""
    from torchdls.geometry import guess_convention

    try:
        guess = guess_convention(normals, mask, candidates, camera=camera)
    except ValueError:  # no 2x2 cell of valid pixels: nothing to tell by
        return name, ""
    here, best = guess.residual[name], guess.residual[guess.convention]
    if here < _FLAT or here < _CLEARLY * best:
        return name, ""  # as good as any; what the user said, or the usual, stands
    times = f"{here / best:.2g} times" if best > 0.01 * here else "far"
    return guess.convention, (
        f"under convention {guess.convention!r} the normals are {times} more nearly those of a surface "
        f"than under {name!r}; --convention {guess.convention} or auto takes it"
    )


def says_nothing(residual: dict[str, Tensor], name: str) -> Tensor:
    """Of which maps (N,) `read_normals` surely has no word about the convention, from the residuals under each."""
    import torch

    here, best = residual[name], torch.stack(list(residual.values())).amin(0)
    return (here < _SURELY * _FLAT) | (here < _SURELY * _CLEARLY * best)


def _tiles(
    normals: Tensor, mask: Tensor, camera: Tensor | None, size: int = 256, most: int = 16
) -> tuple[Tensor, Tensor, Tensor | None]:
    """A large map as a batch of tiles, spread over what is valid: enough to tell a convention by."""
    import torch

    h, w = normals.shape[-2:]
    if h * w <= most * size**2 or min(h, w) < size:
        return normals, mask, camera
    corners = [
        (y, x)
        for y in range(0, h - size + 1, size)
        for x in range(0, w - size + 1, size)
        if mask[..., y : y + size, x : x + size].any()
    ]
    corners = random.Random(0).sample(corners, min(most, len(corners))) or [(0, 0)]
    cut = [(..., slice(y, y + size), slice(x, x + size)) for y, x in corners]
    if camera is not None:  # the principal point, seen from the corner of each tile
        camera = camera.repeat(len(corners), 1, 1)
        camera[:, :2, 2] -= torch.tensor([(x, y) for y, x in corners], dtype=camera.dtype)
    return torch.cat([normals[part] for part in cut]), torch.cat([mask[part] for part in cut]), camera
