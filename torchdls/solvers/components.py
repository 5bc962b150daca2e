"""Connected components of the pixel grid, and the free constant that each component without an anchor has."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._tracing import only_shapes
from torchdls.operators import edge_ends, edge_slopes


class Gauge(NamedTuple):
    """The constants of the components of (*): free without an anchor, else given by the sum of their equations.

    Attributes:
        labels: (N, H * W) int64, the same number on all pixels of a component; (N, 0) where every surface is at most
            one free component and lone pixels, as most masks are.
        share: (N, H * W), 1 / size of the pixel's component, or 0 where an anchor fixes its height (and, without
            labels, on lone pixels); (N, 0) where anchors hold every pixel.
        pull: (N, H * W), what part of the anchor weight of its component a pixel has; (N, 0) where there are no labels
            or no anchors.
    """

    labels: Tensor
    share: Tensor
    pull: Tensor

    def remove(self, x: Tensor) -> Tensor:
        """Orthogonal projection of x (N, 1, H, W) on zero mean over each free component."""
        if self.share.shape[1] == 0:
            return x
        flat = x.flatten(1)
        if self.labels.shape[1] == 0:
            mean = torch.linalg.vecdot(flat, self.share)[:, None]
            return torch.where(self.share > 0, flat - mean, 0).view_as(x)
        return (flat - self.sums(flat) * self.share).view_as(x)

    def sums(self, x: Tensor) -> Tensor:
        """Sum of x (N, H * W) over the component of each pixel."""
        return torch.zeros_like(x).scatter_add(1, self.labels, x).gather(1, self.labels)

    def maxima(self, x: Tensor) -> Tensor:
        """Maximum of x (N, H * W), at least 0, over the component of each pixel."""
        return torch.zeros_like(x).scatter_reduce(1, self.labels, x, "amax").gather(1, self.labels)

    def greatest(self, x: Tensor) -> Tensor:
        """Maximum of x (N, 1, H, W), at least 0, over each component; over all, (N, 1, 1, 1), without labels."""
        if self.labels.shape[1]:
            return self.maxima(x.flatten(1)).view_as(x)
        return x.amax((1, 2, 3), keepdim=True)

    def mean(self, x: Tensor, weight: Tensor) -> Tensor:
        """Weighted mean of x (N, 1, H, W) over the component of each pixel; (N, 1, 1, 1), over all, without labels."""
        if self.labels.shape[1]:
            part, total = (self.sums(t.flatten(1).double()).view_as(x) for t in (x * weight, weight))
        else:
            part, total = (t.sum((-2, -1), keepdim=True, dtype=torch.double) for t in (x * weight, weight))
        some = total > 0
        return (torch.where(some, part, 0) / torch.where(some, total, 1)).to(x.dtype)

    @property
    def trust(self) -> Tensor:
        """(N, H * W), of sum 1 over every component with labels."""
        return self.share + self.pull if self.pull.shape[1] else self.share

    def balance(self, b: Tensor) -> Tensor:
        """Residuals b (N, 1, H, W) less what constants alone would take away: none is left in any component's sum."""
        if self.pull.shape[1] == 0:
            return self.remove(b)
        flat = b.flatten(1)
        return (flat - self.sums(flat) * self.trust).view_as(b)

    def settle(self, z: Tensor) -> Tensor:
        """Heights with mean 0 on every component, weighted by the anchors where there are some."""
        if self.pull.shape[1] == 0:
            return self.remove(z)
        flat = z.flatten(1)
        return (flat - self.sums(flat * self.trust)).view_as(z)

    def constants(self, force: Tensor, r: Tensor) -> Tensor:
        """Sum of the forces (N, 1, H, W) over the sum of the anchor weights r, on components that anchors hold."""
        if self.pull.shape[1] == 0:
            return torch.zeros_like(force)
        sums, held = (self.sums(t.flatten(1).double()) for t in (force, r))
        some = held > 0
        return torch.where(some, sums / torch.where(some, held, 1), 0).view_as(force).to(force.dtype)

    def select(self, surfaces: Tensor) -> Gauge:
        """Of some surfaces of the batch."""
        return Gauge(*(field[surfaces] for field in self))

    def double(self) -> Gauge:
        """In double precision."""
        count = torch.where(self.share > 0, (1 / torch.where(self.share > 0, self.share, 1)).round(), 1)
        share, pull = torch.where(self.share > 0, 1 / count.double(), 0), self.pull.double()
        if pull.shape[1]:
            total = self.sums(pull)
            pull = pull / torch.where(total > 0, total, 1)
        return Gauge(self.labels, share, pull)

    def pins(self) -> Tensor:
        """(N, H * W) bool, one pixel of every component; without labels, of the free one."""
        if self.labels.shape[1]:
            return self.labels == torch.arange(self.labels.shape[1], device=self.labels.device)
        free = self.share > 0
        return free & (free.cumsum(1) == 1)

    def correction(self) -> Callable[[Tensor], Tensor] | None:
        """`balance` for repeated use on fields that rounding took off, which may be overwritten; None for none."""
        if not bool(self.trust.any()):
            return None
        if self.labels.shape[1]:
            return self.balance
        inside = (self.share > 0).to(self.share.dtype)

        def correct(x: Tensor) -> Tensor:
            flat = x.flatten(1)
            return flat.addcmul_(inside, torch.linalg.vecdot(flat, self.share)[:, None], value=-1).view_as(x)

        return correct

    def deflation(self) -> Callable[[Tensor], Tensor] | None:
        """What makes a product with H blind to the constants that anchors hold; None where none do."""
        return self.balance if self.pull.shape[1] else None

    def embed(self, rows: slice, columns: slice, size: tuple[int, int]) -> Gauge:
        """Of a rectangle of H x W pixels, from that of a window of it outside of which nothing is alive."""
        whole = (len(self.share), size[0] * size[1])
        width = columns.stop - columns.start

        def put(field: Tensor, outside: Tensor) -> Tensor:
            if field.shape[1] in (0, whole[1]):
                return field
            out = outside.to(field).repeat(whole[0], 1).view(-1, *size)
            out[:, rows, columns] = field.view(-1, rows.stop - rows.start, width)
            return out.flatten(1)

        own = torch.arange(whole[1], device=self.labels.device)
        labels = (self.labels // width + rows.start) * size[1] + self.labels % width + columns.start
        zero = torch.zeros_like(own)
        return Gauge(put(labels, own), put(self.share, zero), put(self.pull, zero))

    def window(self, rows: slice, columns: slice, size: tuple[int, int]) -> Gauge:
        """The converse of `embed`."""

        def cut(field: Tensor) -> Tensor:
            return field.view(-1, *size)[:, rows, columns].flatten(1) if field.shape[1] else field

        labels = cut(self.labels)
        width = columns.stop - columns.start
        local = (labels // size[1] - rows.start) * width + labels % size[1] - columns.start
        return Gauge(local, cut(self.share), cut(self.pull))


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


def free_constants(w: Tensor, r: Tensor | None, least: float = 0.0) -> Gauge:
    """The gauge of (*) with edge weights w (N, 2, H, W) and anchor weights r (N, 1, H, W) or None.

    Where all anchor weights are above `least`, no constant needs care.
    """
    nothing = torch.empty_like(w[:, 0, :0, 0])
    if only_shapes(w):
        return Gauge(nothing.long(), nothing, nothing)
    if r is not None and bool(((r > least) | ((r == 0) & (edge_ends(w) == 0))).all()):  # as in every z-step of DLS
        return Gauge(nothing.long(), nothing, nothing)
    labels = connected_components(w > 0).flatten(1)
    ones = torch.ones_like(labels, dtype=w.dtype)
    size = torch.zeros_like(ones).scatter_add(1, labels, ones).gather(1, labels)
    if r is None or not bool(r.any()):
        several = size > 1
        first, last = torch.where(several, labels, labels.shape[1]).amin(1), torch.where(several, labels, 0).amax(1)
        if bool((first >= last).all()):
            return Gauge(nothing.long(), torch.where(several, 1 / size, 0), nothing)
        return Gauge(labels, 1 / size, nothing)
    flat = r.flatten(1)
    most = torch.zeros_like(ones).scatter_reduce(1, labels, flat, "amax").gather(1, labels)
    part = flat / torch.where(most > 0, most, 1)
    total = torch.zeros_like(ones).scatter_add(1, labels, part).gather(1, labels)
    held = most > 0
    return Gauge(labels, torch.where(held, 0, 1 / size), part / torch.where(held, total, 1))


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
