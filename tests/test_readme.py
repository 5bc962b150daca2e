"""The README's example runs as it is printed, only smaller."""

import re
import subprocess
from pathlib import Path

import pytest
import torch

import torchdls
from torchdls.geometry import NORMAL_CONVENTIONS

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
NUMBERS = re.compile(r"\d\.\d")


def test_first_example_runs(capsys) -> None:
    example = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)[0]
    names: dict = {}
    exec(example.replace("(200)", "(32)"), names)
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert names["height"].shape == (1, 1, 32, 32)
    assert torch.isfinite(names["height"]).all()
    assert not torch.equal(names["height"], names["plain"])


def test_every_method_is_named() -> None:
    text = (ROOT / "docs" / "which.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| `(\w+)` \|", text, re.MULTILINE))
    assert rows == {name: torchdls.INTEGRATORS[name].__name__ for name in torchdls.INTEGRATORS}


def test_every_convention_is_named() -> None:
    text = README.read_text(encoding="utf-8")
    assert re.findall(r'^\| `"(\w+)"` \|', text, re.MULTILINE) == [*NORMAL_CONVENTIONS]


@pytest.mark.parametrize("path", PAGES[1:], ids=lambda path: path.name)
def test_the_examples_of_a_page_run_one_after_the_other(path: Path) -> None:
    names: dict = {"torch": torch, "torchdls": torchdls}
    for example in re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
        exec(example, names)


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 140


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        assert target.startswith("http") or target == "api.md" or (path.parent / target).exists(), target


def test_every_name_of_the_package_in_the_examples_exists() -> None:
    text = README.read_text(encoding="utf-8")
    names = set(re.findall(r"torchdls\.([A-Za-z]\w+)", text))
    assert names
    assert all(hasattr(torchdls, name) for name in names)


def results(page: str) -> dict[str, str]:
    """Each table of figures and each picture of a page by its first line, and the paragraph that follows it."""
    blocks = [block for block in re.split(r"\n(?:[ \t]*\n|(?=<!--)|(?<=-->\n))+", page) if not block.startswith("<!--")]
    found = {}
    for block, after in zip(blocks, [*blocks[1:], ""], strict=True):
        rows = block.splitlines()[2:] if block.startswith("|") else []
        if block.startswith("![") or (rows and sum(bool(NUMBERS.search(row)) for row in rows) > len(rows) / 2):
            found[block.partition("\n")[0]] = after
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_result_names_what_made_it(path: Path) -> None:
    found = results(path.read_text(encoding="utf-8"))
    told = re.compile(r"Made by\s`(make|python -m) [^`]+` at [0-9a-f]{7,}\b")
    assert not [first for first, after in found.items() if not told.match(after)]
    assert found or path.name not in ("README.md", "results.md")


def test_a_table_without_its_source_would_be_seen() -> None:
    table = "| surface | RMSE |\n|---|---|\n| tent | 0.12 |\n"
    made = "Made by `python -m benchmarks.speed.compare` at 0123456."
    assert results(f"Text.\n\n{table}\nMore text.") == {"| surface | RMSE |": "More text."}
    assert results(f"<!-- speed -->\n{table}\n{made}\n<!-- /speed -->\n\nMore.") == {"| surface | RMSE |": made}
    assert results("| name | what |\n|---|---|\n| mask | 1 is valid |\n") == {}


def test_the_commits_that_made_results_are_in_the_history() -> None:
    def git(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *command], cwd=ROOT, capture_output=True, text=True, check=False)

    shallow = git("rev-parse", "--is-shallow-repository")
    if shallow.stdout.strip() != "false":
        pytest.skip("no history here")
    text = " ".join(path.read_text(encoding="utf-8") for path in PAGES)
    commits = set(re.findall(r"` at ([0-9a-f]{7,})\b", text))
    assert commits
    assert not [commit for commit in commits if git("merge-base", "--is-ancestor", commit, "HEAD").returncode]
