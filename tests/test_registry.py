"""The table of integrators by name."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import torchdls
from tests.helpers.methods import Method
from torchdls import INTEGRATORS, Integrator
from torchdls._registry import Registry

ROOT = Path(__file__).resolve().parents[1]


def test_every_integrator_is_in_it_once():
    classes = [INTEGRATORS[name] for name in INTEGRATORS]
    public = [getattr(torchdls, name) for name in torchdls.__all__]
    public = [c for c in public if isinstance(c, type) and issubclass(c, Integrator) and c is not Integrator]
    assert set(classes) == set(public)
    assert len(classes) == len(set(classes)) == len(INTEGRATORS)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_entry(name):
    method = INTEGRATORS[name]
    assert name == name.lower()
    assert name.replace("_", "") == method.__name__.lower()
    summary = INTEGRATORS.summary(name)
    assert summary.endswith(".")
    assert len(summary) < 110
    options = INTEGRATORS.parameters(name)
    assert options["pixel_size"] == 1.0
    assert isinstance(method(**options), Integrator)  # all options have defaults, and they are accepted
    assert method.accepts <= {"mask", "weight", "anchor"}


def test_unknown_name():
    assert "magic" not in INTEGRATORS
    assert INTEGRATORS.get("magic") is None
    with pytest.raises(KeyError, match="'magic' is unknown; choose from least_squares, "):
        INTEGRATORS["magic"]


def test_names_are_listed_without_torch():
    code = (
        "import sys; from torchdls.cli.main import _parser; _parser().format_help(); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_one_line_registers_a_class_of_any_module():
    """Of the package by its public name, of elsewhere by its path: nothing else has to know it."""
    table: Registry[Any] = Registry({"own": "tests.helpers.methods.Method", "huber": "Huber"})
    assert table["own"] is Method
    assert table.name_of(Method) == "own"
    assert table.name_of(torchdls.Huber) == "huber"
    assert table.name_of(torchdls.L1) is None
