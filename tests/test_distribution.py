"""The README on a package index, and what the source distribution holds."""

import re
import tomllib
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def for_an_index() -> Any:
    pytest.importorskip("hatchling")
    spec = spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.for_an_index


def test_links_and_pictures_become_absolute(for_an_index: Any) -> None:
    text = "See [a](docs/a.md#b), [c](https://c.org).\n\n![d](docs/d.png)\n\nMade by `make` at 0123456.\n\nEnd.\n"
    urls = {"files": "https://x.org/v1", "raw": "https://x.org/raw"}
    assert for_an_index(text, urls) == (
        "See [a](https://x.org/v1/docs/a.md#b), [c](https://c.org).\n\n"
        "![d](https://x.org/raw/docs/d.png)\n\nMade by `make` at 0123456.\n\nEnd.\n"
    )
    assert for_an_index(text, {}) == "See a, [c](https://c.org).\n\nEnd.\n"


@pytest.mark.parametrize("urls", [{}, {"files": "https://x.org/v1", "raw": "https://x.org/raw"}])
def test_nothing_in_the_readme_leads_to_a_file_beside_it(for_an_index: Any, urls: dict[str, str]) -> None:
    text = for_an_index((ROOT / "README.md").read_text(encoding="utf-8"), urls)
    assert all(target.startswith("https://") for target in re.findall(r"\]\(([^)]+)\)", text))
    assert "# torchdls" in text


def test_the_source_distribution_holds_what_builds_the_site() -> None:
    told = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    included = told["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert {"/torchdls", "/tests", "/docs", "/notebooks", "/mkdocs.yml", "/CHANGELOG.md"} <= set(included)
    assert all((ROOT / path.lstrip("/")).exists() for path in included)
