"""The README's example runs as it is printed, only smaller."""

import re
from pathlib import Path

import torch

import torchdls

README = Path(__file__).resolve().parents[1] / "README.md"


def test_first_example_runs(capsys) -> None:
    example = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)[0]
    names: dict = {}
    exec(example.replace("(200)", "(32)"), names)
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert names["height"].shape == (1, 1, 32, 32)
    assert torch.isfinite(names["height"]).all()
    assert not torch.equal(names["height"], names["plain"])


def test_every_method_is_named() -> None:
    text = README.read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| `(\w+)` \|", text, re.MULTILINE))
    assert rows == {name: torchdls.INTEGRATORS[name].__name__ for name in torchdls.INTEGRATORS}


def test_every_name_of_the_package_in_the_examples_exists() -> None:
    text = README.read_text(encoding="utf-8")
    names = set(re.findall(r"torchdls\.([A-Za-z]\w+)", text))
    assert names
    assert all(hasattr(torchdls, name) for name in names)
