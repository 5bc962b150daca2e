"""The lightest edges that still join all pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._tracing import has_values
from torchdls.solvers.components import connected_components
from torchdls.solvers.folding import choose_per_surface


def spanning_forest(cost: Tensor, tie: Tensor, live: Tensor) -> Tensor:
    """A minimum spanning tree of each connected component of the grid.

    Every component takes its lightest edge that leads out of it (Boruvka), until none leads out of any: a logarithmic
    number of rounds, for the whole batch and on any device.

    Args:
        cost: (N, 2, H, W) of each edge.
        tie: (N, 2, H, W), what decides between edges of equal cost; after that, their place.
        live: (N, 2, H, W) bool, the edges that exist.

    Returns:
        (N, 2, H, W) bool, the edges of the trees.
    """
    if not has_values(live):  # shapes alone choose nothing
        return torch.zeros_like(live)
    return choose_per_surface(_boruvka, cost, tie, live)[0]


def _boruvka(cost: Tensor, tie: Tensor, live: Tensor) -> tuple[Tensor]:
    kept = torch.zeros_like(live)
    if not bool(live.any()):
        return (kept,)
    n, _, h, w = live.shape
    order = tie.flatten(1).argsort(dim=1, stable=True)
    order = order.gather(1, cost.flatten(1).gather(1, order).argsort(dim=1, stable=True))
    rank = order.argsort(1).view_as(live)
    while True:
        label = connected_components(kept)
        here = label[:, None].expand(n, 2, h, w)
        there = torch.stack([label.roll(-1, 2), label.roll(-1, 1)], 1)
        leaving = live & (here != there)
        if not bool(leaving.any()):
            return (kept,)
        price = torch.where(leaving, rank, rank.shape[1:].numel()).flatten(1)
        ends = here.flatten(1), there.flatten(1)
        least = torch.full_like(label.flatten(1), rank.shape[1:].numel())
        for end in ends:
            least = least.scatter_reduce(1, end, price, "amin")
        lightest = (price == least.gather(1, ends[0])) | (price == least.gather(1, ends[1]))
        kept = kept | (leaving & lightest.view_as(live))
