"""Connected components of the pixel grid, and the free constant that each component without an anchor has."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls.operators import edge_slopes


class Gauge(NamedTuple):
    """The null space of (*): one constant on every connected component that no anchor holds.

    Attributes:
        labels: (N, H * W) int64, the same number on all pixels of a component; (N, 0) where every surface is at most
            one free component and lone pixels, as most masks are.
        share: (N, H * W), 1 / size of the pixel's component, or 0 where an anchor fixes its height (and, without
            labels, on lone pixels); (N, 0) where anchors hold every pixel.
    """

    labels: Tensor
    share: Tensor

    def remove(self, x: Tensor) -> Tensor:
        """Orthogonal projection of x (N, 1, H, W) on zero mean over each free component."""
        if self.share.shape[1] == 0:
            return x
        flat = x.flatten(1)
        if self.labels.shape[1] == 0:
            mean = torch.linalg.vecdot(flat, self.share)[:, None]
            return torch.where(self.share > 0, flat - mean, 0).view_as(x)
        sums = torch.zeros_like(flat).scatter_add(1, self.labels, flat)
        return (flat - sums.gather(1, self.labels) * self.share).view_as(x)

    def select(self, surfaces: Tensor) -> Gauge:
        """Of some surfaces of the batch."""
        return Gauge(self.labels[surfaces], self.share[surfaces])

    def double(self) -> Gauge:
        """In double precision."""
        count = torch.where(self.share > 0, (1 / torch.where(self.share > 0, self.share, 1)).round(), 1)
        return Gauge(self.labels, torch.where(self.share > 0, 1 / count.double(), 0))

    def pins(self) -> Tensor:
        """(N, H * W) bool, one pixel of every free component."""
        free = self.share > 0
        if self.labels.shape[1]:
            return free & (self.labels == torch.arange(free.shape[1], device=free.device))
        return free & (free.cumsum(1) == 1)

    def correction(self) -> Callable[[Tensor], Tensor] | None:
        """The same for repeated use on fields that rounding alone took off, which may be overwritten; None for none."""
        if not bool(self.share.any()):
            return None
        if self.labels.shape[1]:
            return self.remove
        inside = (self.share > 0).to(self.share.dtype)

        def correct(x: Tensor) -> Tensor:
            flat = x.flatten(1)
            return flat.addcmul_(inside, torch.linalg.vecdot(flat, self.share)[:, None], value=-1).view_as(x)

        return correct


def connected_components(linked: Tensor) -> Tensor:
    """Label the components of the grid whose neighbours are joined by the edges of `linked`.

    Args:
        linked: (N, 2, H, W) bool; [:, 0, i, j] joins (i, j) to (i, j + 1), [:, 1, i, j] joins it to (i + 1, j).

    Returns:
        (N, H, W) int64: the smallest flat index in the component of each pixel.

    The labels start as the runs of each row; then every link between rows hooks the larger root under the smaller one
    and paths are halved, until nothing changes: a logarithmic number of sweeps in practice, on any device.
    """
    n, _, h, w = linked.shape
    index = torch.arange(h * w, device=linked.device).view(h, w).expand(n, h, w)
    starts = torch.ones_like(linked[:, 0])
    starts[..., 1:] = ~linked[:, 0, :, :-1]
    label = torch.where(starts, index, 0).cummax(-1).values.flatten(1)
    down = linked[:, 1, :-1].flatten(1)
    while True:
        above, below = label.view(n, h, w)[:, :-1].flatten(1), label.view(n, h, w)[:, 1:].flatten(1)
        low = torch.minimum(above, below)
        hooked = label.scatter_reduce(1, above, torch.where(down, low, above), "amin")
        hooked = hooked.scatter_reduce(1, below, torch.where(down, low, below), "amin")
        hooked = _roots(hooked)
        if torch.equal(hooked, label):
            return label.view(n, h, w)
        label = hooked


def _roots(parent: Tensor) -> Tensor:
    while not torch.equal(shorter := parent.gather(1, parent), parent):
        parent = shorter
    return parent


def free_constants(w: Tensor, r: Tensor | None) -> Gauge:
    """The gauge of (*) with edge weights w (N, 2, H, W) and anchor weights r (N, 1, H, W) or None."""
    nothing = torch.empty_like(w[:, 0, :0, 0])
    if r is not None and bool((r > 0).all()):  # as in every z-step of DLS on a full rectangle
        return Gauge(nothing.long(), nothing)
    labels = connected_components(w > 0).flatten(1)
    ones = torch.ones_like(labels, dtype=w.dtype)
    size = torch.zeros_like(ones).scatter_add(1, labels, ones).gather(1, labels)
    if r is None or not bool(r.any()):
        several = size > 1
        first, last = torch.where(several, labels, labels.shape[1]).amin(1), torch.where(several, labels, 0).amax(1)
        if bool((first >= last).all()):
            return Gauge(nothing.long(), torch.where(several, 1 / size, 0))
        return Gauge(labels, 1 / size)
    held = torch.zeros_like(ones).scatter_add(1, labels, (r > 0).to(w.dtype).flatten(1))
    return Gauge(labels, torch.where(held.gather(1, labels) > 0, 0, 1 / size))


def remove_free_constants(z: Tensor, mask: Tensor | None = None, r: Tensor | None = None) -> Tensor:
    """Give z zero mean on each connected component of the mask that no anchor holds.

    Args:
        z: (N, 1, H, W), 0 outside the mask.
        mask: (N, 1, H, W) bool, or None for full rectangles.
        r: anchor weights (N, 1, H, W) or (N, 1, 1, 1), or None for no anchor.
    """
    if mask is None:
        free = z.mean((-2, -1), keepdim=True)
        return z - (free if r is None else torch.where((r > 0).any(-1, keepdim=True).any(-2, keepdim=True), 0, free))
    _, linked = edge_slopes(mask.to(z.dtype).expand(-1, 2, -1, -1), mask)
    assert linked is not None
    return free_constants(linked, None if r is None else r.expand(mask.shape)).remove(z)
