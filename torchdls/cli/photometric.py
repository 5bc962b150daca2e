"""`torchdls photometric`: from photographs under single lights to normals and a surface."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdls._registry import INTEGRATORS, PHOTOMETRIC
from torchdls.cli.methods import build_method, check_method, options_of, run_method
from torchdls.cli.pictures import OUTPUTS, Shown, check_outputs, is_picture, maps_of, write_picture

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.io import Photographs

_METHOD, _INTEGRATOR = "woodham", "slope_dls"


def add_photometric(commands: Any) -> None:
    """Add the command `photometric`."""
    command = commands.add_parser(
        "photometric",
        help="photographs under single lights to normals and a surface",
        description="Photometric stereo on a folder: one picture for each light; lights.txt or light_directions.txt (x "
        "y z: right, up, to the viewer), or ball_mask.png of a mirror ball in the pictures; optionally mask.png, "
        "filenames.txt, light_intensities.txt.",
    )
    add = command.add_argument
    add("folder", metavar="FOLDER", help="the folder with the pictures")
    add("-o", "--out", action="append", default=[], metavar="OUT", help=f"the surface: {OUTPUTS}")
    add(
        "--normals",
        metavar="OUT",
        help="the normal map: PNG (16-bit), NPY or NPZ (with albedo, confidence and covariance)",
    )
    add("--method", default=_METHOD, help=f"{', '.join(PHOTOMETRIC)} (default: {_METHOD})")
    add("--integrator", default=_INTEGRATOR, help=f"{', '.join(INTEGRATORS)} (default: {_INTEGRATOR})")
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="option of the integrator, such as lam=0.5")
    add("--method-set", action="append", default=[], metavar="NAME=VALUE", help="option of the method, as shadow=0.1")
    add("--weigh", action="store_true", help="weigh each slope by its confidence")
    add("--refine", action="store_true", help="polish the surface by the images themselves")
    add("--lights", metavar="FILE", help="directions of the lights, in place of the folder's own")
    add("--pixel-size", type=float, default=1.0, metavar="D", help="spacing of the pixels")
    add("--unit", metavar="NAME", help="unit of the heights, for the labels of pictures, such as mm")
    add("--force", action="store_true", help="replace output files that exist")
    add("--quiet", action="store_true", help="no progress bar and no report")
    command.set_defaults(run=_photometric)


def _photometric(arguments: argparse.Namespace) -> None:
    import torch

    from torchdls import io
    from torchdls._files import check_output

    if not arguments.out and arguments.normals is None:
        raise ValueError("nothing to write: give -o OUT for the surface, or --normals OUT for the normal map")
    if arguments.method not in PHOTOMETRIC:
        raise ValueError(f"--method: {arguments.method!r} is unknown; choose from {', '.join(PHOTOMETRIC)}")
    options = _options(arguments.method, arguments.method_set)
    if not arguments.pixel_size > 0:
        raise ValueError(f"--pixel-size: {arguments.pixel_size} given, a positive number is needed")
    check_method(arguments.integrator, arguments.set, "--integrator")
    check_outputs(arguments.out, arguments.force)
    if arguments.normals is not None:
        check_output(arguments.normals, arguments.force, suffixes=io.NORMAL_SUFFIXES)
    start = time.perf_counter()
    photographs = io.load_photographs(arguments.folder, arguments.lights)
    lights, source = _lights(arguments.folder, photographs)
    images, mask = photographs.images, _object(photographs)
    with torch.no_grad():
        found = PHOTOMETRIC.find(arguments.method)(images, lights, mask=mask, **options)
        if not bool((found.normals != 0).any()):
            raise ValueError(f"{arguments.folder}: no pixel has a normal; three lights must reach it")
        if arguments.normals is not None:
            io.save_normals(arguments.normals, found.normals, mask=mask, overwrite=arguments.force, **_said(found))
        noise = _surface(arguments, images, lights, mask, found) if arguments.out else None
    if not arguments.quiet:
        seconds, k, (h, w) = time.perf_counter() - start, images.shape[1], images.shape[-2:]
        outputs = [*arguments.out, *([arguments.normals] * bool(arguments.normals))]
        pixels = int((found.normals != 0).any(1).sum())
        level = "" if noise is None else f", noise {noise:.3g} in the slopes,"
        names = ", ".join([arguments.method, *([arguments.integrator] * bool(arguments.out))])
        print(f"{arguments.folder}: {k} pictures of {h} x {w}, lights from {source}")
        print(f"{names}: {pixels} of {h * w} pixels{level} in {seconds:.2f} s -> {', '.join(outputs)}")


def _options(name: str, settings: list[str]) -> dict[str, Any]:
    """Options of a photometric method from words `name=value`; ValueError for what it does not have, or no number."""
    fields = ("images", "lights", "mask", "lit")
    known = {key: default for key, default in PHOTOMETRIC.parameters(name).items() if key not in fields}
    options = options_of(settings, "--method-set")
    for key, value in options.items():
        if key not in known:
            listed = ", ".join(f"{option}={default}" for option, default in known.items())
            raise ValueError(f"--method-set: {name} has no option {key!r}; its options and their defaults: {listed}")
        if isinstance(known[key], int | float) and not isinstance(value, int | float | None):
            raise ValueError(f"--method-set: {key}={value} given, a number is needed (default: {known[key]})")
    return options


def _lights(folder: str, photographs: Photographs) -> tuple[Tensor, str]:
    from torchdls.photometric import lights_from_ball

    if photographs.lights is not None:
        return photographs.lights, "file"
    if photographs.ball is None:
        raise ValueError(f"{folder}: no lights.txt or light_directions.txt, and no ball_mask.png of a mirror ball")
    return lights_from_ball(photographs.images[0], photographs.ball[0]), "mirror ball"


def _object(photographs: Photographs) -> Tensor | None:
    """The pixels of the object: those of its mask, and not the ball."""
    mask, ball = photographs.mask, photographs.ball
    if ball is None:
        return mask
    return ~ball if mask is None else mask & ~ball


def _said(found: Any) -> dict[str, Any]:
    """What NPZ files hold beside the normals: albedo and confidence (H, W), covariance (6, H, W)."""
    return {"albedo": found.albedo[0, 0], "confidence": found.confidence[0, 0], "covariance": found.covariance[0]}


def _surface(
    arguments: argparse.Namespace, images: Tensor, lights: Tensor, mask: Tensor | None, found: Any
) -> float | None:
    """Write the surface; the noise level of the slopes, where the integrator reads it."""
    from torchdls import io
    from torchdls.geometry import normals_to_gradient
    from torchdls.photometric import refine

    field = normals_to_gradient(found.normals, mask=mask)
    inside = None if bool(field.mask.all()) else field.mask
    size = (arguments.pixel_size, arguments.pixel_size)
    method = build_method(arguments.integrator, size, arguments.set, "--integrator")
    weight = found.confidence if arguments.weigh else None
    label = Path(arguments.folder).name
    result = run_method(label, method, arguments.quiet, field.gradient, mask=inside, weight=weight)
    height, maps = result.height, maps_of(result, inside, weight)
    if arguments.refine:
        height = refine(height, images, lights, mask=inside, pixel_size=size).height
    for path in arguments.out:
        if is_picture(path):
            shown = Shown(height, inside, size, field.gradient, **maps)
            title = f"{label}, {arguments.method}, {arguments.integrator}"
            write_picture(path, shown, title=title, unit=arguments.unit, overwrite=arguments.force)
        else:
            io.save_height(
                path, height, mask=inside, pixel_size=size, overwrite=arguments.force,
                normals=found.normals[0], gradient=field.gradient[0], **_said(found),
                **{name: maps[name][0] for name in maps},
            )  # fmt: skip
    noise = result._asdict().get("noise")
    return None if noise is None else float(noise)
