"""Medians of masked samples against Python's own."""

import statistics

import pytest
import torch

from torchdls._statistics import NORMAL_MEDIAN, masked_median, midpoint_median


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_medians_are_those_of_the_standard_library(count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    x = torch.randn(3, 11, generator=generator, dtype=torch.float64)
    live = torch.stack([torch.randperm(11, generator=generator) < count for _ in range(3)])
    rows = [row[there].tolist() for row, there in zip(x, live, strict=True)]
    torch.testing.assert_close(masked_median(x, live), x.new_tensor([statistics.median_low(row) for row in rows]))
    torch.testing.assert_close(midpoint_median(x, live), x.new_tensor([statistics.median(row) for row in rows]))


def test_dead_samples_are_never_read() -> None:
    x, live = torch.tensor([[torch.nan, 3.0, torch.inf, 1.0, 2.0]]), torch.tensor([[False, True, False, True, True]])
    assert masked_median(x, live).item() == midpoint_median(x, live).item() == 2
    assert masked_median(x, torch.zeros_like(live)).item() == 0


def test_half_of_normal_magnitudes_are_below_the_factor() -> None:
    assert abs(statistics.NormalDist().inv_cdf(0.75) - NORMAL_MEDIAN) < 1e-12
