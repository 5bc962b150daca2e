"""`torchdls integrate`: from a file to a surface."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdls._conventions import AUTO, GRADIENT_CONVENTIONS, NORMAL_CONVENTIONS
from torchdls._registry import INTEGRATORS
from torchdls.cli.methods import build_method, check_method, run_method
from torchdls.cli.pictures import OUTPUTS, Shown, check_outputs, is_picture, maps_of, write_picture

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.batch import Manner, Map, Source


METHOD = "slope_dls"


def add_integrate(commands: Any) -> None:
    """Add the command `integrate`."""
    command = commands.add_parser(
        "integrate",
        help="a normal map or a gradient to a surface",
        description="Integrate a normal map (a picture or an array) or a gradient (NPZ, NPY, MAT, TIFF) to a surface.",
    )
    add = command.add_argument
    add("input", metavar="INPUT", help="normal map: PNG, JPEG, TIFF, EXR, BMP, TGA or WebP; arrays: NPY, or NPZ or MAT "
        "with `gradient` or `normals` and optionally `mask`, `weight`, `pixel_size`; or a folder with normal_map.png "
        "and optionally mask.png and K.txt")  # fmt: skip
    add("-o", "--out", action="append", required=True, metavar="OUT", help=OUTPUTS)
    add("--method", default=METHOD, help=f"{', '.join(INTEGRATORS)} (default: {METHOD})")
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="option of the method, such as lam=0.5")
    add("--mask", metavar="FILE", help="image or array; white or nonzero is valid")
    add(
        "--known",
        metavar="DEPTH",
        help="heights, or depths under a camera, that are known: a number (the median), a file "
        "(0 or NaN where unknown), or COLUMN,ROW,DEPTH of one pixel",
    )
    add("--coarse", metavar="FILE", help="a depth of any scale and offset, as a network guesses it, that places what "
        "nothing else ties; NaN, or depth 0, where unknown")  # fmt: skip
    add_manner(command)
    add("--tile", type=int, metavar="N", help="least_squares (also with --mask), slope_dls or dls of an NPY, Zarr or "
        "TIFF of floats, larger than memory if need be, by N rows (dls: tiles), to NPY, Zarr or BigTIFF")  # fmt: skip
    add("--unit", metavar="NAME", help="unit of the heights, for the labels of pictures, such as mm")
    add("--force", action="store_true", help="replace output files that exist")
    add("--quiet", action="store_true", help="no progress bar and no report")
    command.set_defaults(run=_integrate)


def add_manner(command: argparse.ArgumentParser) -> None:
    """Add the options that say how a map is read."""
    add = command.add_argument
    add("--channels", metavar="PACKING", help="how the normals are packed, if it is not found right: rgb, rgz, rg, ag "
        "(x in alpha) or xyz (signed); with an a at the end, as in rgba, alpha is the mask")  # fmt: skip
    add("--convention", help=f"normals: {', '.join(NORMAL_CONVENTIONS)}, or {AUTO} (the most integrable); "
        f"gradients: {', '.join(GRADIENT_CONVENTIONS)}; by default the first of each")  # fmt: skip
    add("--pixel-size", type=float, nargs="+", metavar="D", help="spacing of the pixels, or of columns and rows")
    add("--camera", metavar="K", help="intrinsics, 3 x 3 in NPY, NPZ or text, or FX,FY,CX,CY in pixels: undo the "
        "perspective; files then hold the depth, with geometric mean 1, and meshes points; none: no K.txt")  # fmt: skip
    add("--float64", action="store_true", help="compute in double precision")


def manner(arguments: argparse.Namespace) -> Manner:
    """What those options say."""
    from torchdls.batch import Manner

    camera = None if arguments.camera in (None, "none") else _camera(arguments.camera)
    if camera is not None and arguments.pixel_size is not None:
        raise ValueError("--pixel-size: given beside --camera, whose intrinsics already hold the pixel size")
    return Manner(
        arguments.channels,
        arguments.convention,
        _pixel_size(arguments.pixel_size),
        camera,
        own_camera=arguments.camera != "none",
        double=arguments.float64,
    )


def _integrate(arguments: argparse.Namespace) -> None:
    import torch

    from torchdls.batch import read_map, write_map
    from torchdls.io.packing import describe
    from torchdls.reconstruction import solve_with

    if arguments.tile is not None:
        return _integrate_large(arguments)
    check_method(arguments.method, arguments.set)  # what would fail after the work shall fail before it
    check_outputs(arguments.out, arguments.force)
    source = _source(arguments)
    found = read_map(source, manner(arguments))
    method = build_method(arguments.method, found.pixel_size, arguments.set, camera=found.camera)
    start = time.perf_counter()
    with torch.no_grad():
        fields = {"mask": found.mask, "weight": found.weight}
        beside = _beside(arguments, found.gradient, found.camera is not None)
        if beside:
            result = solve_with(method, found.gradient, **fields, **beside, log_depth=found.camera is not None)
        else:
            result = run_method(arguments.method, method, arguments.quiet, found.gradient, **fields)
    seconds = time.perf_counter() - start
    for note in found.notes:  # now that the method has taken its input: an error is one line alone
        if not arguments.quiet or "warning" in note:
            print(note, file=sys.stderr)
    height, noise, maps = result.height, result._asdict().get("noise"), maps_of(result, found.mask, found.weight)
    for path in arguments.out:
        if is_picture(path):
            _write_picture(path, height, found, maps, arguments)
        else:
            write_map(path, height, found, overwrite=arguments.force, **{name: maps[name][0] for name in maps})
    if not arguments.quiet:
        if found.kind == "normals":
            print(f"{source.path}: read as {describe(found.packing)}, convention {found.convention}")
        h, w = height.shape[-2:]
        pixels = f"{int(found.mask.sum())} of {h * w} pixels" if found.mask is not None else f"{h} x {w} pixels"
        level = "" if noise is None else f", noise {float(noise):.3g} in the slopes,"
        print(f"{arguments.method}: {pixels}{level} in {seconds:.2f} s -> {', '.join(arguments.out)}")


def _write_picture(path: str, height: Tensor, found: Map, maps: dict[str, Any], arguments: Any) -> None:
    from torchdls.geometry import log_depth_to_depth

    surface = height if found.camera is None else log_depth_to_depth(height)
    shown = Shown(surface, found.mask, found.pixel_size, found.gradient, camera=found.camera, **maps)
    title = f"{Path(arguments.input).name}, {arguments.method}"
    write_picture(path, shown, title=title, unit=arguments.unit, overwrite=arguments.force)


def _beside(arguments: argparse.Namespace, gradient: Tensor, deep: bool) -> dict[str, Any]:
    """What is known of the heights, as `solve_with` takes it."""
    known, coarse = arguments.known, arguments.coarse
    return ({} if known is None else {"known": _known(known, gradient, deep)}) | (
        {} if coarse is None else {"coarse": _depths("--coarse", coarse, gradient, deep)}
    )


def _known(text: str, gradient: Tensor, deep: bool) -> Tensor | float:
    """A number, a depth at one pixel, or a file of depths."""
    import torch

    if Path(text).exists():
        return _depths("--known", text, gradient, deep)
    try:
        parts = [float(part) for part in text.split(",")]
    except ValueError:
        parts = []
    if len(parts) == 1:
        return parts[0]
    h, w = gradient.shape[-2:]
    if len(parts) != 3 or not (parts[0] in range(w) and parts[1] in range(h)):
        raise ValueError(f"--known: {text!r} given, a file, a number or COLUMN,ROW,DEPTH within {w} x {h} is needed")
    spot = torch.full_like(gradient[:, :1], torch.nan)
    spot[..., int(parts[1]), int(parts[0])] = parts[2]
    return spot


def _depths(option: str, path: str, gradient: Tensor, deep: bool) -> Tensor:
    """(1, 1, H, W) of a file, NaN where unknown."""
    import torch

    from torchdls import io

    depth = io.load_height(path).height.to(gradient)
    if depth.shape != gradient[:, :1].shape:
        sizes = f"{tuple(depth.shape[-2:])} given beside an input of {tuple(gradient.shape[-2:])}"
        raise ValueError(f"{option}: {path} of size {sizes}, the sizes must agree")
    return torch.where(depth.isfinite() & ((depth != 0) | (not deep)), depth, torch.nan)


def _integrate_large(arguments: argparse.Namespace) -> None:
    """Least squares out of core, or SlopeDLS or DLS by tiles."""
    from torchdls import large

    if arguments.method not in ("least_squares", "slope_dls", "dls"):
        raise ValueError("--tile: least_squares, slope_dls and dls alone are done in tiles")
    for name in ("camera", "channels"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--tile: gradients and normals of floats alone are done in tiles, --{name} is given")
    if arguments.float64 or len(arguments.out) > 1:
        raise ValueError("--tile: in the precision of the input and to one output; --float64 or several -o are given")
    start, size = time.perf_counter(), _pixel_size(arguments.pixel_size) or (1.0, 1.0)
    result = large.integrate(
        arguments.input,
        arguments.out[0],
        mask=arguments.mask,
        integrator=build_method(arguments.method, size, arguments.set),
        convention=arguments.convention,
        tile=arguments.tile,
        overwrite=arguments.force,
    )
    if not arguments.quiet:
        (h, w), seconds = result.shape, time.perf_counter() - start
        level = (
            ""
            if result.noise is None
            else f", noise {result.noise:.3g} in the slopes, {result.tiles[0]} x {result.tiles[1]} tiles,"
        )
        print(f"{arguments.method}: {h} x {w} pixels{level} in {seconds:.2f} s -> {arguments.out[0]}")


def _source(arguments: argparse.Namespace) -> Source:
    """The input, and the mask and camera that lie beside it in a folder; those of the options take their place."""
    from torchdls.batch import Source, folder_source

    place = Path(arguments.input)
    if not place.is_dir():
        if not place.suffix and not place.exists():
            raise ValueError(f"{place}: no such file or folder")
        return Source(arguments.input, arguments.mask)
    source = folder_source(arguments.input)
    if source is None:
        raise ValueError(
            f"{place}: a folder without normal_map.png; of maps: torchdls batch, of photographs: torchdls photometric"
        )
    for part in (source.mask if arguments.mask is None else None, source.camera if arguments.camera is None else None):
        if part is not None and not arguments.quiet:
            print(f"{part}: taken from the folder")
    return source if arguments.mask is None else source._replace(mask=arguments.mask)


def _pixel_size(asked: Sequence[float] | None) -> tuple[float, float] | None:
    from torchdls.operators import as_pixel_size

    if asked is None:
        return None
    if len(asked) > 2:
        raise ValueError(f"--pixel-size: {len(asked)} numbers given, one or two are needed")
    return as_pixel_size(asked[0] if len(asked) == 1 else tuple(asked))


def _camera(text: str) -> Tensor:
    import torch

    from torchdls import io

    parts = text.split(",")
    if len(parts) == 1 or Path(text).exists():
        return io.load_camera(text)
    try:
        fx, fy, cx, cy = map(float, parts)
    except ValueError:
        raise ValueError(f"--camera: {text!r} given, a file or four numbers FX,FY,CX,CY are needed") from None
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
