"""One sweep of SOUP-DIL: sparse codes by hard thresholding and unit-norm atoms, one sum of outer products at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls import _compiled
from torchdls._checks import check_alike, check_real
from torchdls._precision import full_precision
from torchdls._tracing import is_recorded
from torchdls.dictionary import sweep_chunks, sweep_fused, sweep_rows
from torchdls.dictionary.thresholds import THRESHOLDS, Threshold, cut, shrink

Order = Literal["atom", "block"]
Unused = Literal["first", "keep"]

# Atoms that share one product with the residual; inside such a group they are corrected for each other one by one.
_GROUP = 16

# Patches that the block order takes at once of a whole batch, and the fewest of one surface: long enough that the loop
# over the atoms costs little, short enough that its temporaries do. From the fewest on, surfaces are swept one by one.
_CHUNK, _SHORTEST = 65536, 4096


@full_precision
def soup_dil_sweep(
    P: Tensor,
    D: Tensor,
    B: Tensor,
    mu: float | Tensor,
    bound: float = math.inf,
    order: Order = "atom",
    *,
    unused: Unused = "first",
    learn: bool = True,
    threshold: Threshold = "hard",
) -> tuple[Tensor, Tensor]:
    r"""One pass of block coordinate descent over all rows of B and all atoms of D.

        min over D, B of  ||P - D B||_F^2 + mu^2 ||B||_0   subject to  ||d_i|| = 1, |b_ji| <= bound

    With E_i = P - sum_{k != i} d_k b_k, the minimisers for one row and for one atom are

        x = d_i^T E_i;   b_i = x where |x| > mu (strictly), else 0, then clipped to [-bound, bound]
        h = E_i b_i^T;   d_i = h / ||h||,  and for b_i = 0: see `unused`

    "atom" does this in the order of the paper, atom i right after row i. "block" updates all rows of B with D held
    fixed, and then all atoms with B held fixed. Neither order ever raises the objective. Differentiable, with the
    support of B frozen.

    Args:
        P: (N, n, L) patches.
        D: (N, n, K) one dictionary per surface, or (1, n, K) one for the whole batch, learned from all its patches.
        B: (N, K, L) codes to start from.
        mu: threshold, at least 0: a number, or a tensor that broadcasts to (N, K): (N, 1) per surface, (K,) per atom.
        bound: the bound a on the codes.
        order: "atom" or "block".
        unused: an atom whose row of codes is zero becomes the first unit vector e_1 ("first", as in the paper's
            reference), or stays as it is ("keep"). Both leave the objective unchanged.
        learn: False keeps D fixed and updates the codes alone.
        threshold: "hard" as above; "soft" or "firm" replace mu^2 ||B||_0 by the penalties of
            `torchdls.dictionary.thresholds`, which have a derivative in mu.

    Returns:
        D and B after the sweep; the arguments are not written to.

    Raises:
        TypeError: P is not float32 or float64, D or B of another dtype, or a tensor mu not of floats.
        ValueError: shapes do not fit, an option is unknown, the bound is not positive, or a number mu is negative.
        TypeError: P, D and B are not tensors of one dtype, float32 or float64.

    Source: Ravishankar, Nadakuditi, Fessler, "Efficient sum of outer products dictionary learning (SOUP-DIL)", 2015.

    Example:
        >>> P, D = torch.diag(torch.tensor([3.0, 0.2]))[None], torch.eye(2)[None]
        >>> D, B = torchdls.soup_dil_sweep(P, D, torch.zeros(1, 2, 2), mu=0.5, unused="keep")
        >>> B  # codes of magnitude below mu are 0
        tensor([[[3., 0.],
                 [0., 0.]]])
    """
    _check(P, D, B, order, unused, threshold)
    _check_levels(mu, bound, B)
    rule = _Rule(mu, bound, threshold, unused)
    return _swept(P, D, B, rule, order, learn, patches=True)[1:]


@full_precision
def residual_sweep(
    R: Tensor,
    D: Tensor,
    B: Tensor,
    mu: float | Tensor,
    bound: float = math.inf,
    order: Order = "atom",
    *,
    unused: Unused = "first",
    learn: bool = True,
    threshold: Threshold = "hard",
    project: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`soup_dil_sweep` for a caller who keeps the residual R = P - D B (N, n, L) instead of the patches.

    It is fastest where each patch of R is contiguous, as `Patches.extract` has it. `project` brings an atom h (N, n, 1)
    into the set that atoms are chosen from, before it is normalised.

    Returns:
        R, D and B after the sweep. Where no derivative is recorded, R and B are overwritten: no second copy is made.
    """
    return _swept(R, D, B, _Rule(mu, bound, threshold, unused, project), order, learn, patches=False)


def _swept(
    R: Tensor, D: Tensor, B: Tensor, rule: _Rule, order: Order, learn: bool, patches: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """The sweep by whoever does it fastest; with `patches`, R is P, and neither it nor B is written to."""
    mu, by_atom = rule.mu, order == "atom" and learn
    in_place = not is_recorded(R, D, B, *([mu] if isinstance(mu, Tensor) else []))
    if in_place and rule.project is None and _compiled.serves(R):
        options = {"keep": rule.unused == "keep", "atom_order": by_atom, "learn": learn, "patches": patches}
        return sweep_fused.sweep(R, D, B, rule.cuts(B), rule.bound, rule.threshold, **options)
    rule = rule._replace(levels=_levels(mu, B, in_place), in_place=in_place)
    alone = in_place and _is_alone(R, D, learn, by_atom)
    if patches:
        B = B.clone(memory_format=torch.contiguous_format) if in_place else B  # each row contiguous, as rows are read
        if by_atom or not alone:
            # Each patch contiguous in memory, whatever the layout of P (`unfold` puts its pixels far apart).
            R = torch.baddbmm(R.mT, B.mT, D.mT.expand(R.shape[0], -1, -1), alpha=-1).mT
    if not alone:
        return _atom_order(R, D, B, rule) if by_atom else _block_order(R, D, B, rule, learn)
    dictionaries = []
    for i in range(R.shape[0]):
        own, one = (R[i : i + 1], D[i : i + 1] if len(D) > 1 else D, B[i : i + 1]), rule.of_surface(i)
        found = _atom_order_alone(*own, one) if by_atom else _block_order_alone(*own, one, learn, patches)
        dictionaries.append(found)
    return R, torch.cat(dictionaries) if learn else D, B


def _is_alone(R: Tensor, D: Tensor, learn: bool, by_atom: bool) -> bool:
    """Whether surfaces are better swept one by one: each has thresholds that are numbers, and zeros to be skipped."""
    several, short = R.shape[0] > 1, R.shape[-1] < _SHORTEST
    return not (short and (several or by_atom)) and not (several and learn and D.shape[0] == 1)


def _block_order_alone(R: Tensor, D: Tensor, B: Tensor, rule: _Rule, learn: bool, patches: bool) -> Tensor:
    """`_block_order` of one surface, in place; returns the dictionary."""
    H, C = sweep_chunks.update_codes(R[0], D[0], B[0], rule.of_numbers(), patches)
    if not learn:
        return D
    new = _update_atoms(H[None], C[None], D, rule)
    if not patches:
        R.mT.baddbmm_(B.mT, (D - new).mT)
    return new


def _atom_order_alone(R: Tensor, D: Tensor, B: Tensor, rule: _Rule) -> Tensor:
    """`_atom_order` of one surface, in place; returns the dictionary."""

    def atom(h: Tensor, d: Tensor) -> Tensor:
        return _where_used(rule.unit(h[None, :, None]), d[None, :, None], rule.unused)[0, :, 0]

    patches, codes = R[0].mT.contiguous(), B[0].contiguous()
    new = sweep_rows.update_rows(patches, D[0], codes, rule.of_numbers(), atom)
    for given, found in ((R[0].mT, patches), (B[0], codes)):
        if given.data_ptr() != found.data_ptr():
            given.copy_(found)
    return new[None]


class _Rule(NamedTuple):
    """How codes are shrunk and atoms normalised; `in_place` where nothing is recorded, `levels` are those of mu."""

    mu: float | Tensor
    bound: float
    threshold: Threshold
    unused: Unused
    project: Callable[[Tensor], Tensor] | None = None
    levels: Sequence[float | Tensor] = ()
    in_place: bool = False

    def cuts(self, B: Tensor) -> Tensor:
        """(N or 1, K), up to where each code is cut."""
        mu = torch.as_tensor(self.mu, dtype=B.dtype, device=B.device)
        mu = mu if mu.ndim == 2 else mu.reshape(1, -1)
        found = cut(mu, self.bound) if self.threshold == "hard" else mu
        assert isinstance(found, Tensor)
        return found.expand(-1, B.shape[1])

    def unit(self, h: Tensor) -> Tensor:
        return _normalize(h if self.project is None else self.project(h))

    def of_surface(self, i: int) -> _Rule:
        """The rule for one surface of the batch, whose thresholds are numbers."""
        levels = [m if isinstance(m, float) else float(m[i if len(m) > 1 else 0]) for m in self.levels]
        return self._replace(levels=levels)

    def of_numbers(self) -> sweep_chunks.Shrinkage:
        """The same of one surface, whose thresholds are numbers."""
        return sweep_chunks.Shrinkage([float(m) for m in self.levels], self.bound, self.threshold)

    def shrink(self, x: Tensor, atom: int) -> Tensor:
        return shrink(x, self.levels[atom], self.bound, self.threshold)

    def add_product(self, x: Tensor, a: Tensor, b: Tensor, sign: int = 1) -> Tensor:
        """X + sign a b, written to x where nothing is recorded."""
        a = a.expand(x.shape[0], -1, -1)
        return x.baddbmm_(a, b, alpha=sign) if self.in_place else torch.baddbmm(x, a, b, alpha=sign)

    def join(self, pieces: list[Tensor], dim: int, into: Tensor) -> Tensor:
        """The pieces of `into`, put together again; they are already there where nothing is recorded."""
        return into if self.in_place else torch.cat(pieces, dim)


def _block_order(R: Tensor, D: Tensor, B: Tensor, rule: _Rule, learn: bool) -> tuple[Tensor, Tensor, Tensor]:
    """All codes with D held fixed, then all atoms with B held fixed.

    The codes of a patch do not depend on other patches, so they are updated chunk by chunk; what the atoms need of
    them, R B^T and B B^T, is summed on the way.
    """
    shared = D.shape[0] < R.shape[0]
    length = R.shape[-1] if not rule.in_place else max(_CHUNK // R.shape[0], _SHORTEST)
    chunks = [_update_codes(r, D, b, rule) for r, b in zip(R.split(length, -1), B.split(length, -1), strict=True)]
    residuals, codes = [r for r, _ in chunks], [b for _, b in chunks]
    if learn:
        H, C = _total((r @ b.mT for r, b in chunks), shared), _total((b @ b.mT for b in codes), shared)
        D_new = _update_atoms(H, C, D, rule)
        residuals = [rule.add_product(r, D - D_new, b) for r, b in zip(residuals, codes, strict=True)]
        D = D_new
    return rule.join(residuals, -1, R), D, rule.join(codes, -1, B)


def update_atoms(H: Tensor, C: Tensor, D: Tensor, unused: Unused) -> Tensor:
    """All atoms in turn, from H = R B^T and C = B B^T, with the residual R of the dictionary D and the codes B."""
    return _update_atoms(H, C, D, _Rule(0.0, math.inf, "hard", unused, in_place=not is_recorded(H, C, D)))


def _total(products: Iterable[Tensor], shared: bool) -> Tensor:
    total = reduce(torch.add, products)
    return total.sum(0, keepdim=True) if shared else total


def _update_codes(R: Tensor, D: Tensor, B: Tensor, rule: _Rule) -> tuple[Tensor, Tensor]:
    """All rows of B in turn with D held fixed; returns the new residual and codes."""
    groups = []
    for start in range(0, D.shape[-1], _GROUP):
        D0, B0 = D[..., start : start + _GROUP], B[:, start : start + _GROUP]
        rest, G = torch.baddbmm(B0, D0.mT.expand(R.shape[0], -1, -1), R), D0.mT @ D0
        rows = []
        for k in range(D0.shape[-1]):
            row = rule.shrink(rest[:, :1], start + k)
            # What the row has changed is taken from the rows of the group that are still to come.
            rest = rule.add_product(rest[:, 1:], G[:, k + 1 :, k : k + 1], B0[:, k : k + 1] - row)
            rows.append(row)
        codes = torch.cat(rows, 1)
        R = rule.add_product(R, D0, B0 - codes)
        groups.append(B0.copy_(codes) if rule.in_place else codes)
    return R, rule.join(groups, 1, B)


def _update_atoms(H: Tensor, C: Tensor, D: Tensor, rule: _Rule) -> Tensor:
    """All atoms in turn with B held fixed, from H = R B^T and C = B B^T.

    h_i = R b_i^T + d_i ||b_i||^2 with the residual of the moment, which the atoms before i have changed by their own
    steps. Through the residual, and not through P B^T, nothing large cancels: float32 stays accurate.
    """
    rest = H + D * C.diagonal(dim1=-2, dim2=-1)[:, None]
    atoms = []
    for i in range(D.shape[-1]):
        atom = rule.unit(rest[..., :1])
        step = atom - D[..., i : i + 1]
        rest = rule.add_product(rest[..., 1:], step, C[:, i : i + 1, i + 1 :], -1)
        atoms.append(atom)
    return _where_used(torch.cat(atoms, -1), D, rule.unused)


def _atom_order(R: Tensor, D: Tensor, B: Tensor, rule: _Rule) -> tuple[Tensor, Tensor, Tensor]:
    """Row, atom, row, atom, ..: the residual R is brought up to date once per group, rows within the group exactly."""
    shared = D.shape[0] < R.shape[0]
    groups, atoms = [], []
    for start in range(0, D.shape[-1], _GROUP):
        D0, B0 = D[..., start : start + _GROUP], B[:, start : start + _GROUP]
        rest = torch.baddbmm(B0, D0.mT.expand(R.shape[0], -1, -1), R)
        C, codes = D0[..., :0], B0[:, :0]  # the new atoms and codes of the group
        room = B0.new_empty(B.shape[0], 2 * B0.shape[1], B.shape[2]) if rule.in_place else None
        for k in range(D0.shape[-1]):
            row = rule.shrink(rest[:, :1], start + k)
            # R - C codes + (what stood there before) is the residual of the moment without atom k.
            old = D0[..., : k + 1] @ (B0[:, : k + 1] @ row.mT)
            h = _times_sparse(R, row, rule.in_place) - C @ (codes @ row.mT) + old
            d = D0[..., k : k + 1]
            atom = _where_used(rule.unit(h.sum(0, keepdim=True) if shared else h), d, rule.unused)
            pair, change = torch.cat([atom, -d], -1), torch.cat([row, B0[:, k : k + 1]], 1)
            rest = rule.add_product(rest[:, 1:], D0[..., k + 1 :].mT @ pair, change, -1)
            C, codes = torch.cat([C, atom], -1), _append(codes, row, room)
        R = rule.add_product(R, torch.cat([C, -D0], -1), _append(codes, B0, room), -1)
        atoms.append(C)
        groups.append(B0.copy_(codes) if rule.in_place else codes)
    return R, torch.cat(atoms, -1), rule.join(groups, 1, B)


def _append(rows: Tensor, more: Tensor, room: Tensor | None) -> Tensor:
    """The rows and more of them, in the room that was reserved or, where that is None, in new memory."""
    if room is None:
        return torch.cat([rows, more], 1)
    end = rows.shape[1] + more.shape[1]
    room[:, rows.shape[1] : end] = more
    return room[:, :end]


def _times_sparse(R: Tensor, b: Tensor, look: bool) -> Tensor:
    """R b^T (N, n, 1), from the patches with a nonzero code alone where that is worth the search."""
    patches = R.mT  # (N, L, n)
    code = b.flatten()
    used = code.nonzero()[:, 0] if look and patches.is_contiguous() else None
    if used is None or 4 * len(used) > len(code):
        return (b @ patches).mT
    patches, weight = patches.flatten(0, 1), code.index_select(0, used)
    if len(R) == 1:
        return (weight @ patches.index_select(0, used))[None, :, None]
    first = torch.searchsorted(used, torch.arange(0, len(code), b.shape[-1], device=b.device))
    return F.embedding_bag(used, patches, first, mode="sum", per_sample_weights=weight)[..., None]


def _normalize(h: Tensor) -> Tensor:
    """h / ||h|| for each surface, 0 where h = 0; safe in the first and second derivative, as the norm itself is not."""
    square = h.square().sum(1, keepdim=True)
    some = square > 0
    return torch.where(some, h, 0) * torch.where(some, square, 1).rsqrt()


def _where_used(atoms: Tensor, D: Tensor, unused: Unused) -> Tensor:
    """Unit-norm atoms as they are; for atoms that came out 0, since no patch uses them, the documented rule."""
    if unused == "keep":
        instead = D
    else:
        instead = torch.zeros_like(D)
        instead[:, 0] = 1
    return torch.where((atoms != 0).any(1, keepdim=True), atoms, instead)


def _levels(mu: float | Tensor, B: Tensor, look: bool) -> Sequence[float | Tensor]:
    """The threshold of each atom: (N or 1, 1, 1), or a number where all surfaces share one that can be seen."""
    mu = mu if isinstance(mu, Tensor) else torch.tensor(float(mu), dtype=B.dtype, device=B.device)
    mu = (mu if mu.ndim == 2 else mu.reshape(1, -1)).to(B)
    mu = mu.expand(mu.shape[0], B.shape[1])
    if look and mu.shape[0] == 1:
        return mu[0].tolist()
    return [column[..., None] for column in mu.split(1, 1)]


def _check_levels(mu: float | Tensor, bound: float, B: Tensor) -> None:
    if not bound > 0:
        raise ValueError(f"bound: {bound!r} given, a positive number is needed")
    N, K, _ = B.shape
    if isinstance(mu, Tensor):
        check_real("soup_dil_sweep", "mu", mu)
        rows, columns = mu.shape if mu.ndim == 2 else (1, mu.numel())
        if mu.ndim > 2 or rows not in (1, N) or columns not in (1, K):
            raise ValueError(f"mu: {tuple(mu.shape)} given, it must broadcast to (N, K) = ({N}, {K})")
    elif not mu >= 0:
        raise ValueError(f"mu: {mu!r} given, a number of at least 0 is needed")


def _check(P: Tensor, D: Tensor, B: Tensor, order: str, unused: str, threshold: str) -> None:
    if order not in ("atom", "block"):
        raise ValueError(f"order: {order!r} is unknown; choose 'atom' or 'block'")
    if unused not in ("first", "keep"):
        raise ValueError(f"unused: {unused!r} is unknown; choose 'first' or 'keep'")
    if threshold not in THRESHOLDS:
        raise ValueError(f"threshold: {threshold!r} is unknown; choose from {', '.join(map(repr, THRESHOLDS))}")
    check_real("soup_dil_sweep", "P", P)
    check_alike("soup_dil_sweep", "D", D, P.dtype)
    check_alike("soup_dil_sweep", "B", B, P.dtype)
    fits = P.ndim == D.ndim == B.ndim == 3 and D.shape[0] in (1, P.shape[0]) and 0 not in (*P.shape, *D.shape)
    if not fits or D.shape[1] != P.shape[1] or B.shape != (P.shape[0], D.shape[2], P.shape[2]):
        raise ValueError(
            f"soup_dil_sweep: P {tuple(P.shape)}, D {tuple(D.shape)} and B {tuple(B.shape)} do not fit; "
            "(N, n, L), (N or 1, n, K) and (N, K, L) are needed"
        )
