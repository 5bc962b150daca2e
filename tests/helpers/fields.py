"""Small masks and random fields, on PyTorch's default device (see `--device`), with the same values on each."""

import torch
from torch import Tensor


def seeded(seed: int) -> torch.Generator:
    """A CPU generator of its own."""
    return torch.Generator().manual_seed(seed)


def random_field(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Standard normal values."""
    values = torch.randn(*shape, dtype=dtype, generator=seeded(seed), device="cpu")
    return values.to(torch.get_default_device())


def uniform_field(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Values between 0 and 1."""
    values = torch.rand(*shape, dtype=dtype, generator=seeded(seed), device="cpu")
    return values.to(torch.get_default_device())


def _disk(h: int, w: int) -> Tensor:
    y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    return (x.square() + y.square() < 0.9)[None, None]


def _ring_and_islands(h: int, w: int) -> Tensor:
    """A block with a hole, inside the hole an island, apart from it a bar one pixel wide and a lone pixel."""
    mask = torch.zeros(1, 1, h, w, dtype=torch.bool)
    mask[..., 1 : h - 1, 1 : w - 5] = True
    mask[..., h // 4 : 3 * h // 4, w // 5 : w - 8] = False
    mask[..., h // 4 + 2 : h // 2 + 2, w // 5 + 2 : w // 5 + 5] = True
    mask[..., 2 : h - 3, w - 3] = True
    mask[..., h - 1, w - 1] = True
    return mask


def _sieve(h: int, w: int) -> Tensor:
    """Three pixels of four, at random: many holes and a few lone pixels."""
    return uniform_field(1, 1, h, w, seed=7, dtype=torch.float32) < 0.75


# Masks as functions of height and width.
DISK, RING_AND_ISLANDS = _disk, _ring_and_islands
MASKS = {"disk": _disk, "ring_and_islands": _ring_and_islands, "sieve": _sieve}
