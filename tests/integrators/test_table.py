"""The table of helpers/methods.py names methods, promises and options that exist."""

import pytest

from tests.helpers.methods import METHODS, ROBUST
from tests.integrators import test_contract, test_derivatives
from tests.integrators.robust import test_robust
from torchdls import INTEGRATORS

MODULES = (test_contract, test_derivatives, test_robust)
PROMISES = {n.removeprefix("test_") for module in MODULES for n in vars(module) if n.startswith("test_")}


def test_it_names_methods_that_exist() -> None:
    assert set(METHODS) <= set(INTEGRATORS)
    assert {name for name, _ in ROBUST.values()} <= set(INTEGRATORS)


@pytest.mark.parametrize("name", METHODS)
def test_it_names_promises_and_options_that_exist(name: str) -> None:
    listed = METHODS[name]
    assert set(listed.no) <= PROMISES, "a promise that no test makes"
    assert all(listed.no.values()), "a promise that is not made needs a reason"
    for options in (listed.options, *listed.exact.values()):
        assert set(options) <= set(INTEGRATORS.parameters(name))
    assert "default" in listed.exact
