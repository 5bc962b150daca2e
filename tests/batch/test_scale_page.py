"""The code of docs/scale.md runs as it is printed: the class by itself, in blocks as Ray hands them, and by Ray."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.maps import contents, write_maps
from torchdls.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")
CLASS, CALL = (re.findall(rf"```{word}\n(.*?)```", PAGE, re.DOTALL)[0] for word in ("python", "py"))


def write_inputs(folder):
    write_maps(folder / "in", [(16, 20), (24, 24)])
    (folder / "in" / "bad.png").write_text("nothing")
    (folder / "out").mkdir()
    return sorted(str(path) for path in (folder / "in").iterdir())


def write_batch(folder):
    arguments = ["batch", str(folder / "in" / "m*.png"), "--out", str(folder / "batch"), "--quiet"]
    assert main([*arguments, "--method", "least_squares"]) == 0


def test_the_class_for_an_engine(tmp_path):
    names: dict = {}
    exec(CLASS, names)
    paths = np.array(write_inputs(tmp_path))
    work = names["Surfaces"](str(tmp_path / "out"), "least_squares")
    rows = work({"path": paths})
    assert rows["path"] == list(paths)
    assert ["no PNG file" in reason for reason in rows["reason"]] == [True, False, False]
    write_batch(tmp_path)
    assert contents(tmp_path / "out") == contents(tmp_path / "batch")
    assert work({"path": paths[1:]})["reason"] == ["", ""]  # kept


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed: pip install 'torchdls[scale]'")
def test_ray_runs_it(tmp_path):
    """In a process of its own: Ray starts others, and warns of its own doings."""
    paths = write_inputs(tmp_path)
    call = CALL
    for told, here in {
        '("/results",)': repr((str(tmp_path / "out"), "least_squares")),
        '"/report"': repr(str(tmp_path / "report")),
        "(1, 256)": "(1, 2)",
    }.items():
        assert told in call
        call = call.replace(told, here)
    start = "import ray\nray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)\n"
    code = f"{CLASS}\n{start}\npaths = {paths!r}\n{call}\nray.shutdown()\n"
    environment = {"PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0", "PATH": "", "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    parquet = pytest.importorskip("pyarrow.parquet")
    report = parquet.read_table(tmp_path / "report").to_pylist()
    assert {row["path"]: "no PNG file" in row["reason"] for row in report} == {p: "bad" in p for p in paths}
    write_batch(tmp_path)
    assert contents(tmp_path / "out") == contents(tmp_path / "batch")
