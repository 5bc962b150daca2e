"""What a surface falls into once its jumps are cut."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls.integrators.piecewise.prior import continued
from torchdls.solvers import connected_components

_NARROW = 8  # edges by which a contour is continued at either end, where it may


def pieces_of(cut: Tensor, likely: Tensor, live: Tensor, inside: Tensor) -> Tensor:
    """(N, 1, H, W) int64: 1 for the largest piece, 2 for the next, ..; 0 outside the mask.

    Where a jump changes its sign along a contour it is small, and its edges look whole. So contours are continued by up
    to 8 edges at either end along those that may be cut, and gaps of one edge are closed: what hangs together by a
    narrower tie than 16 edges on a contour counts as apart.

    Args:
        cut: (N, 2, H, W) bool.
        likely: (N, 2, H, W) bool, whether an edge may be cut.
        live: (N, 2, H, W) bool, whether there is an edge.
        inside: (N, 1, H, W) bool.
    """
    for _ in range(_NARROW):
        cut = cut | (likely & live & (continued(cut.to(torch.float64), live) >= 1))
    around = continued(cut.to(torch.float64), live)
    joined = live & ~cut & (around < 2)
    labels = connected_components(joined).flatten(1)
    flat = inside.flatten(1)
    sizes = torch.zeros_like(labels).scatter_add(1, labels, flat.to(labels.dtype))
    order = (-sizes).argsort(dim=1, stable=True)
    rank = torch.empty_like(order).scatter(1, order, torch.arange(order.shape[1], device=order.device).expand_as(order))
    return torch.where(flat, 1 + rank.gather(1, labels), 0).view_as(inside)


def tied_pieces(pieces: Tensor, live: Tensor, anchored: Tensor) -> Tensor:
    """(N, K) bool, K pieces: whether the height of piece k + 1 is told.

    By an anchor, or by being the largest of its component of the mask when that has no anchor, and so is free anyway.

    Args:
        pieces: as `pieces_of` gives them.
        live: (N, 2, H, W) bool, whether there is an edge.
        anchored: (N, 1, H, W) bool, pixels with an anchor.
    """
    flat, whole = pieces.flatten(1), connected_components(live).flatten(1)
    count = int(flat.max())
    held = torch.zeros(len(flat), count + 1, dtype=torch.bool, device=flat.device)
    held.scatter_(1, torch.where(anchored.flatten(1), flat, 0), True)
    first = torch.full_like(whole, count + 1).scatter_reduce(1, whole, torch.where(flat > 0, flat, count + 1), "amin")
    some = torch.zeros_like(whole).scatter_add(1, whole, anchored.flatten(1).to(whole.dtype)) > 0
    free = torch.where(some, 0, first)  # the largest piece of every component without an anchor
    held = torch.cat([held, held[:, :1]], 1).scatter(1, free, True)
    return held[:, 1 : count + 1]
