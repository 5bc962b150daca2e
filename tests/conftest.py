"""What every test relies on: one thread per process, no display, a seeded generator, and the device of `--device`."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as in the command line: threads that wait sleep

import pytest
import torch

os.environ.setdefault("MPLBACKEND", "Agg")
torch.set_num_threads(1)  # the tests run in parallel processes, and their tensors are small


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device",
        default="cpu",
        help="device of the tests marked `device`, such as cuda; on another than the CPU they run alone (default: cpu)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse a device that holds no values here; make it the default before any test module makes a tensor."""
    name = config.getoption("--device")
    try:
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError) as error:  # a PyTorch without CUDA asserts that it has it
        reason = str(error).partition("\n")[0]
        raise pytest.UsageError(f"--device {name}: this machine's PyTorch has no such device ({reason})") from error
    if torch.device(name).type != "cpu":
        torch.set_default_device(name)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """On another device, leave out the tests that compare with NumPy or say where their tensors are."""
    if torch.device(config.getoption("--device")).type != "cpu":
        others = [item for item in items if item.get_closest_marker("device") is None]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if item.get_closest_marker("device") is not None]


@pytest.fixture
def generator() -> torch.Generator:
    """A CPU generator that starts the same in every test."""
    return torch.Generator().manual_seed(0)
