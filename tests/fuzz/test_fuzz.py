"""Two thousand cases of the fuzz (see `tests/fuzz/__init__.py`), and tests of the fuzz itself."""

import math

import pytest
import torch

import torchdls
from tests.fuzz.case import Case, Flaw, same_bits
from tests.fuzz.run import draw, judge
from tests.fuzz.targets import ELSEWHERE, PICTURES, TARGETS
from tests.fuzz.values import firm, mask, rational_solve, trust
from tests.helpers import random_field, sparse_solve

SEED, CASES, AT_ONCE = 20, 2000, 100
WARNING = "torchdls.ConvergenceWarning"


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, CASES, AT_ONCE))
def test_cases(first):
    failed = []
    for i in range(first, first + AT_ONCE):
        case = draw(SEED, i)
        if flaw := judge(case)[0]:
            failed.append(f"seed {SEED}, case {i}: {flaw}\n{case}\npython -m tests.fuzz --seed {SEED} --only {i}")
    assert not failed, "\n\n" + "\n\n".join(failed)


def test_every_public_name_is_a_target():
    known = {code.rpartition(".")[2] for code in (*TARGETS, *PICTURES)} | set(ELSEWHERE)
    known |= {type(torchdls.build(name)).__name__ for name in torchdls.INTEGRATORS}
    known |= {kind.__name__ for kind in torchdls.LEARNERS.values()}
    results = {name for name in torchdls.__all__ if hasattr(getattr(torchdls, name), "_fields")}
    assert set(torchdls.__all__) - known - results == {"__version__"}


def test_a_case_is_the_same_each_time():
    assert [str(draw(3, i)) for i in range(50)] == [str(draw(3, i)) for i in range(50)]
    assert len({str(draw(3, i)) for i in range(50)}) == 50
    case = draw(3, 7)
    assert all(isinstance(code, str) for code in case.arguments.values())


def flaw(target, judge_result=None, **more):
    return judge(Case(target, {"x": "torch.ones(2)"}, judge=judge_result, options=("x",), **more))[0]


def test_the_oracles_object():
    """To each kind of wrong, and to nothing that is right."""
    assert flaw("lambda x: x + 1") == ""
    assert "wrote to x" in flaw("lambda x: x.add_(1)")
    assert "not finite" in flaw("lambda x: x / 0")
    assert "ZeroDivisionError" in flaw("lambda x: 1 / 0")
    assert "in order" in flaw("lambda x: torch.ones(2).expand(torchdls.Patches(3, 5))")
    assert "warned" in flaw("lambda x: __import__('warnings').warn('careful') or x")
    assert "accepted" in flaw("lambda x: x", spoilt="x", must_raise=True)
    assert "names none" in flaw("lambda x: int('y')", spoilt="x")
    assert flaw("lambda x: torchdls.dct2(x)", spoilt="x") == ""
    far, near = (f"lambda x: __import__('warnings').warn('', {kind}) or x" for kind in (WARNING, "FutureWarning"))

    def off(case, f, given, result):
        raise Flaw("off")

    assert flaw("lambda x: x", off, patient=True) == flaw(far, off) == "off"
    assert flaw(far, off, patient=True) == ""
    assert "warned" in flaw(near, off, patient=True)


def test_rational_numbers_agree_with_scipy():
    v, w = random_field(2, 3, 4), random_field(2, 3, 4, seed=1).abs()
    w[0, :, -1] = w[1, -1] = 0
    anchor, r = random_field(1, 3, 4, seed=2), random_field(1, 3, 4, seed=3).clamp(min=0)
    for given in ((None, None), (anchor, r)):
        exact = rational_solve(v, w, *given)[0]
        torch.testing.assert_close(exact, torch.from_numpy(sparse_solve(v, w, *given)), rtol=0, atol=1e-12)


def test_values_are_as_they_say():
    assert (
        float(trust(1, 1, 20, 20, kind="orders").log10().max() - trust(1, 1, 20, 20, kind="orders").log10().min()) > 15
    )
    inside = mask(2, 6, 7, "islands", 4)
    held = firm(inside, "one", 5, 3.0)
    assert (held > 0).sum((1, 2, 3)).tolist() == [1, 1]
    assert bool(inside[held > 0].all())
    assert same_bits(torch.tensor([math.nan, 1.0]), torch.tensor([math.nan, 1.0]))
