"""The recipes run, and what they assert holds; one whose package is not installed says so."""

import importlib.util
import re
from pathlib import Path

import pytest
import torch

import torchdls

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "recipes"
RECIPES = sorted(path for path in FOLDER.glob("*.md") if path.name != "index.md")
SLOW = {"deepinv": pytest.mark.slow, "lightning": pytest.mark.slow}  # whose packages take seconds to import


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # rasterio with affine 3
@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")  # Lightning
@pytest.mark.parametrize("path", [pytest.param(p, marks=SLOW.get(p.stem, ()), id=p.stem) for p in RECIPES])
def test_a_recipe_runs(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for package in re.findall(r"^<!-- needs: (\w+) -->$", text, re.MULTILINE):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"the recipe {path.stem} needs {package}")
    examples = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert examples
    assert "assert " in examples[-1]
    for example in examples:
        exec(example, {"torch": torch, "torchdls": torchdls, "__name__": "recipe"})


def test_the_index_lists_every_recipe() -> None:
    listed = re.findall(r"^- \[[^]]+\]\((\w+\.md)\): ", (FOLDER / "index.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == [path.name for path in RECIPES]
