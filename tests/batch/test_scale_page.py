"""The class of docs/scale.md runs as it is printed; Ray would hand it blocks as these."""

import re
from pathlib import Path

import numpy as np

from tests.helpers.maps import contents, write_maps
from torchdls.cli.main import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "scale.md"


def test_the_class_for_an_engine(tmp_path):
    names: dict = {}
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(example, names)
    write_maps(tmp_path / "in", [(16, 20), (24, 24)])
    (tmp_path / "in" / "bad.png").write_text("nothing")
    (tmp_path / "out").mkdir()
    paths = np.array(sorted(str(path) for path in (tmp_path / "in").iterdir()))
    work = names["Surfaces"](str(tmp_path / "out"), "least_squares")
    rows = work({"path": paths})
    assert rows["path"] == list(paths)
    assert ["no PNG file" in reason for reason in rows["reason"]] == [True, False, False]
    arguments = ["batch", str(tmp_path / "in" / "m*.png"), "--out", str(tmp_path / "batch"), "--quiet"]
    assert main([*arguments, "--method", "least_squares"]) == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "batch")
    assert work({"path": paths[1:]})["reason"] == ["", ""]  # kept
