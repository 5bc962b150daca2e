"""The README's example runs as it is printed, only smaller."""

import re
from pathlib import Path

import torch

README = Path(__file__).resolve().parents[1] / "README.md"


def test_first_example_runs(capsys) -> None:
    example = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)[0]
    names: dict = {}
    exec(example.replace("(200)", "(48)"), names)
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert names["height"].shape == (1, 1, 48, 48)
    assert torch.isfinite(names["height"]).all()
    assert not torch.equal(names["height"], names["plain"])
