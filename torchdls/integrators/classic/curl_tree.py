"""The tree of the most integrable edges, which selective methods build on."""

from __future__ import annotations

from math import hypot
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls.integrators.fields import Fields
from torchdls.operators import edge_slopes
from torchdls.operators.edges import beside_edges, cell_curl, complete_cells, present_edges
from torchdls.solvers.spanning_forest import spanning_forest


class CurlTree(NamedTuple):
    """Edges, their curl and the spanning trees of least curl.

    Attributes:
        v: (N, 2, H, W) slopes of the edges.
        w: (N, 2, H, W) trusts, 0 where there is no edge.
        tree: (N, 2, H, W) bool, a minimum spanning tree of each component by the mean |curl| beside an edge.
        curl: (N, H - 1, W - 1) of the cells.
        noise: (N, 1, 1) robust standard deviation of the curl.
        sigma: (N, 1, 1, 1) standard deviation of a slope that this stands for.
    """

    v: Tensor
    w: Tensor
    tree: Tensor
    curl: Tensor
    noise: Tensor
    sigma: Tensor

    @classmethod
    def of(cls, fields: Fields) -> CurlTree:
        """That of checked fields; only v and w have a derivative."""
        v, w = edge_slopes(fields.gradient, fields.mask, fields.weight)
        w = present_edges(v) if w is None else w.expand_as(v)
        live = w > 0
        curl, cells = cell_curl(v.detach(), fields.steps), complete_cells(live)
        total = beside_edges(torch.where(cells, curl.abs(), 0))
        cost = total / beside_edges(cells.to(v.dtype)).clamp(min=1)
        noise = masked_median(curl.abs().flatten(1), cells.flatten(1))[:, None, None] / NORMAL_MEDIAN
        sigma = noise[:, None] / hypot(*fields.steps)
        return cls(v, w, spanning_forest(cost, v.detach().abs(), live), curl, noise, sigma)
