"""What every benchmark writes: JSON with the versions and the commit, and Markdown tables."""

from __future__ import annotations

import json
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]


def environment(packages: Iterable[str] = ("torch", "numpy", "scipy", "kornia", "scikit-image")) -> dict[str, Any]:
    """The commit, machine and versions that a figure belongs to."""
    return {
        "commit": _git("rev-parse", "--short", "HEAD"),
        "uncommitted_changes": bool(_git("status", "--porcelain", "--", "torchdls", "benchmarks/*/*.py")),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "threads": torch.get_num_threads(),
        "versions": {name: _version(name) for name in packages},
    }


def results_folder(smoke: bool) -> Path:
    """Where a script writes by default: the committed results, or a scratch folder for a smoke run."""
    return ROOT.parent / "build" / "benchmarks" if smoke else ROOT / "results"


def write_json(path: Path | str, **content: Any) -> Path:
    """Write the content with its environment."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    environment_of_run = AT_START | {"threads": torch.get_num_threads()}
    path.write_text(json.dumps({"environment": environment_of_run, **content}, indent=1) + "\n")
    return path


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table; floats are printed with three decimals."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(_cell(c) for c in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def made_by(module: str) -> str:
    """The line under a table or a picture: what made it, and the commit that this run started from."""
    changed = ", with changes that were not committed" if AT_START["uncommitted_changes"] else ""
    return f"Made by `python -m {module}` at {AT_START['commit']}{changed}.\n"


def replace_section(path: Path | str, name: str, text: str) -> None:
    """Put text between the lines `<!-- name -->` and `<!-- /name -->` of a Markdown file."""
    path, start, end = Path(path), f"<!-- {name} -->", f"<!-- /{name} -->"
    head, rest = path.read_text().split(start)
    _, tail = rest.split(end)
    path.write_text(f"{head}{start}\n{text.strip()}\n{end}{tail}")


def _cell(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _git(*args: str) -> str:
    run = subprocess.run(["git", *args], cwd=ROOT.parent, capture_output=True, text=True, check=False)
    return run.stdout.strip()


def summary(values: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """Means of named tensors as plain numbers."""
    return {name: float(value.double().mean()) for name, value in values.items()}


AT_START = environment()  # a long run belongs to the commit that it started from
