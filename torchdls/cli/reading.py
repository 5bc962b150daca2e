"""How the command line takes a normal map: its convention, what faces away, what is background."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.io import Field

AUTO = "auto"
_CLEARLY = 2.0  # a reading this many times as integrable as another is worth a word
_FLAT = 0.02  # residuals below it are rounding, whichever is smaller


class Reading(NamedTuple):
    """Slopes in the library's convention, the mask of the valid ones, the convention, and what is to be said."""

    gradient: Tensor
    mask: Tensor
    convention: str
    notes: tuple[str, ...]


def read_normals(path: str, field: Field, asked: str | None, camera: Tensor | None = None) -> Reading:
    """Slopes of a normal map, under the convention asked for (default: opengl) or the best (`auto`).

    Raises:
        ValueError: the convention is unknown, no pixel holds a normal, or most normals face away from the viewer.
    """
    from torchdls.geometry import NORMAL_CONVENTIONS, normals_to_gradient

    known = list(NORMAL_CONVENTIONS)
    if asked not in (None, AUTO, *known):
        raise ValueError(f"--convention: {asked!r} is not for normals; choose from {', '.join((*known, AUTO))}")
    given = field.values.isfinite().all(1, keepdim=True) & (field.values != 0).any(1, keepdim=True)
    inside = given if field.mask is None else given & field.mask
    if not inside.any():
        raise ValueError(f"{path}: no valid normal, all is background")
    shares = {
        name: float(normals_to_gradient(field.values, name, mask=inside, camera=camera).mask.sum() / inside.sum())
        for name in known
    }
    facing = [name for name in known if shares[name] > 0.5]
    name = known[0] if asked in (None, AUTO) else asked
    if asked == AUTO and facing:
        name = facing[0]
    if name not in facing:
        _refuse(path, name, shares[name], facing)
    best, clearer = _most_integrable(field.values, inside, facing, name, camera)
    notes = [f"torchdls: warning: {path}: {clearer}"] * bool(clearer and asked != AUTO)
    name = best if asked == AUTO else name
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
    normals: Tensor, mask: Tensor, candidates: list[str], name: str, camera: Tensor | None
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
