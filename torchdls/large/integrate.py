"""`torchdls.large.integrate`: least squares, and SlopeDLS by tiles, from file to file."""

from __future__ import annotations

import math
import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchdls.integrators import DLS, Integrator, LeastSquares, SlopeDLS
from torchdls.large.dls import Run, check_dls
from torchdls.large.files import Field, checked_output, parts, write
from torchdls.large.least_squares import least_squares
from torchdls.large.slope_dls import HALO, noise_of, slope_dls, spans
from torchdls.large.system import System
from torchdls.large.transform import Passes, rows_at_once
from torchdls.operators import as_pixel_size
from torchdls.solvers import ConvergenceWarning

# Bytes that a pixel of a window takes while it is smoothed, for float32 (measured: 1,100).
_WINDOW = 1200


class LargeResult(NamedTuple):
    """What `integrate` did.

    Attributes:
        shape: (H, W).
        tile: rows of a band, and columns of a strip; of SlopeDLS and DLS the side of a tile.
        passes: the bands, strips and bands of the (last) solve.
        tiles: rows and columns of tiles; (0, 0) for least squares, which needs none.
        noise: standard deviation of one gradient sample, as SlopeDLS or DLS took it; None where none is asked for.
        iterations: of conjugate gradients with a mask, weights or anchors, or of DLS; else 0.
        converged: whether they met the tolerance within the limit of the integrator.
    """

    shape: tuple[int, int]
    tile: int
    passes: tuple[int, int, int]
    tiles: tuple[int, int] = (0, 0)
    noise: float | None = None
    iterations: int = 0
    converged: bool = True


def integrate(
    source: str | os.PathLike[str] | Any,
    out: str | os.PathLike[str] | Any,
    *,
    mask: str | os.PathLike[str] | Any = None,
    weight: str | os.PathLike[str] | Any = None,
    anchor: str | os.PathLike[str] | Any = None,
    anchor_weight: str | os.PathLike[str] | Any = None,
    integrator: Integrator | None = None,
    convention: str | None = None,
    pixel_size: float | Sequence[float] | None = None,
    tile: int | None = None,
    halo: int = HALO,
    memory: int = 2**30,
    scratch: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> LargeResult:
    r"""The height of a field that need not fit into memory, by `LeastSquares`, `SlopeDLS` or `DLS`.

    Least squares is exact: equal to that of the whole to rounding, in three passes over a file. SlopeDLS smooths tiles
    with a halo, with the noise level of the whole, and blends the slopes of what it changed,

        z = argmin ||A z - v - sum_t p_t A (z_t - z_ls,t)||^2,      sum_t p_t = 1

    by one exact solve; slow waves, and how far least squares is left, are then judged by the whole. One tile is
    SlopeDLS itself; more differ by some percent of its error (docs/scale.md).

    DLS goes patch by patch and is that of the whole to rounding, with the learner `SoupDIL(order="block")` or "fixed",
    whose sweep needs two sums over all patches alone; its height step goes by conjugate gradients whose vectors are
    files. With mu="auto" the threshold is the median of the noise levels of the tiles.

    With a mask, weights or anchors, least squares goes by conjugate gradients whose vectors are files, preconditioned
    by that of the full rectangle; they stop at the integrator's `tol`.

    Besides the files it takes `scratch` space of one height (SlopeDLS: two; with a mask: four, and eight bytes for each
    pixel; with weights or anchors three more; DLS: nine, and its codes that are not 0), and `memory` for its own
    arrays; time grows as H W log(H W).

    Args:
        source: gradient (2, H, W) or normals (3, H, W) of floats: an NPY file, a Zarr array, an uncompressed TIFF, or
            anything with `shape` that gives arrays for slices.
        out: NPY, Zarr or a tiled BigTIFF, written whole or not at all (Zarr: a new array), or anything of shape (H, W)
            that takes arrays for slices of rows.
        mask: (H, W) in a file or an array, not 0 where the slopes are valid; the rest is never read. With least squares
            alone. None for a full rectangle.
        weight: (H, W), (1, H, W) or (2, H, W) likewise, at least 0: trust in the slopes, for least squares alone.
        anchor: (H, W) likewise, known heights, read only where `anchor_weight` > 0; for least squares alone.
        anchor_weight: (H, W) likewise, or one number, at least 0: trust in the anchors.
        integrator: `LeastSquares()`, which None stands for; `SlopeDLS(...)` with the recipe "blend" or "quick",
            without `robust`, with one noise level or None, and with the guard "discrepancy" or None; or `DLS(...)` with
            a learner as above, least squares as its data term, the exact height step and `select=False`.
        convention: of the gradient (default: image) or of the normals (default: opengl).
        pixel_size: (dx, dy) or one number; None for that of the integrator.
        tile: rows of a band and columns of a strip, or the side of a tile of SlopeDLS and DLS; None for as many as
            `memory` holds.
        halo: pixels that a tile sees beyond itself on every side.
        memory: bytes for arrays of its own; pages of files in the system's cache are not counted.
        scratch: folder for the files in between; None for that of `out`, or the usual one for temporary files.
        overwrite: replace an existing file.
        progress: told of each pass.

    Returns:
        `LargeResult`.

    Raises:
        TypeError: the entries are no floats, or the integrator is of another class.
        ValueError: the shape, format, convention or an option is not usable, a value is not finite, or a normal faces
            away.
        OSError: a file cannot be opened or written. ImportError: the library for a format is not installed.

    Source: Simchony, Chellappa, Shao (1990) for the solve.

    Example:
        >>> import numpy
        >>> slopes, height = torchdls.SURFACES["peaks"](96).gradient[0], numpy.empty((96, 96), "float32")
        >>> torchdls.large.integrate(slopes.numpy().astype("float32"), height, tile=32).passes
        (3, 3, 3)
        >>> bool(torch.allclose(torch.from_numpy(height), torchdls.LeastSquares()(slopes.float())[0], atol=1e-4))
        True
    """
    method = LeastSquares() if integrator is None else integrator
    given = {"mask": mask, "weight": weight, "anchor": anchor, "anchor_weight": anchor_weight}
    _check(method, tile, halo, [name for name, part in given.items() if part is not None])
    field = Field.open(source, convention, **given)
    size, smooths = field.shape, isinstance(method, SlopeDLS | DLS)
    held = (
        rows_at_once(memory, size, field.dtype, 3 if weight is not None else 1 if field.bare and not smooths else 2)
        if tile is None or smooths
        else tile
    )
    step = method.pixel_size if pixel_size is None else as_pixel_size(pixel_size)
    beside = checked_output(out, size, overwrite)
    tile = (_tile(memory, halo, field.dtype) if smooths else held) if tile is None else tile
    bands, strips = (len(list(parts(n, held))) for n in size)
    result = LargeResult(size, tile, (bands, strips, bands))
    with tempfile.TemporaryDirectory(prefix=".torchdls-", dir=scratch or beside) as place, torch.no_grad():
        passes = Passes(field, step, held, Path(place), progress)
        if isinstance(method, SlopeDLS):
            windows = spans(size[0], tile, halo), spans(size[1], tile, halo)
            level = noise_of(passes, method.sigma, windows)
            heights = slope_dls(passes, method, windows, level)
            result = result._replace(tiles=(len(windows[0]), len(windows[1])), noise=float(level))
        elif isinstance(method, DLS):
            windows = spans(size[0], tile, halo), spans(size[1], tile, halo)
            automatic = isinstance(method.mu, str)
            noise = float(noise_of(passes, None, windows)) if automatic else None
            run = Run(passes, method, tile, noise or 0.0)
            done = run.follow()
            result = result._replace(tiles=(len(windows[0]), len(windows[1])), noise=noise, iterations=done.iterations)
            result, heights = result._replace(converged=done.converged), run.heights()
        elif isinstance(method, LeastSquares) and not field.bare:
            system = System(passes)
            converged = system.solve(method.tol, method.max_iter)
            result = result._replace(iterations=system.iterations, converged=converged)
            heights = system.heights()
        else:
            heights = least_squares(passes)
        write(out, heights, size, field.dtype, overwrite)
    if not result.converged and isinstance(method, LeastSquares):
        warnings.warn(
            f"large.integrate: stopped after {result.iterations} iterations at a relative residual of "
            f"{system.residual:.1e}, where tol={method.tol:.1e} is asked for",
            ConvergenceWarning,
            stacklevel=2,
        )
    return result


def _tile(memory: int, halo: int, dtype: Any) -> int:
    """Side of the largest tile whose window `memory` holds."""
    side = math.isqrt(memory * 4 // (_WINDOW * np.dtype(dtype).itemsize)) - 2 * halo
    if side < 1:
        raise ValueError(f"large.integrate: memory={memory} holds no tile with a halo of {halo} pixels")
    return side // 128 * 128 or side


def _check(method: Integrator, tile: int | None, halo: int, beside: Sequence[str]) -> None:
    if type(method) is LeastSquares:
        usable = method.boundary == "neumann"
    elif type(method) is DLS:
        check_dls(method)
        usable = True
    elif type(method) is SlopeDLS:
        single = method.sigma is None or torch.as_tensor(method.sigma).numel() == 1
        usable = method.recipe != "plain" and not method.robust and method.guard != "sure" and single
    else:
        raise TypeError(f"large.integrate: integrator={method!r} given, LeastSquares, SlopeDLS or DLS is needed")
    if beside and type(method) is not LeastSquares:
        raise ValueError(f"large.integrate: {beside[0]} is given, which least squares alone takes")
    if not usable:
        raise ValueError(f"large.integrate: {method!r} is not done in tiles, with these options")
    if tile is not None and not tile > 0:
        raise ValueError(f"large.integrate: tile={tile!r} given, a positive number of pixels is needed")
    if not halo >= 0:
        raise ValueError(f"large.integrate: halo={halo!r} given, at least 0 pixels are needed")
