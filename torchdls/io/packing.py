r"""How the components of a normal are packed into channels, found from the lengths of the vectors.

Let c be a channel in [0, 1] (code/255 or code/65535; floats as they are, or over 255 or 65535).

| packing | x        | y        | z                    | where it is met                                    |
|---------|----------|----------|----------------------|----------------------------------------------------|
| `rgb`   | 2 red - 1 | 2 green - 1 | 2 blue - 1         | nearly all normal maps                             |
| `rgz`   | 2 red - 1 | 2 green - 1 | blue               | z, never negative, with all bits                   |
| `rg`    | 2 red - 1 | 2 green - 1 | sqrt(1 - x^2 - y^2) | two channels (BC5); blue missing or constant       |
| `ag`    | 2 alpha - 1 | 2 green - 1 | sqrt(1 - x^2 - y^2) | DXT5nm, x in alpha; red constant               |
| `xyz`   | red      | green    | blue                 | floats with sign                                   |

With an `a` at the end (`rgba`, `rgza`, `rga`, `xyza`) alpha is the mask; otherwise alpha is not read.

**The rule.** Black, gray and white pixels are background and have no say. Of the packings with three components the
one whose vectors have length 1 most nearly (median of | |n| - 1 |) is taken, the more usual one unless another is
twice as good; it must come within `FITS` and most normals must not lie at grazing angle. Where blue says nothing of
z (it does not follow sqrt(1 - x^2 - y^2)) or none of them fits, `rg` and `ag` are tried: x^2 + y^2 <= 1 must
hold, and one of them vary. A map that fits none is an error. Alpha is a mask where it is almost everywhere 0 or 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from torchdls._files import Array

PACKINGS = {
    "rgb": "x, y, z = 2 c - 1",
    "rgz": "x, y = 2 c - 1, z = blue",
    "rg": "x, y = 2 c - 1, z from the length 1, blue is not read",
    "ag": "x in alpha, y in green, z from the length 1 (DXT5nm)",
    "xyz": "components with their signs",
}
CHANNELS = ("rgb", "rgba", "rgz", "rgza", "rg", "rga", "ag", "xyz", "xyza")

FITS = 0.12  # largest median of | |n| - 1 |; noise of 0.1 in each component gives 0.07, random codes 0.2
_TIE = 0.01  # differences of misfit below it tell nothing: half a step of 8 bits is 0.004
_IDLE = 0.4  # blue that follows z by less of its slope (1 or 1/2) says nothing of it
_GRAY = 0.03  # channels of a background differ by less, JPEG included


class Unpacked(NamedTuple):
    """Vectors (..., H, W, 3), zero where there is no normal; the mask in alpha or None; the packing."""

    normals: Array
    mask: Array | None
    packing: str


def describe(packing: str) -> str:
    """A packing in words, as the command line says it."""
    base = packing.removesuffix("a")
    return f"{packing} ({PACKINGS[base]}{'; alpha is the mask' if base != packing else ''})"


def unpack(channels: Array, packing: str | None = None) -> Unpacked:
    """Normals from channels (..., H, W, C) with C = 2, 3 or 4: integer codes, or floats.

    Args:
        channels: uint8, uint16 or floats.
        packing: one of `CHANNELS`; None: found by the rule at the top of this module.

    Raises:
        ValueError: the packing is unknown or needs more channels, or the lengths of the vectors fit none.
    """
    if packing is not None and packing not in CHANNELS:
        raise ValueError(f"packing: {packing!r} is unknown; choose from {', '.join(CHANNELS)}")
    candidates = _scaled(channels)
    alpha = candidates[-1][..., 3] if channels.shape[-1] == 4 else None
    if packing is None:
        base, c = _find(channels, candidates)
        masked = alpha is not None and base != "ag" and _is_mask(alpha)
    else:
        base, masked = packing.removesuffix("a"), packing.endswith("a")
        c = candidates[0] if base == "xyz" else candidates[-1]
    needed = max(4 if masked or base == "ag" else 0, 2 if base == "rg" else 3)
    if channels.shape[-1] < needed:
        raise ValueError(f"packing: {packing!r} needs {needed} channels, the file has {channels.shape[-1]}")
    mask = alpha > 0.5 if masked and alpha is not None else None
    return Unpacked(_clean(base, _DECODE[base](c)), mask, base + "a" * masked)


def unpack_rgb(codes: Array) -> tuple[Array, Array]:
    """Normals (N, 3, H, W) in float32 of pictures (N, H, W, 3) read as `rgb`; for which (N,) `unpack` does so for sure.

    It does where of more than half of the foreground the length is within `_TIE` of 1 and no angle is grazing, and blue
    follows z: a median within a bound is known by counting.
    """
    planes = np.ascontiguousarray(np.moveaxis(codes, -1, 0))
    n = planes.astype(np.float64)
    n /= np.iinfo(codes.dtype).max
    n *= 2
    n -= 1
    x, y, z = n * n
    flat, square = x + y, x + y + z
    length = np.sqrt(square)
    largest, least = planes.max(0), planes.min(0)
    foreground = (largest > 0) & (largest - least >= _GRAY * np.iinfo(codes.dtype).max)
    usual = (np.abs(length - 1) <= _TIE) & (z >= 0.101**2) & (np.maximum(x, y) <= 0.949**2)
    sure = [_follows(n[2, k], flat[k], part, usual[k]) for k, part in enumerate(foreground)]
    low, high = _LENGTHS["rgb"]
    if not ((length > low) & (length < high)).all():
        n = np.where((length > low) & (length < high), n, 0)
    n /= np.maximum(length, 0.1)
    return np.moveaxis(n, 0, 1).astype(np.float32), np.array(sure)


def _follows(blue: Array, flat: Array, chosen: Array, usual: Array) -> bool:
    """Whether more than half of the chosen pixels are usual, and blue surely follows z; flat is x^2 + y^2."""
    defined = chosen & (flat <= 1.1)
    root, blue = np.sqrt(np.clip(1 - flat[defined], 0, None)), blue[defined]
    root -= root.mean() if root.size else 0
    follows = abs(float(np.dot(blue, root))) >= (_IDLE + 0.1) * float(np.dot(root, root))
    enough = np.count_nonzero(chosen & usual) > 0.5 * np.count_nonzero(chosen)
    return bool(enough and follows and blue.size <= 1_000_000)


def _scaled(channels: Array) -> list[Array]:
    """The channels as floats; for floats as they are (first) and in [0, 1] (last) if they have a larger scale."""
    if channels.dtype.kind == "u":
        return [channels.astype(np.float64) / np.iinfo(channels.dtype).max]
    largest = float(np.max(channels, where=np.isfinite(channels), initial=0))
    scale = next((top for top in (1, 255, 65535) if largest <= 1.5 * top or top == 65535), 1)
    return [channels] if scale == 1 else [channels, channels / channels.dtype.type(scale)]


def _root(x: Array, y: Array) -> Array:
    """(x, y, z) of length 1; NaN where x and y are too long for that by more than noise."""
    square = x * x + y * y
    z = np.where(square <= 1.1, np.sqrt(np.clip(1 - square, 0, None)), np.nan)
    return np.stack([x, y, z], -1)


_DECODE: dict[str, Callable[[Array], Array]] = {
    "rgb": lambda c: 2 * c[..., :3] - 1,
    "xyz": lambda c: c[..., :3],
    "rgz": lambda c: np.concatenate([2 * c[..., :2] - 1, c[..., 2:3]], -1),
    "rg": lambda c: _root(2 * c[..., 0] - 1, 2 * c[..., 1] - 1),
    "ag": lambda c: _root(2 * c[..., 3] - 1, 2 * c[..., 1] - 1),
}
_LENGTHS = {"rgb": (0.1, 1.5), "rgz": (0.6, 1.3), "rg": (0.0, 1.1), "ag": (0.0, 1.1)}  # outside is background


def _clean(base: str, n: Array) -> Array:
    """Unit normals, zero where the length is that of a background. Components with signs stay as they are."""
    if base == "xyz":
        return n
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    low, high = _LENGTHS[base]
    return np.where((length > low) & (length < high), n / np.maximum(length, 0.1), 0).astype(n.dtype)


def _is_mask(alpha: Array) -> bool:
    """Nearly all 0 or 1, edges aside: heights and components take the values between."""
    between = (alpha > 0.02) & (alpha < 0.98)
    return bool(between.mean() < 0.25)


def _foreground(channels: Array, c: Array) -> Array:
    """Pixels (P, C) of a picture that are not black, gray, white or undefined; all defined ones if there are none."""
    flat, scaled = (np.ascontiguousarray(x.reshape(-1, x.shape[-1]).T) for x in (channels, c))  # quick by component
    defined = np.isfinite(flat).all(0) & (flat != 0).any(0)
    colours = scaled[:3]
    if len(colours) == 3:
        background = colours.max(0) - colours.min(0) < _GRAY
    else:
        background = (colours < _GRAY).all(0) | (colours > 1 - _GRAY).all(0)
    chosen = defined & ~background
    if len(scaled) == 4 and _is_mask(scaled[3]):
        chosen = chosen & (scaled[3] > 0.5) if (chosen & (scaled[3] > 0.5)).any() else chosen
    return chosen if chosen.any() else defined


def _find(channels: Array, candidates: list[Array]) -> tuple[str, Array]:
    """The packing and the scaled channels that it is to be read from."""
    chosen = _foreground(channels, candidates[-1])
    if not chosen.any():
        raise ValueError("no pixel holds a normal")
    some = np.flatnonzero(chosen)
    some = some[:: 1 + len(some) // 1_000_000]
    first, last = (c.reshape(-1, c.shape[-1])[some] for c in (candidates[0], candidates[-1]))
    packed = bool((((last < -0.05) | (last > 1.05))[:, :3].mean()) < 0.05)
    misfit: dict[str, float] = {}
    if channels.shape[-1] > 2:
        idle = _is_idle(_DECODE["rg"](last), last[:, 2])
        if packed and not idle:
            misfit |= {name: _misfit(_DECODE[name](last)) for name in ("rgb", "rgz")}
        if channels.dtype.kind == "f" and not (packed and idle and _is_idle(_root(*first[:, :2].T), first[:, 2])):
            misfit["xyz"] = _misfit(first[:, :3], grazing=not packed)
    best = min(misfit.values(), default=np.inf)
    for name, value in misfit.items():
        if value <= FITS and value <= max(2 * best, best + _TIE):
            return name, candidates[0] if name == "xyz" else candidates[-1]
    if packed:
        for name in ("ag", "rg") if _alpha_is_x(last) else ("rg",):
            n = _DECODE[name](last)
            if np.isfinite(n[:, 2]).mean() > 0.95 and max(_spread(n[:, 0]), _spread(n[:, 1])) > 0.02:
                return name, candidates[-1]
    raise ValueError("the vectors have length 1 in none of the packings rgb, rgz, rg, ag" + _tell(misfit))


def _tell(misfit: dict[str, float]) -> str:
    found = ", ".join(f"{name} by {value:.2g}" for name, value in misfit.items() if np.isfinite(value))
    wish = "say which one it is (--channels, packing=) if it is a normal map all the same"
    return f" ({found} off); {wish}" if found else f"; {wish}"


def _misfit(n: Array, grazing: bool = False) -> float:
    """Median distance of the lengths from 1; infinite where most vectors are at grazing angle, unless they may be."""
    n = np.ascontiguousarray(n.T, np.float64)  # components one by one: medians of strided numbers cost twice as much
    x, y, z = np.median(np.abs(n), axis=1)
    if (z < 0.1 or max(x, y) > 0.95) and not grazing:
        return float("inf")
    return float(np.median(np.abs(np.linalg.norm(n, axis=0) - 1)))


def _spread(values: Array) -> float:
    low, high = np.quantile(values.astype(np.float64), (0.05, 0.95))
    return float(high - low)


def _is_idle(n: Array, blue: Array) -> bool:
    """Blue says nothing of z: it does not follow sqrt(1 - x^2 - y^2) where that varies (slope 0, not 1 or 1/2)."""
    z, blue = n[:, 2].astype(np.float64), blue.astype(np.float64)
    defined = np.isfinite(z)
    if defined.mean() < 0.95 or _spread(z[defined]) < 0.04:
        return False
    z, blue = z[defined], blue[defined]
    z = z - z.mean()
    return bool(abs(2 * (blue * z).sum()) < _IDLE * (z * z).sum())


def _alpha_is_x(c: Array) -> bool:
    """Red is constant and alpha varies, so that x must be in alpha."""
    return c.shape[-1] == 4 and _spread(c[:, 0]) < 0.25 * _spread(c[:, 3])
