"""The house rules that a reader relies on: floors, public names, short files, nothing left over."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchdls

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchdls"
SOURCES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = ["torchdls", "tests", "benchmarks", "notebooks", "docs", ".ci"]

# What each room may import. The floors, from the ground up; each may use all below it.
FLOORS = ["operators", "solvers", "dictionary", "noise", "selection", "integrators"]
MAY_IMPORT = {floor: set(FLOORS[:i]) for i, floor in enumerate(FLOORS)}
# Rooms that stand beside them.
MAY_IMPORT |= {
    "geometry": {"operators", "dictionary"},
    "surfaces": {"operators"},
    "metrics": {"operators", "geometry"},
    "photometric": {"operators", "solvers", "dictionary", "geometry"},
    "io": {"geometry"},
    "plot": {"operators", "geometry", "metrics"},
    "sequences": {"operators", "solvers", "dictionary", "noise"},
    "mesh": set(),
    "persistence": {"integrators"},
    "anchors": {"operators", "solvers"},
    "reconstruction": {"operators", "geometry", "integrators", "anchors"},
    "large": {"operators", "solvers", "dictionary", "noise", "integrators", "geometry"},
    "batch": {"operators", "solvers", "integrators", "geometry", "io"},
    "_registry": {"dictionary", "integrators"},  # for their types alone: it is read before PyTorch is loaded
}


def room(path: Path) -> str:
    """The top-level module or package that a source file belongs to."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported_rooms(path: Path) -> set[str]:
    """The rooms that a file imports, at its top or inside a function, by absolute or relative name."""
    package = ["torchdls", *path.relative_to(PACKAGE).parts[:-1]]
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) + 1 - node.level]] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            modules = [f"{module}.{alias.name}" for alias in node.names] if module == "torchdls" else [module]
        else:
            continue
        rooms |= {name.split(".")[1] for name in modules if name.startswith("torchdls.")}
    return rooms


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_imports_point_downward(path: Path) -> None:
    here = room(path)
    if here in {"__init__", "__main__", "cli"}:  # the doors
        return
    # A module with a leading underscore is the ground that every room stands on, and imports none of them.
    allowed = MAY_IMPORT.get(here, set()) if here.startswith("_") else MAY_IMPORT[here] | {here}
    wrong = {name for name in imported_rooms(path) if not name.startswith("_")} - allowed
    assert not wrong, f"{here} may import {sorted(allowed)}, not {sorted(wrong)}"


def test_import_reader_sees_every_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "solvers").mkdir()
    file = tmp_path / "solvers" / "x.py"
    file.write_text(
        "import torchdls.cli\nfrom torchdls import io\nfrom torchdls.plot import f\nfrom ..noise import g\n"
        "from .. import metrics\nfrom .y import h\nimport torch\n"
    )
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    assert imported_rooms(file) == {"cli", "io", "plot", "noise", "metrics", "solvers"}


@pytest.mark.parametrize("name", torchdls.__all__)
def test_public_name_imports_and_is_described(name: str) -> None:
    value = getattr(torchdls, name)
    assert name in dir(torchdls)
    if callable(value):
        assert value.__doc__, f"{name} has no docstring"


def test_only_public_names_are_listed() -> None:
    assert dir(torchdls) == sorted(torchdls.__all__)
    assert [name for name in dir(torchdls) if name.startswith("_")] == ["__version__"]
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    names = [alias.asname for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert {*torchdls.__all__} == {"__version__", *names}  # a type checker drops a name without `as`
    assert len(names) == len(set(names))


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="torchdls attribute no_such_name"):
        torchdls.no_such_name  # type: ignore[attr-defined]  # noqa: B018


def test_import_alone_does_not_load_torch() -> None:
    code = "import sys, torchdls; dir(torchdls); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its signature and docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


@pytest.mark.parametrize("folder", ["torchdls", "tests", "benchmarks"])
def test_functions_are_read_without_scrolling(folder: str) -> None:
    """A bound on functions, which is what one reads at once; files may be as long as their subject, up to 500 lines."""
    long = {}
    for path in (ROOT / folder).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if (n := len(text.splitlines())) > 500:
            long[path.name] = n
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (n := body_lines(node)) > 50:
                long[f"{path.name}:{node.name}"] = n
    assert not long


def matches(pattern: str, paths: list[Path]) -> list[str]:
    """The lines of the files that match a pattern, as ``file:line: text``."""
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(pattern, line)
    ]


def test_nothing_is_left_unfinished() -> None:
    assert not matches(r"\b(TODO|FIXME|XXX|NotImplementedError)\b", SOURCES)


def test_no_global_setting_is_changed() -> None:
    settings = r"\btorch\.(manual_seed|seed|set_\w+|use_deterministic\w*)\(|\bnp\.random\.seed\("
    # The command line owns its process, and chooses its threads. Autocast is switched off for one step of the backward
    # pass, after which the engine takes it back (`tests/integrators/test_autocast.py`).
    owners = {PACKAGE / "cli" / "batch.py", PACKAGE / "_precision.py"}
    assert not matches(settings, [path for path in SOURCES if path not in owners])


def test_no_path_of_one_machine() -> None:
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")] + [*ROOT.glob("*")]
    texts = [
        path for path in files if path.suffix in {".py", ".md", ".toml", ".ipynb"} or path.name in {"Makefile", "run"}
    ]
    # Slashes inside a picture's base64 text do not match: a path begins a line or follows one of these.
    assert not matches(r"(^|[\s\"'`=(:])/(home|root|Users|work|opt|tmp)/\w", texts)


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.py")), ids=lambda p: p.stem)
def test_notebook_is_its_source_and_was_run(path: Path) -> None:
    marked = re.split(r"^# %%(.*)\n", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    source = [text.strip() for mark, text in zip(marked[::2], marked[1::2], strict=True) if "markdown" not in mark]
    notebook = json.loads(path.with_suffix(".ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert ["".join(cell["source"]) for cell in cells] == source, "run `make notebooks-update`"
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell["outputs"])
    # It ends with what was learned, and every figure there was printed above.
    assert notebook["cells"][-1]["cell_type"] == "markdown"
    learned = "".join(notebook["cells"][-1]["source"])
    printed = "".join(line for cell in cells for output in cell["outputs"] for line in output.get("text", []))
    figures = set(re.findall(r"\d+\.\d+", learned))
    assert figures
    assert figures <= set(re.findall(r"\d+\.\d+", printed))
