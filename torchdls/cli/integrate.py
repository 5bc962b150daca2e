"""`torchdls integrate`: from a file to a surface."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdls._conventions import GRADIENT_CONVENTIONS, NORMAL_CONVENTIONS
from torchdls._registry import INTEGRATORS
from torchdls.cli.methods import build_method, check_method, run_method
from torchdls.cli.reading import AUTO, Reading, read_normals

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.io import Field


_METHOD = "slope_dls"


def add_integrate(commands: Any) -> None:
    """Add the command `integrate`."""
    command = commands.add_parser(
        "integrate",
        help="a normal map or a gradient to a surface",
        description="Integrate a normal map (a picture or an array) or a gradient (NPZ, NPY, MAT, TIFF) to a surface.",
    )
    add = command.add_argument
    add("input", metavar="INPUT", help="normal map: PNG, JPEG, TIFF, EXR, BMP, TGA or WebP; arrays: NPY, or NPZ or MAT "
        "with `gradient` or `normals` and optionally `mask`, `weight`, `pixel_size`")  # fmt: skip
    add("-o", "--out", action="append", required=True, metavar="OUT",
        help="NPZ, NPY, TIFF (32-bit), PNG (16-bit), PLY, OBJ, STL or GLB; may be repeated")  # fmt: skip
    add("--method", default=_METHOD, help=f"{', '.join(INTEGRATORS)} (default: {_METHOD})")
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="option of the method, such as lam=0.5")
    add("--mask", metavar="FILE", help="image or array; white or nonzero is valid")
    add("--channels", metavar="PACKING", help="how the normals are packed, if it is not found right: rgb, rgz, rg, ag "
        "(x in alpha) or xyz (signed); with an a at the end, as in rgba, alpha is the mask")  # fmt: skip
    add("--convention", help=f"normals: {', '.join(NORMAL_CONVENTIONS)}, or {AUTO} (the most integrable); "
        f"gradients: {', '.join(GRADIENT_CONVENTIONS)}; by default the first of each")  # fmt: skip
    add("--pixel-size", type=float, nargs="+", metavar="D", help="spacing of the pixels, or of columns and rows")
    add("--camera", metavar="K", help="intrinsics, 3 x 3 in NPY, NPZ or text, or FX,FY,CX,CY in pixels: undo the "
        "perspective; files then hold the depth, with geometric mean 1, and meshes the points")  # fmt: skip
    add("--float64", action="store_true", help="compute in double precision")
    add("--force", action="store_true", help="replace output files that exist")
    add("--quiet", action="store_true", help="no progress bar and no report")
    command.set_defaults(run=_integrate)


def _integrate(arguments: argparse.Namespace) -> None:
    import torch

    from torchdls import io
    from torchdls._files import check_output
    from torchdls.io.packing import describe

    check_method(arguments.method, arguments.set)  # what would fail after the work shall fail before it
    for path in arguments.out:
        check_output(path, arguments.force, suffixes=io.OUTPUT_SUFFIXES)
    camera = None if arguments.camera is None else _camera(arguments.camera)
    field = io.load_field(arguments.input, packing=arguments.channels)
    if field.values.shape[0] != 1:
        raise ValueError(f"{arguments.input}: holds {field.values.shape[0]} surfaces, one is needed")
    pixel_size = _pixel_size(arguments.pixel_size, field.pixel_size, camera)
    dtype = torch.float64 if arguments.float64 else field.values.dtype
    field = field._replace(values=field.values.to(dtype), mask=_joint_mask(arguments, field))
    reading = _gradient(arguments, field, camera)
    gradient, mask = reading.gradient, None if reading.mask.all() else reading.mask
    method = build_method(arguments.method, pixel_size, arguments.set)
    weight = None if field.weight is None else field.weight.to(dtype)
    start = time.perf_counter()
    with torch.no_grad():
        height, noise = run_method(arguments.method, method, arguments.quiet, gradient, mask=mask, weight=weight)
    seconds = time.perf_counter() - start
    for note in reading.notes:  # now that the method has taken its input: an error is one line alone
        if not arguments.quiet or "warning" in note:
            print(note, file=sys.stderr)
    for path in arguments.out:
        _save(path, height, mask, gradient, pixel_size, camera, arguments.force)
    if not arguments.quiet:
        if field.kind == "normals":
            print(f"{arguments.input}: read as {describe(field.packing)}, convention {reading.convention}")
        h, w = height.shape[-2:]
        pixels = f"{int(mask.sum())} of {h * w} pixels" if mask is not None else f"{h} x {w} pixels"
        level = "" if noise is None else f", noise {float(noise):.3g} in the slopes,"
        print(f"{arguments.method}: {pixels}{level} in {seconds:.2f} s -> {', '.join(arguments.out)}")


def _pixel_size(
    asked: Sequence[float] | None, stored: tuple[float, float] | None, camera: Tensor | None
) -> tuple[float, float]:
    from torchdls.operators import as_pixel_size

    if asked is None:
        return (1.0, 1.0) if stored is None or camera is not None else stored
    if camera is not None:
        raise ValueError("--pixel-size: given beside --camera, whose intrinsics already hold the pixel size")
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


def _joint_mask(arguments: argparse.Namespace, field: Field) -> Tensor | None:
    """The mask of the input and that of --mask together."""
    from torchdls import io

    if arguments.mask is None:
        return field.mask
    mask = io.load_mask(arguments.mask)
    if mask.shape[-2:] != field.values.shape[-2:]:
        sizes = f"{tuple(mask.shape[-2:])} given beside an input of {tuple(field.values.shape[-2:])}"
        raise ValueError(f"{arguments.mask}: mask of size {sizes}, the sizes must agree")
    return mask if field.mask is None else mask & field.mask


def _gradient(arguments: argparse.Namespace, field: Field, camera: Tensor | None) -> Reading:
    """Gradient in the library's convention, and the mask of its valid pixels."""
    from torchdls.geometry import convert_gradient

    if field.kind == "normals":
        return read_normals(arguments.input, field, arguments.convention, camera)
    convention = arguments.convention or next(iter(GRADIENT_CONVENTIONS))
    if convention not in GRADIENT_CONVENTIONS:
        known = ", ".join(GRADIENT_CONVENTIONS)
        raise ValueError(f"--convention: {convention!r} is not for gradient; choose from {known}")
    if camera is not None:
        raise ValueError("--camera: needs a normal map, but the input is a gradient")
    gradient = convert_gradient(field.values, convention)
    finite = gradient.isfinite().all(1, keepdim=True)
    mask = finite if field.mask is None else finite & field.mask
    if not mask.any():
        raise ValueError(f"{arguments.input}: no finite slope inside the mask")
    return Reading(gradient, mask, convention, ())


def _save(
    path: str,
    height: Tensor,
    mask: Tensor | None,
    gradient: Tensor,
    pixel_size: tuple[float, float],
    camera: Tensor | None,
    force: bool,
) -> None:
    from torchdls import io
    from torchdls.geometry import depth_to_points, log_depth_to_depth

    if camera is None:
        io.save_height(path, height, mask=mask, pixel_size=pixel_size, overwrite=force, gradient=gradient[0])
        return
    depth = log_depth_to_depth(height)
    points = depth_to_points(depth, camera)
    io.save_height(path, depth, mask=mask, points=points, quantity="depth", overwrite=force, camera=camera)
