"""Pictures as outputs: -o view.html, -o preview.png, and `torchdls view` of a surface in a file."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

PICTURES = "a name that ends in .html is a page to turn the surface in 3-D, preview.png or NAME_preview.png its maps"
OUTPUTS = f"NPZ, NPY, TIFF (32-bit), PNG (16-bit), PLY, OBJ, STL or GLB, or a picture: {PICTURES}; may be repeated"


class Shown(NamedTuple):
    """What pictures show: fields (1, C, H, W), and under a camera the depth in place of the height."""

    height: Tensor
    mask: Tensor | None
    pixel_size: tuple[float, float]
    gradient: Tensor | None = None
    trust: Tensor | None = None
    jump: Tensor | None = None
    camera: Tensor | None = None


def is_picture(path: str | os.PathLike[str]) -> bool:
    """Whether a name asks for a page or a preview, and not for heights."""
    name = Path(path).name.lower()
    return name.endswith(".html") or name == "preview.png" or name.endswith("_preview.png")


def check_outputs(paths: Sequence[str], overwrite: bool) -> None:
    """Say before the work what would fail after it, a missing library of pictures too."""
    from torchdls import io
    from torchdls._files import check_output, require

    for path in paths:
        check_output(path, overwrite, suffixes=(*io.OUTPUT_SUFFIXES, ".html"))
        if is_picture(path):
            require("plotly" if path.lower().endswith(".html") else "matplotlib", "plots")


def write_picture(path: str, shown: Shown, *, title: str, unit: str | None, overwrite: bool) -> None:
    """The page or the preview that the name asks for."""
    from torchdls import plot
    from torchdls._files import atomic_file
    from torchdls.geometry import depth_to_points

    height, mask, pixel_size, gradient, trust, jump, camera = _cropped(shown)
    if unit is None:
        unit = "geometric mean 1" if camera is not None else "px" if pixel_size == (1.0, 1.0) else "unit of pixel size"
    if path.lower().endswith(".html"):
        surface = height if camera is None else depth_to_points(height, camera.to(height))
        page = plot.surface_page({"surface": surface}, mask=mask, pixel_size=pixel_size, unit=unit, title=title)
        content = plot.page_html(page).encode()
    else:
        figure = plot.surface_preview(
            height, gradient=gradient, mask=mask, trust=trust, jump=jump, pixel_size=pixel_size, title=title,
            unit=unit, quantity="height" if camera is None else "depth",
        )  # fmt: skip
        content = plot.png_bytes(figure)
    with atomic_file(path, overwrite) as file:
        file.write(content)


def _cropped(shown: Shown) -> Shown:
    """Only the rectangle that the mask fills, with a pixel around it."""
    if shown.mask is None:
        return shown
    rows, columns = shown.mask[0, 0].nonzero(as_tuple=True)
    top, left = (max(int(places.min()) - 1, 0) for places in (rows, columns))
    box = (..., slice(top, int(rows.max()) + 2), slice(left, int(columns.max()) + 2))
    camera = shown.camera
    if camera is not None:
        camera = camera.clone()
        camera[0, 2] -= left
        camera[1, 2] -= top
    fields: dict[str, Any] = {name: getattr(shown, name) for name in ("height", "mask", "gradient", "trust", "jump")}
    part: dict[str, Any] = {name: None if field is None else field[box] for name, field in fields.items()}
    return shown._replace(camera=camera, **part)


def maps_of(result: Any, mask: Tensor | None, weight: Tensor | None) -> dict[str, Any]:
    """What a result says of jumps and of slopes that it distrusts, and the weights it was given."""
    found = result._asdict()
    trust, confidence = weight, found.get("confidence")
    if confidence is not None and bool((confidence if mask is None else confidence[mask]).lt(1).any()):
        trust = confidence if weight is None else confidence * weight
    maps = {"trust": trust, "jump": found.get("jump")}
    return {name: field for name, field in maps.items() if field is not None}


def add_view(commands: Any) -> None:
    """Add the command `view`."""
    command = commands.add_parser(
        "view",
        help="look at a surface that is in a file",
        description="Open a page on which the surface of a file can be turned in 3-D, in the browser.",
    )
    add = command.add_argument
    add("input", metavar="SURFACE", help="NPZ, NPY, TIFF or PNG as `torchdls integrate` writes them")
    add("-o", "--out", action="append", default=[], metavar="OUT",
        help=f"write pictures in place of opening a browser: {PICTURES}; may be repeated")  # fmt: skip
    add("--unit", metavar="NAME", help="unit of the heights, for the labels, such as mm")
    add("--force", action="store_true", help="replace output files that exist")
    command.set_defaults(run=_view)


def _view(arguments: argparse.Namespace) -> None:
    outputs = arguments.out
    for path in outputs:
        if not is_picture(path):
            raise ValueError(f"-o: {path} is no picture; {PICTURES}")
    check_outputs(outputs, arguments.force)
    shown = read_shown(arguments.input)
    place = None
    if not outputs:
        place = Path(tempfile.mkdtemp(prefix="torchdls-"), f"{Path(arguments.input).stem}.html")
        outputs = [str(place)]
        check_outputs(outputs, arguments.force)
    for path in outputs:
        write_picture(path, shown, title=Path(arguments.input).name, unit=arguments.unit, overwrite=arguments.force)
        print(f"{arguments.input} -> {path}")
    if place is not None:
        import webbrowser

        if not webbrowser.open(place.as_uri()):
            print("no browser was found here: open that page in one")


def read_shown(path: str) -> Shown:
    """The surface of a file, and of an NPZ the fields beside it."""
    import torch

    from torchdls import io
    from torchdls.batch.maps import LOG_DEPTH_GRADIENT
    from torchdls.io.formats import read_file

    found = io.load_height(path)
    shown = Shown(found.height, found.mask, found.pixel_size)
    if not path.lower().endswith(".npz"):
        return shown
    content = read_file(Path(path), (".npz",))
    fields: dict[str, Any] = {}
    deep = "depth" in content and "height" not in content
    names = {"gradient": LOG_DEPTH_GRADIENT if deep else "gradient", "trust": "trust", "jump": "jump"}
    for name, entry in names.items():
        if entry in content:
            fields[name] = torch.from_numpy(content[entry])[None].to(found.height)
            if fields[name].ndim != 4 or fields[name].shape[-2:] != found.height.shape[-2:]:
                raise ValueError(f"{path}: {entry}: shape {tuple(content[entry].shape)} does not fit the surface")
    if deep:
        if "camera" not in content:
            raise ValueError(f"{path}: holds a depth without the camera, by which it could be shown")
        fields["camera"] = torch.from_numpy(content["camera"])
    return shown._replace(**fields)
