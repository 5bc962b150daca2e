"""What a type checker tells a caller."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy", reason="the types are read by mypy")
ROOT = Path(__file__).resolve().parents[1]

RIGHT = """
from typing import assert_type

import torchdls
from torch import Tensor
from torchdls import (
    DLS, INTEGRATORS, LEARNERS, DLSResult, GradientToNormals, Integrator, Learner, LeastSquares, NormalsToGradient,
    TikhonovRegularization,
)

def call(g: Tensor, normals: Tensor, mask: Tensor) -> None:
    assert_type(DLS()(g), Tensor)
    assert_type(LeastSquares(tol=1e-3)(g, mask, anchor_weight=0.5), Tensor)
    assert_type(TikhonovRegularization()(g, prior=g[:, :1]), Tensor)
    assert_type(NormalsToGradient()(normals), Tensor)
    assert_type(GradientToNormals()(g), Tensor)
    assert_type(DLS().solve(g), DLSResult)
    assert_type(INTEGRATORS["dls"], type[Integrator])
    assert_type(INTEGRATORS["dls"]()(g), Tensor)
    assert_type(LEARNERS["k_svd"], type[Learner])
    assert_type(torchdls.build("dls", n_iter=3), Integrator)
    assert_type(torchdls.load("kept.safetensors")(g), Tensor)
    assert_type(torchdls.__version__, str)
"""

# Each line alone is an error.
WRONG = {
    'DLS()("slopes")': 'Argument 1 to "__call__" of "Integrator" has incompatible type "str"; expected "Tensor"',
    "LeastSquares()(g, masque=g)": 'Unexpected keyword argument "masque"',
    "NormalsToGradient()(normals, g)": "Too many arguments",
    "GradientToNormals()(g).height": '"Tensor" has no attribute "height"',
    "DLS(n_iters=3)": 'Unexpected keyword argument "n_iters"',
    "torchdls.no_such_name": 'Module has no attribute "no_such_name"',
    "INTEGRATORS[3]": 'Invalid index type "int"',
}


def mypy(tmp_path: Path, text: str) -> list[str]:
    """The errors of a file that a caller wrote."""
    (tmp_path / "caller.py").write_text(text)
    options = ["--strict", "--no-error-summary", "--hide-error-context", f"--cache-dir={ROOT / '.mypy_cache'}"]
    command = [sys.executable, "-m", "mypy", "--config-file=", *options, "--follow-imports=silent"]
    done = subprocess.run(
        [*command, str(tmp_path / "caller.py")],
        cwd=ROOT,
        env={"MYPYPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    return [line.partition("caller.py:")[2] for line in done.stdout.splitlines() if "caller.py:" in line]


@pytest.mark.slow
def test_calls_have_types_and_mistakes_are_errors(tmp_path: Path) -> None:
    first = RIGHT.count("\n") + 1
    text = RIGHT + "".join(f"    {line}\n" for line in WRONG)
    found = mypy(tmp_path, text)
    for number, (line, message) in enumerate(WRONG.items(), first):
        assert any(error.startswith(f"{number}: error: {message}") for error in found), (line, found)
    assert {int(error.partition(":")[0]) for error in found} == set(range(first, first + len(WRONG))), found


def test_the_call_is_declared_as_forward_is() -> None:
    seen = []
    for path in (ROOT / "torchdls").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                inner = [n for part in node.body for n in (part.body if isinstance(part, ast.If) else [part])]
                found = {n.name: n for n in inner if isinstance(n, ast.FunctionDef)}
                if {"forward", "__call__"} <= found.keys():
                    call, forward = found["__call__"], found["forward"]
                    assert ast.unparse(call.args) == ast.unparse(forward.args), node.name
                    seen.append(node.name)
    assert {"Integrator", "TikhonovRegularization", "NormalsToGradient", "GradientToNormals"} <= {*seen}
