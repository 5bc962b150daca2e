"""What `--device` does: refuses a device that is not there, leaves out the other tests, and moves the helpers."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests import conftest
from tests.helpers import MASKS, random_field, uniform_field
from tests.helpers.methods import bumps, everything
from torchdls import LeastSquares


class Config:
    """As much of pytest's configuration as the hooks ask for."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.deselected: list[Any] = []
        self.hook = SimpleNamespace(pytest_deselected=lambda items: self.deselected.extend(items))

    def getoption(self, name: str) -> str:
        assert name == "--device"
        return self.device


def test_a_device_that_holds_no_values_is_a_usage_error() -> None:
    for device in ("meta", "abacus"):
        with pytest.raises(pytest.UsageError, match=f"--device {device}: this machine's PyTorch has no such device"):
            conftest.pytest_configure(Config(device))  # type: ignore[arg-type]
    assert torch.get_default_device().type == "cpu"


@pytest.mark.parametrize("device, kept", [("cpu", [0, 1, 2]), ("meta", [1])])
def test_on_another_device_marked_tests_run_alone(device: str, kept: list[int]) -> None:
    items: list[Any] = [SimpleNamespace(get_closest_marker=lambda name, mark=mark: mark) for mark in (None, "x", None)]
    config, left = Config(device), list(items)
    conftest.pytest_collection_modifyitems(config, left)  # type: ignore[arg-type]
    assert left == [items[i] for i in kept]
    assert config.deselected == [item for item in items if item not in left]


def test_helpers_make_their_tensors_on_the_default_device() -> None:
    with torch.device("meta"):
        tensors = [random_field(2, 3), uniform_field(2, 3), bumps(1), *(mask(16, 14) for mask in MASKS.values())]
        tensors += everything(LeastSquares(), bumps(1)).values()
    assert {t.device.type for t in tensors} == {"meta"}
    assert {t.device.type for t in (random_field(2), uniform_field(2), bumps(1))} == {"cpu"}
