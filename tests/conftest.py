"""What every test relies on: one thread per process, no display, and a seeded generator."""

import os

import pytest
import torch

os.environ.setdefault("MPLBACKEND", "Agg")
torch.set_num_threads(1)  # the tests run in parallel processes, and their tensors are small


@pytest.fixture
def generator() -> torch.Generator:
    """A CPU generator that starts the same in every test."""
    return torch.Generator().manual_seed(0)
