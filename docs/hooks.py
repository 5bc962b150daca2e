"""The reference of the site: every public name, grouped by room, and the registries as tables."""

import importlib
import inspect
import re
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

ROOMS = {
    "integrators": "Integrators",
    "batch": "Folders of maps",
    "reconstruction": "From a normal map to points",
    "large": "Larger than memory",
    "selection": "Choice by predicted risk",
    "noise": "Noise",
    "geometry": "Normals, conventions, cameras",
    "photometric": "Photometric stereo",
    "io": "Files",
    "persistence": "Integrators in files",
    "dictionary": "Dictionaries",
    "solvers": "The solve",
    "operators": "Operators",
    "metrics": "Metrics",
    "surfaces": "Surfaces to try methods on",
    "plot": "Pictures",
}
TABLES = {"INTEGRATORS": "integrators", "LEARNERS": "dictionary", "PHOTOMETRIC": "photometric"}


RESULTS = Path("benchmarks") / "results"
NOTEBOOKS = Path("notebooks")
CONTRIBUTING = "<!-- CONTRIBUTING.md -->"


@event_priority(100)  # before the plugin that reads notebooks
def on_files(files: Files, config) -> Files:
    """Add `api.md`, the notebooks, and the pictures and tables of the benchmarks."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        files.append(File(path.as_posix(), str(Path.cwd()), config.site_dir, config.use_directory_urls))
    files.append(File.generated(config, "api.md", content=reference()))
    for path in sorted([*RESULTS.glob("*.png"), *RESULTS.glob("*.md")]):
        files.append(File.generated(config, f"benchmarks/{path.name}", abs_src_path=str(path.resolve())))
    return files


def on_page_markdown(markdown: str, page, **_) -> str:
    """Links as the repository has them lead to their places on the site; CONTRIBUTING.md becomes a section."""
    if CONTRIBUTING in markdown:
        section = re.sub(r"^#", "##", Path("CONTRIBUTING.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
        markdown = markdown.replace(CONTRIBUTING, section)
    for there, here in (("../benchmarks/results/", "benchmarks/"), ("../notebooks/", "notebooks/")):
        markdown = markdown.replace(f"]({there}", f"]({here}")
    return markdown.replace("](CHANGELOG.md)", "")


def reference() -> str:
    """The page: a section for each room, in it a reference to each public name."""
    import torchdls

    rooms: dict[str, list[str]] = {room: [] for room in ROOMS}
    for name in public_names():
        value = getattr(torchdls, name)
        module = getattr(value, "__module__", None) if hasattr(value, "__name__") else None
        module = module or room_of(name)
        rooms.setdefault(module.split(".")[1], []).append(name)
    parts = ["# Reference\n\nEvery public name; all of them import from `torchdls`.\n"]
    for room, names in rooms.items():
        if names:
            parts.append(f"\n## {ROOMS.get(room, room)}\n")
            tables_first = sorted(names, key=lambda name: name not in TABLES)
            parts += [table(name) if name in TABLES else entry(name) for name in tables_first]
    return "\n".join(parts)


def public_names() -> list[str]:
    """The names of the stub, in its order."""
    stub = Path(importlib.import_module("torchdls").__file__ or "").with_suffix(".pyi")
    lines = stub.read_text(encoding="utf-8").splitlines()
    return [line.split(" as ")[-1] for line in lines if line.startswith("from .")]


def room_of(name: str) -> str:
    """The room of a constant, which knows no module: that of the line of the stub."""
    stub = Path(importlib.import_module("torchdls").__file__ or "").with_suffix(".pyi")
    lines = stub.read_text(encoding="utf-8").splitlines()
    return next(f"torchdls.{line.split()[1][1:]}" for line in lines if line.endswith(f" as {name}"))


def entry(name: str) -> str:
    """A reference to a class or function by the module that defines it."""
    import torchdls

    value = getattr(torchdls, name)
    if inspect.ismodule(value):
        return f"::: {value.__name__}\n"
    module = getattr(value, "__module__", None)
    if module is None or not hasattr(value, "__name__"):
        return f"### {name}\n\n`torchdls.{name}`: a table of {', '.join(f'`{key}`' for key in value)}.\n"
    return f"::: {module}.{value.__name__}\n"


def table(name: str) -> str:
    """A registry: its names, the class or function of each, and the first line of what it is."""
    import torchdls

    registry = getattr(torchdls, name)
    rows = []
    for key in registry:
        value = registry.find(key)
        link = f"[`{value.__name__}`][{value.__module__}.{value.__name__}]"
        rows.append(f"| `{key}` | {link} | {in_a_cell(registry.summary(key))} |")
    return "\n".join([f"### {name}\n", "| name | in Python | what it is |", "|---|---|---|", *rows, ""])


def in_a_cell(text: str) -> str:
    """A line of a docstring as the cell of a table: a bar would end it."""
    return text.replace("\\sum", "sum").replace("|", "\\|")
