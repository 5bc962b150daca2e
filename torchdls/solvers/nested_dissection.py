r"""Direct solution of H z = b, H = A^T diag(w) A + diag(r), on any mask: nested dissection in batched dense blocks.

The rectangle is halved along its longer side again and again; the line of pixels between two halves is the separator
that the node of this tree owns, down to blocks of a few pixels. Pixels are eliminated from the leaves up. A node with
own pixels E and border B (the pixels outside its rectangle that touch it) sees a dense front of weights c_ij between
its pixels, and c_i0 to the ground, the anchor. As a star of resistors becomes a mesh, a pixel p goes by

        s_p = c_p0 + sum_j c_pj        l_pj = c_pj / s_p        c_ij <- c_ij + c_pi l_pj        c_i0 <- c_i0 + c_pi l_p0

over the pixels i, j that are left: sums of positive numbers, so that every number of the factor is right to some units
in the last place however far the weights are apart (the diagonal of H would have rounded the weak ones away). With
T = (1 - l_EE)^{-1}, D = diag(s) and G = T l_EB, which are positive too,

        x_E = T D^{-1} T^T b_E + G x_B        b_B <- b_B + G^T b_E

Nodes of one level and of similar size are worked on together. The order of elimination depends on the mask alone and is
kept for the next matrix on it. A batch of surfaces is a forest: nothing crosses from one to the other.

The work grows as n^1.5, the memory as n log n: 375 MB for 1024^2 pixels. All of it runs in float64.

Source: George, "Nested dissection of a regular finite element mesh", 1973; Duff, Reid, "The multifrontal solution of
indefinite sparse symmetric linear systems", 1983; Grassmann, Taksar, Heyman, "Regenerative analysis and steady state
distributions for Markov chains", 1985, for elimination without differences.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchdls._caches import STORE
from torchdls.operators import edge_ends

_LEAF = 5  # longest side of a block that is not halved again
_AT_ONCE = 2**18  # numbers of the fronts that are worked on together: they stay in the cache
_AT_A_TIME = 16  # pivots that are eliminated one by one


class Child(NamedTuple):
    """Nodes of the level below that hand their U to nodes of this front.

    Attributes:
        front: which front of the level below.
        rows: (k,) their rows in it.
        parents: (k,) the rows of their parents in this front.
        places: (k, F) where each pixel of the parent stands in the child's border; m, beyond the last, for nowhere.
    """

    front: int
    rows: Tensor
    parents: Tensor
    places: Tensor


class Front(NamedTuple):
    """Nodes of one level that are worked on together; pixels are numbered through the batch, n stands for none.

    Attributes:
        own: (k, e) pixels that are eliminated here.
        border: (k, m) pixels that are left to the parents.
        idle: places in the flat (k, F, F) fronts, F = e + m, of pivots that stand for no pixel.
        diagonal: places of the others, and their pixels.
        edges: places of the edges that enter here, and their numbers in the flat (N, 2, H, W).
        children: what comes up from the level below.
    """

    own: Tensor
    border: Tensor
    idle: Tensor
    diagonal: tuple[Tensor, Tensor]
    edges: tuple[Tensor, Tensor]
    children: tuple[Child, ...]


Levels = tuple[tuple[Front, ...], ...]  # the leaves first


class Factor(NamedTuple):
    """The factored matrix: T, D and G of every node."""

    levels: Levels
    blocks: list[list[tuple[Tensor, Tensor, Tensor]]]

    def solve(self, b: Tensor) -> Tensor:
        """H^{-1} b (N, 1, H, W), in the dtype of b; 0 on pixels that are not alive."""
        x = torch.cat([b.flatten().double(), b.new_zeros(1, dtype=torch.float64)])
        inner = []
        for fronts, blocks in zip(self.levels, self.blocks, strict=True):
            for front, (T, D, G) in zip(fronts, blocks, strict=True):
                right = x[front.own][..., None]
                inner.append((front, G, T @ ((T.mT @ right) / D)))
                x.index_add_(0, front.border.flatten(), (G.mT @ right).flatten())
            x[-1] = 0
        z = torch.zeros_like(x)
        for front, G, own in reversed(inner):
            z[front.own.flatten()] = (own + G @ z[front.border][..., None]).flatten()
            z[-1] = 0
        return z[:-1].view(b.shape).to(b.dtype)


def factor(w: Tensor, r: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Factor:
    """Factor H = A^T diag(w) A + diag(r), positive definite on the pixels that have an edge or an anchor.

    Args:
        w: (N, 2, H, W) edge weights, at least 0.
        r: (N, 1, H, W) anchor weights, at least 0, with one that is positive on every connected component.
        pixel_size: (dx, dy).
    """
    steps = torch.tensor(pixel_size, dtype=torch.float64, device=w.device).view(1, 2, 1, 1)
    w, r = w.double() / steps.square(), r.double()
    levels = elimination((edge_ends(w) + r > 0)[:, 0])
    edges, ground = w.flatten(), r.flatten()
    blocks: list[list[tuple[Tensor, Tensor, Tensor]]] = []
    below: list[Tensor] = []
    for fronts in levels:
        here, up = [], []
        for front in fronts:
            T, D, G, U = _eliminate(_assemble(front, below, edges, ground), front.own.shape[1])
            here.append((T, D, G))
            up.append(U)
        blocks.append(here)
        below = up
    return Factor(levels, blocks)


def _assemble(front: Front, below: list[Tensor], edges: Tensor, ground: Tensor) -> Tensor:
    """(k, F, F): what the children hand up, and the weights of edges and anchors that enter here."""
    k, side = len(front.own), front.own.shape[1] + front.border.shape[1]
    C = edges.new_zeros(k, side, side)
    for child in front.children:
        U = pad(below[child.front][child.rows], (0, 1, 0, 1))
        count, m = U.shape[:2]
        rows = (child.places + m * torch.arange(count, device=U.device)[:, None]).flatten()
        # U is symmetric: its rows are chosen, and after a transposition its columns.
        half = U.reshape(count * m, m).index_select(0, rows).view(count, side, m).mT.reshape(count * m, side)
        C.index_add_(0, child.parents, half.index_select(0, rows).view(count, side, side))
    flat = C.view(-1)
    flat[front.idle] = 1
    flat.index_add_(0, front.diagonal[0], ground[front.diagonal[1]])
    flat.index_add_(0, front.edges[0], edges[front.edges[1]])
    return C


def _eliminate(C: Tensor, e: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """T, D, G and U of the fronts (k, F, F), whose first e pixels go."""
    ground = C.diagonal(dim1=1, dim2=2)
    L, total = C.new_empty(len(C), e, C.shape[1] + 1), C.new_empty(len(C), e, 1)
    L[..., :-1], L[..., -1] = C[:, :e], ground[:, :e]
    _pivots(L, total, 0, e)
    inner, border, held = L[..., :e].triu(1), L[..., e:-1], L[..., -1:]
    T = torch.eye(e, dtype=L.dtype, device=L.device).expand_as(inner)
    T = torch.linalg.solve_triangular(inner.neg_(), T, upper=True, unitriangular=True)
    up = torch.baddbmm(C[:, e:, e:], border.mT, total * border)
    up.diagonal(dim1=1, dim2=2).copy_(ground[:, e:] + (border.mT @ (total * held))[..., 0])
    return T, total, T @ border, up


def _pivots(L: Tensor, total: Tensor, first: int, last: int) -> None:
    """Eliminate rows first to last of L, (k, e, F + 1): what a pixel weighs to those after it, and to the ground.

    They are left divided by their sums, the pivots `total`. Halves are joined by products of matrices.
    """
    if last - first > _AT_A_TIME:
        middle = (first + last) // 2
        _pivots(L, total, first, middle)
        done = L[:, first:middle, middle:]
        L[:, middle:last, middle:].baddbmm_(done[..., : last - middle].mT, total[:, first:middle] * done)
        _pivots(L, total, middle, last)
        return
    for p in range(first, last):
        row, near = L[:, p, p + 1 :], L[:, p, p + 1 : last, None].clone()
        total[:, p] = row.sum(-1, keepdim=True).clamp(min=torch.finfo(L.dtype).tiny)
        row.div_(total[:, p])
        L[:, p + 1 : last, p + 1 :].addcmul_(near, row[:, None])


def elimination(alive: Tensor) -> Levels:
    """The order of elimination of the pixels (N, H, W) that are alive; the last few masks are remembered."""
    key = np.packbits(alive.cpu().numpy()).tobytes(), tuple(alive.shape), alive.device
    found: Levels = STORE.find((elimination, *key), lambda: _elimination(*key))
    return found


def _elimination(bits: bytes, shape: tuple[int, ...], device: torch.device) -> Levels:
    count = shape[0] * shape[1] * shape[2]
    flat = np.unpackbits(np.frombuffer(bits, np.uint8), count=count).astype(bool)
    return _Dissection(torch.from_numpy(flat).to(device).view(shape)).levels()


class _Dissection:
    """The tree of rectangles of a batch of masks, and what its nodes own, border on and hand up."""

    def __init__(self, alive: Tensor) -> None:
        self.alive = alive
        self.shape = alive.shape
        self.n = alive.numel()
        self.known = torch.cat([alive.flatten(), alive.new_zeros(1)])
        self.trees = self._halve()
        self.nodes = [(*self._own(*tree), *self._border(tree[0])) for tree in self.trees]
        n = self.n + 1
        self.level, self.node, self.place = (torch.full((n,), -1, device=alive.device) for _ in range(3))
        for level, (own, *_) in enumerate(self.nodes):
            node, place = (own < self.n).nonzero(as_tuple=True)
            pixel = own[node, place]
            self.level[pixel], self.node[pixel], self.place[pixel] = level, node, place
        self.first, self.second, self.edge = self._edges()

    def levels(self) -> Levels:
        """The fronts of every level, from the leaves up."""
        found: list[tuple[Front, ...]] = []
        places = (torch.empty(0, dtype=torch.int64),) * 2  # of every node of a level: its front, and its row there
        for level in reversed(range(len(self.nodes))):
            own, owned, border, bordering = self.nodes[level]
            groups = _groups(owned, bordering)
            below, places = places, self._rows(groups, len(own))
            pixels = [(own[g, : int(owned[g].max())], border[g, : int(bordering[g].max())]) for g in groups]
            edges = self._places_of_edges(level, border, pixels, *places)
            last = found[-1] if found else ()
            children = [self._children(g, *pair, *below, last) for g, pair in zip(groups, pixels, strict=True)]
            found.append(tuple(map(self._front, pixels, edges, children)))
        return tuple(found)

    def _rows(self, groups: list[Tensor], count: int) -> tuple[Tensor, Tensor]:
        group, row = (torch.full((count,), -1, device=self.alive.device) for _ in range(2))
        for i, nodes in enumerate(groups):
            group[nodes], row[nodes] = i, torch.arange(len(nodes), device=row.device)
        return group, row

    def _halve(self) -> list[tuple[Tensor, int | None, Tensor | None]]:
        """Rectangles (k, 5) of every level as (surface, top, bottom, left, right), and where they are cut next."""
        n, h, w = self.shape
        start = torch.zeros(n, 5, dtype=torch.int64, device=self.alive.device)
        start[:, 0], start[:, 2], start[:, 4] = torch.arange(n, device=start.device), h, w
        trees, rects, sides = [], start, [h, w]
        while max(sides) > _LEAF:
            axis = 0 if sides[0] >= sides[1] else 1
            low, high = 1 + 2 * axis, 2 + 2 * axis
            middle = (rects[:, low] + rects[:, high]) // 2
            trees.append((rects, axis, middle))
            before, after = rects.clone(), rects.clone()
            before[:, high], after[:, low] = middle, middle + 1
            rects = torch.stack([before, after], 1).flatten(0, 1)  # the children of node j are 2 j and 2 j + 1
            sides[axis] //= 2
        return [*trees, (rects, None, None)]

    def _number(self, surface: Tensor, y: Tensor, x: Tensor, ok: Tensor) -> Tensor:
        _, h, w = self.shape
        return torch.where(ok, (surface * h + y) * w + x, self.n)

    def _own(self, rects: Tensor, axis: int | None, middle: Tensor | None) -> tuple[Tensor, Tensor]:
        """Pixels that each node eliminates (k, e), and their number."""
        surface, top, bottom, left, right = (c[:, None] for c in rects.unbind(1))
        tall, wide = int((bottom - top).max()), int((right - left).max())
        if middle is None:
            i = torch.arange(max(tall * wide, 1), device=rects.device)
            y, x = top + i // max(wide, 1), left + i % max(wide, 1)
        elif axis == 0:
            y, x = middle[:, None], left + torch.arange(wide, device=rects.device)
        else:
            y, x = top + torch.arange(tall, device=rects.device), middle[:, None]
        pixel = self._number(surface, y, x, (y < bottom) & (x < right))
        return _pack(pixel, self.known[pixel], self.n)

    def _border(self, rects: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels outside the rectangle of each node that touch a live one inside (k, m), and their number."""
        surface, top, bottom, left, right = (c[:, None] for c in rects.unbind(1))
        _, h, w = self.shape
        x = left + torch.arange(max(int((right - left).max()), 0), device=rects.device)
        y = top + torch.arange(max(int((bottom - top).max()), 0), device=rects.device)
        some = (bottom > top) & (right > left)
        in_x, in_y = (x < right) & some, (y < bottom) & some
        outside, inside = [], []
        for line, ok, within in ((top - 1, in_x & (top > 0), top), (bottom, in_x & (bottom < h), bottom - 1)):
            outside.append(self._number(surface, line, x, ok))
            inside.append(self._number(surface, within, x, ok))
        for line, ok, within in ((left - 1, in_y & (left > 0), left), (right, in_y & (right < w), right - 1)):
            outside.append(self._number(surface, y, line, ok))
            inside.append(self._number(surface, y, within, ok))
        pixel, touched = torch.cat(outside, 1), torch.cat(inside, 1)
        return _pack(pixel, self.known[pixel] & self.known[touched], self.n)

    def _edges(self) -> tuple[Tensor, Tensor, Tensor]:
        """The live edges: the end that goes first, the other one, and the number of the edge in (N, 2, H, W)."""
        n, h, w = self.shape
        pixel = torch.arange(self.n, device=self.alive.device).view(n, h, w)
        across, down = self.alive[..., 1:] & self.alive[..., :-1], self.alive[:, 1:] & self.alive[:, :-1]
        p = torch.cat([pixel[..., :-1][across], pixel[:, :-1][down]])
        q = torch.cat([pixel[..., 1:][across], pixel[:, 1:][down]])
        number = p + p // (h * w) * h * w
        number[int(across.sum()) :] += h * w
        later = self.level[q] > self.level[p]  # deeper levels go first
        return torch.where(later, q, p), torch.where(later, p, q), number

    def _places_of_edges(
        self, level: int, border: Tensor, pixels: list[tuple[Tensor, Tensor]], group: Tensor, row: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """For each front of a level: flat places of the edges that enter there, both ways within E, and their numbers.

        An edge to the border needs the upper right block alone, which stands for both.
        """
        mine = self.level[self.first] == level
        first, second, edge = self.first[mine], self.second[mine], self.edge[mine]
        node = self.node[first]
        own = self.level[second] == level
        there = _find(node, second, border, self.n)
        members = group[node].argsort(stable=True).split(torch.bincount(group[node], minlength=len(pixels)).tolist())
        places = []
        for (E, B), here in zip(pixels, members, strict=True):
            side, e = E.shape[1] + B.shape[1], E.shape[1]
            a = self.place[first[here]]
            b = torch.where(own[here], self.place[second[here]], e + there[here])
            corner, inner = row[node[here]] * side * side, own[here]
            flat = torch.cat([corner + a * side + b, (corner + b * side + a)[inner]])
            places.append((flat, torch.cat([edge[here], edge[here][inner]])))
        return places

    def _front(self, pixels: tuple[Tensor, Tensor], edges: tuple[Tensor, Tensor], children: tuple[Child, ...]) -> Front:
        own, border = pixels
        side = own.shape[1] + border.shape[1]

        def places(where: Tensor) -> Tensor:
            node, place = where.nonzero(as_tuple=True)
            return node * side * side + place * (side + 1)

        there = own < self.n
        return Front(own, border, places(~there), (places(there), own[there]), edges, children)

    def _children(
        self, nodes: Tensor, own: Tensor, border: Tensor, group: Tensor, row: Tensor, fronts: tuple[Front, ...]
    ) -> tuple[Child, ...]:
        """What the children of some nodes, all in one front, hand up."""
        if not fronts:
            return ()
        pixels, found = torch.cat([own, border], 1), []
        for child in (2 * nodes, 2 * nodes + 1):
            for front in group[child].unique().tolist():
                if front < 0 or fronts[front].border.shape[1] == 0:
                    continue
                parents = (group[child] == front).nonzero()[:, 0]
                rows = row[child[parents]]
                asked, count = pixels[parents], torch.arange(len(parents), device=rows.device)
                places = _find(count[:, None].expand_as(asked), asked, fronts[front].border[rows], self.n)
                found.append(Child(front, rows, parents, places))
        return tuple(found)


def _pack(pixel: Tensor, keep: Tensor, none: int) -> tuple[Tensor, Tensor]:
    """The pixels of each row that are kept, moved to its front, and their number."""
    order = (~keep).to(torch.uint8).argsort(dim=1, stable=True)
    count = keep.sum(1)
    return torch.where(keep, pixel, none).gather(1, order)[:, : int(count.max())], count


def _find(row: Tensor, wanted: Tensor, among: Tensor, none: int) -> Tensor:
    """Where the pixels wanted stand in the given rows of `among` (k, m); m where a pixel is not there, or none."""
    m = among.shape[1]
    if m == 0:
        return torch.zeros_like(wanted)
    span = none + 2
    keys, order = (torch.arange(len(among), device=row.device)[:, None] * span + among).flatten().sort()
    asked = row * span + torch.where(wanted == none, none + 1, wanted)
    at = torch.searchsorted(keys, asked.contiguous()).clamp(max=len(keys) - 1)
    return torch.where(keys[at] == asked, order[at] % m, m)


def _groups(owned: Tensor, bordering: Tensor) -> list[Tensor]:
    """Nodes of similar size, in parts that fit the cache; empty ones are left out.

    A part holds neighbours in the tree, so that its children lie together as well.
    """
    used = ((owned > 0) | (bordering > 0)).nonzero()[:, 0]
    order = used[(bordering[used] * 2**20 + owned[used]).argsort(descending=True, stable=True)]
    e, m = owned[order].tolist(), bordering[order].tolist()
    groups: list[Tensor] = []
    i = 0
    while i < len(e):
        j, most, least = i, e[i], e[i]
        while j < len(e) and m[j] >= 0.75 * m[i] and min(least, e[j]) >= 0.6 * max(most, e[j]):
            most, least = max(most, e[j]), min(least, e[j])
            j += 1
        parts = -(-(j - i) * (m[i] + most) ** 2 // _AT_ONCE)
        groups += order[i:j].sort().values.tensor_split(min(parts, j - i))
        i = j
    return groups
