"""The command line: `torchdls demo`, `torchdls integrate`, `torchdls methods`.

PyTorch is imported when a command runs, so `torchdls --help` answers at once. Whatever is wrong with a file or an
argument is one line on standard error and exit status 2; output files are written whole or not at all.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import os
import sys
import textwrap
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdls import __version__
from torchdls._registry import INTEGRATORS

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.integrators import Integrator
    from torchdls.io import Field

_METHOD = "slope_dls"
_EXAMPLES = """\
examples:
  torchdls demo --out demo
  torchdls integrate normals.png --convention directx --mask mask.png -o surface.ply -o height.tiff
  torchdls integrate gradient.npz --method least_squares -o height.npz
  torchdls integrate normals.png --convention opencv --camera K.txt -o depth.tiff
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 2 for bad input, 130 when interrupted."""
    arguments = _parser().parse_args(argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            arguments.run(arguments)
    except (ValueError, TypeError, OSError, ImportError) as error:
        return _complain(error)
    except KeyboardInterrupt:
        print("torchdls: interrupted", file=sys.stderr)
        return 130
    return 0


def _warn(message: Warning | str, *where: object, **more: object) -> None:
    """A warning of the library as one line, without the place in the code."""
    print(f"torchdls: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _complain(error: Exception) -> int:
    if isinstance(error, BrokenPipeError):  # the reader of our output went away, as in `torchdls methods | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{error.filename}: {error.strerror}"
    else:
        message = " ".join(str(error).split()) or type(error).__name__
    print(f"torchdls: error: {message}", file=sys.stderr)
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchdls",
        description="Surfaces from noisy gradients and normal maps, by dictionary learning (DLS) and its peers.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"torchdls {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_integrate(commands)
    _add_demo(commands)
    methods = commands.add_parser("methods", help="list the methods", description="List the methods and their options.")
    methods.set_defaults(run=_methods)
    return parser


def _add_integrate(commands: Any) -> None:
    command = commands.add_parser(
        "integrate",
        help="a normal map or a gradient to a surface",
        description="Integrate a normal map (PNG, JPEG, TIFF, NPY, NPZ) or a gradient (NPZ, NPY, TIFF) to a surface.",
    )
    add = command.add_argument
    add("input", metavar="INPUT", help="normal map: 8/16-bit PNG, JPEG or TIFF; arrays: NPY, or NPZ with `gradient` or "
        "`normals` and optionally `mask`, `weight`, `pixel_size`")  # fmt: skip
    add("-o", "--out", action="append", required=True, metavar="OUT",
        help="NPZ, NPY, TIFF (32-bit), PNG (16-bit), PLY, OBJ, STL or GLB; may be repeated")  # fmt: skip
    add("--method", default=_METHOD, help=f"{', '.join(INTEGRATORS)} (default: {_METHOD})")
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="option of the method, such as lam=0.5")
    add("--mask", metavar="FILE", help="image or array; white or nonzero is valid")
    add("--convention", help="normals: opengl (default), directx, opencv, kornia, matlab; "
        "gradients: image (default: right, down), cartesian (right, up), depth, matlab (down, right)")  # fmt: skip
    add("--pixel-size", type=float, nargs="+", metavar="D", help="spacing of the pixels, or of columns and rows")
    add("--camera", metavar="K", help="intrinsics, 3 x 3 in NPY, NPZ or text, or FX,FY,CX,CY in pixels: undo the "
        "perspective; files then hold the depth, with geometric mean 1, and meshes the points")  # fmt: skip
    add("--float64", action="store_true", help="compute in double precision")
    add("--force", action="store_true", help="replace output files that exist")
    add("--quiet", action="store_true", help="no progress bar and no report")
    command.set_defaults(run=_integrate)


def _add_demo(commands: Any) -> None:
    command = commands.add_parser(
        "demo",
        help="noisy slopes of the paper's Tent and of real terrain, by least squares, DLS and SlopeDLS",
        description="Integrate the noisy slopes of the paper's Tent (1 dB) and of real terrain (0 dB) by least "
        "squares, DLS and SlopeDLS; print a table, and write pictures, 3-D pages, meshes and arrays.",
    )
    command.add_argument("--out", default="demo", metavar="DIR", help="folder for the results (default: demo)")
    command.add_argument("--size", type=int, metavar="N", help="side of the surfaces in pixels (default: 200 and 320)")
    command.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    command.add_argument("--quiet", action="store_true", help="no progress bar")
    command.set_defaults(run=_demo)


# --- torchdls methods ----------------------------------------------------------------------------------------------


def _methods(arguments: argparse.Namespace) -> None:
    indent = " " * (max(map(len, INTEGRATORS)) + 2)
    for name in INTEGRATORS:
        print(f"{name:<{len(indent)}}{INTEGRATORS.summary(name)}")
        options = ", ".join(f"{option}={default!r}" for option, default in INTEGRATORS.parameters(name).items())
        print(textwrap.fill(options, 110, initial_indent=indent, subsequent_indent=indent))


def _method(name: str, pixel_size: tuple[float, float], settings: Sequence[str] = ()) -> Integrator:
    if name not in INTEGRATORS:
        raise ValueError(f"--method: {name!r} is unknown; choose from {', '.join(INTEGRATORS)}")
    options: dict[str, Any] = {"pixel_size": pixel_size}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or not key.isidentifier():
            raise ValueError(f"--set: {setting!r} given, NAME=VALUE is needed")
        try:
            options[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            options[key] = value  # a plain word such as z_step=proximal
    return INTEGRATORS[name](**options)


@contextmanager
def _bar(label: str, method: Integrator, quiet: bool) -> Iterator[Any]:
    """A callback that moves a progress bar, or None for methods without iterations to show."""
    steps = getattr(method, "n_iter", None)
    if quiet or not steps or not hasattr(method, "solve") or not sys.stderr.isatty():
        yield None
        return
    from torchdls._files import require

    tqdm = require("tqdm", "plots")
    form = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]{postfix}"
    with tqdm.tqdm(total=steps, desc=label, leave=False, bar_format=form) as bar:

        def step(iteration: int, objective: Tensor) -> None:
            bar.set_postfix_str(f"objective {float(objective.sum()):.6g}", refresh=False)
            bar.update(iteration - bar.n)
            if iteration == steps:
                bar.refresh()  # the last step shows, however quick

        yield step


def _run(
    label: str, method: Integrator, quiet: bool, gradient: Tensor, **fields: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """The height, and the noise level if the method found one."""
    solve: Any = getattr(method, "solve", None)
    if solve is None or "callback" not in inspect.signature(solve).parameters:
        return method(gradient, **fields), None
    with _bar(label, method, quiet) as step:
        result = solve(gradient, **fields, callback=step)
    return result.height, getattr(result, "noise", None)


# --- torchdls integrate --------------------------------------------------------------------------------------------


def _integrate(arguments: argparse.Namespace) -> None:
    import torch

    from torchdls import io
    from torchdls._files import check_output

    for path in arguments.out:  # what would fail after the work shall fail before it
        check_output(path, arguments.force, suffixes=io.OUTPUT_SUFFIXES)
    camera = None if arguments.camera is None else _camera(arguments.camera)
    field = io.load_field(arguments.input)
    if field.values.shape[0] != 1:
        raise ValueError(f"{arguments.input}: holds {field.values.shape[0]} surfaces, one is needed")
    pixel_size = _pixel_size(arguments.pixel_size, field.pixel_size, camera)
    dtype = torch.float64 if arguments.float64 else field.values.dtype
    field = field._replace(values=field.values.to(dtype), mask=_joint_mask(arguments, field))
    gradient, mask = _gradient(arguments, field, camera)
    method = _method(arguments.method, pixel_size, arguments.set)
    weight = None if field.weight is None else field.weight.to(dtype)
    start = time.perf_counter()
    with torch.no_grad():
        height, noise = _run(arguments.method, method, arguments.quiet, gradient, mask=mask, weight=weight)
    seconds = time.perf_counter() - start
    for path in arguments.out:
        _save(path, height, mask, gradient, pixel_size, camera, arguments.force)
    if not arguments.quiet:
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
    if len(parts) != 4 or Path(text).exists():
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


def _gradient(arguments: argparse.Namespace, field: Field, camera: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Gradient in the library's convention, and the mask of its valid pixels (None if all are)."""
    from torchdls.geometry import GRADIENT_CONVENTIONS, NORMAL_CONVENTIONS, convert_gradient, normals_to_gradient

    normals = field.kind == "normals"
    known = NORMAL_CONVENTIONS if normals else GRADIENT_CONVENTIONS
    convention = arguments.convention or next(iter(known))
    if convention not in known:
        raise ValueError(f"--convention: {convention!r} is not for {field.kind}; choose from {', '.join(known)}")
    if normals:
        gradient, mask, invalid = normals_to_gradient(field.values, convention, mask=field.mask, camera=camera)
        if invalid.any() and not arguments.quiet:
            print(f"{arguments.input}: {int(invalid)} pixels without a valid normal are left out", file=sys.stderr)
        if not mask.any():
            raise ValueError(f"{arguments.input}: no valid normal under convention {convention!r}")
    else:
        if camera is not None:
            raise ValueError("--camera: needs a normal map, but the input is a gradient")
        gradient = convert_gradient(field.values, convention)
        finite = gradient.isfinite().all(1, keepdim=True)
        mask = finite if field.mask is None else finite & field.mask
        if not mask.any():
            raise ValueError(f"{arguments.input}: no finite slope inside the mask")
    return gradient, None if mask.all() else mask


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


# --- torchdls demo -------------------------------------------------------------------------------------------------


def _demo(arguments: argparse.Namespace) -> None:
    from torchdls._files import require

    for library, extra in (("matplotlib", "plots"), ("plotly", "plots"), ("trimesh", "files")):
        require(library, extra)  # before the work
    from torchdls.surfaces import SURFACES, terrain

    size = () if arguments.size is None else (arguments.size,)
    surfaces = ("Tent", SURFACES["tent"](*size), 1.0), ("Terrain", terrain(*size, smoothing=2.0), 0.0)
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{'surface':<10}{'SNR':>5}  {'method':<14}{'RMSE':>9}{'SSIM':>8}{'angle':>9}{'seconds':>9}")
    for name, surface, snr in surfaces:
        _demo_surface(arguments, folder, name, surface, snr)
    print("RMSE in pixels, without the constant; angle: mean between the normals and the true ones.")
    print(f"Pictures, 3-D pages, meshes and arrays are in {folder}/")


def _demo_surface(arguments: argparse.Namespace, folder: Path, name: str, surface: Any, snr: float) -> None:
    import torch

    from torchdls import io
    from torchdls.plot import describe
    from torchdls.surfaces import add_noise

    noisy = add_noise(surface.gradient, snr, torch.Generator().manual_seed(arguments.seed))
    heights, notes = {}, {}
    for label, method in (("Least squares", "least_squares"), ("DLS", "dls"), ("SlopeDLS", "slope_dls")):
        integrator = _method(method, (1.0, 1.0))
        start = time.perf_counter()
        with torch.no_grad():
            height, _ = _run(f"{name}, {label}", integrator, arguments.quiet, noisy)
        seconds = time.perf_counter() - start
        m = describe(height, surface.height, data_range=surface.data_range, gradient=surface.gradient)
        row = (
            f"{name:<10}{snr:>3.0f}dB  {label:<14}{m['rmse']:>9.4f}{m['ssim']:>8.4f}{m['angle']:>8.2f}°{seconds:>9.2f}"
        )
        print(row, flush=True)
        heights[label] = height
        notes[label] = f"RMSE {m['rmse']:.3f} px, SSIM {m['ssim']:.3f}, angle {m['angle']:.2f}°"
        stem = folder / f"{name.lower()}_{method}"
        extra = {"gradient": noisy[0], "truth": surface.height[0, 0], "snr_db": snr}
        io.save_height(stem.with_suffix(".npz"), height, overwrite=True, **extra)
        io.save_height(stem.with_suffix(".ply"), height, overwrite=True)
    _demo_pictures(folder, name, surface, snr, noisy, heights, notes)


def _demo_pictures(
    folder: Path,
    name: str,
    surface: Any,
    snr: float,
    noisy: Tensor,
    heights: dict[str, Tensor],
    notes: dict[str, str],
) -> None:
    from torchdls._files import atomic_file
    from torchdls.plot import compare_heights, page_html, surface_page

    title = f"{name} from slopes with as much noise as signal" if snr == 0 else f"{name} from slopes at {snr:.0f} dB"
    figure = compare_heights(
        surface.height,
        heights,
        title=title,
        data_range=surface.data_range,
        gradient=surface.gradient,
        measured=noisy,
    )
    with atomic_file(folder / f"{name.lower()}.png", overwrite=True) as file:
        figure.savefig(file, format="png", dpi=110)
    page = surface_page({"Ground truth": surface.height, **heights}, title=title, notes=notes)
    with atomic_file(folder / f"{name.lower()}.html", overwrite=True) as file:
        file.write(page_html(page).encode())
