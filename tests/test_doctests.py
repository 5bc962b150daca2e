"""The examples in the docstrings of the public names are run; each callable of `torchdls` has one."""

import doctest
from pathlib import Path

import pytest
import torch

import torchdls

CALLABLE = [name for name in torchdls.__all__ if callable(getattr(torchdls, name))]


@pytest.mark.parametrize("name", CALLABLE)
def test_example(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `torch` and `torchdls` at hand, in an empty directory; a missing result counts as a failure too."""
    monkeypatch.chdir(tmp_path)
    known = {"torch": torch, "torchdls": torchdls, "__name__": "example"}
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(getattr(torchdls, name), f"torchdls.{name}", module=False, globs=known)
    assert example.examples, f"{name} has no example in its docstring"
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert not said, "".join(said)
    assert not list(tmp_path.iterdir()), "an example leaves files behind"


@pytest.mark.parametrize("text", ["Nothing.", "Wrong.\n\n    >>> 1 + 1\n    3\n"])
def test_a_missing_and_a_wrong_example_fail(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchdls.rmse, "__doc__", text)
    with pytest.raises(AssertionError, match=r"Expected:\n +3" if "1" in text else "rmse has no example"):
        test_example("rmse", tmp_path, monkeypatch)
