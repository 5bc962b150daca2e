r"""Dictionary learners behind one interface: each call is one pass over codes and atoms that never raises the cost.

    ||P - D B||_F^2 + mu^2 ||B||_0,   ||d_i|| = 1,   |b_ji| <= a

A learner is called as learner(R, D, B, mu, learn=True) -> (R, D, B), with the residual R = P - D B (N, n, L), the
dictionary D (N, n, K), or (1, n, K) shared by the batch, the codes B (N, K, L) and the threshold mu, a number or
(N, 1). `learn=False` updates the codes alone. R and B may be overwritten where no derivative is recorded. Whoever needs
to know what a learner minimises reads its `threshold` ("hard" if it has none) and its `bound` (none if it has none).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.dictionary.polar import nearest_of_rank
from torchdls.dictionary.pursuit import orthogonal_matching_pursuit
from torchdls.dictionary.soup_dil import Order, Unused, residual_sweep
from torchdls.dictionary.thresholds import THRESHOLDS, Threshold

Step = tuple[Tensor, Tensor, Tensor]


class Learner(Protocol):
    """What DLS asks of a learner; see the module.

    Example:
        >>> def no_learner(R, D, B, mu, learn=True):
        ...     return R, D, B  # codes stay 0
        >>> dls = torchdls.DLS(n_iter=2, learner=no_learner)
        >>> dls(torch.zeros(1, 2, 12, 12)).shape
        torch.Size([1, 1, 12, 12])
    """

    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass: R, D and B after it."""


@dataclass(frozen=True)
class SoupDIL:
    """Sum of outer products: each row of codes by thresholding, each atom by one product (see `soup_dil_sweep`).

    Args:
        order: "atom" (the paper's) or "block".
        unused: rule for atoms that no patch uses, "first" or "keep".
        threshold: "hard", "soft" or "firm"; the last two have a derivative in mu.
        bound: bound a on the codes, for heights in pixels.
        n_sweeps: sweeps in one pass.

    Raises:
        ValueError: an option is unknown or out of range.

    Source: Ravishankar, Nadakuditi, Fessler, "Efficient sum of outer products dictionary learning (SOUP-DIL)", 2015.

    Example:
        >>> P, D = torch.eye(4)[None], torch.eye(4)[None]
        >>> R, D, B = torchdls.SoupDIL()(P, D, torch.zeros(1, 4, 4), mu=0.5)
        >>> B[0].diagonal()
        tensor([1., 1., 1., 1.])
    """

    order: Order = "atom"
    unused: Unused = "first"
    threshold: Threshold = "hard"
    bound: float = math.inf
    n_sweeps: int = 1

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass of sweeps."""
        for _ in range(self.n_sweeps):
            R, D, B = residual_sweep(
                R, D, B, mu, self.bound, self.order, unused=self.unused, learn=learn, threshold=self.threshold
            )
        return R, D, B


@dataclass(frozen=True)
class FixedDictionary:
    """The dictionary stays as it is (the cosine one, by default in DLS); only the codes follow, by thresholding.

    Exact for orthonormal dictionaries; for others a pass of coordinate descent over the rows of codes.

    Args:
        threshold: "hard", "soft" or "firm"; the last two have a derivative in mu.
        bound: bound a on the codes, for heights in pixels.
        n_sweeps: times that each row is updated in one pass.

    Raises:
        ValueError: an option is unknown or out of range.

    Example:
        >>> D = torch.eye(4)[None]
        >>> R, same, B = torchdls.FixedDictionary()(torch.eye(4)[None], D, torch.zeros(1, 4, 4), mu=0.5)
        >>> torch.equal(same, D), float(R.abs().max())
        (True, 0.0)
    """

    threshold: Threshold = "hard"
    bound: float = math.inf
    n_sweeps: int = 1

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass over the codes, whatever `learn` says."""
        for _ in range(self.n_sweeps):
            R, D, B = residual_sweep(R, D, B, mu, self.bound, "block", learn=False, threshold=self.threshold)
        return R, D, B


@dataclass(frozen=True)
class DinoKat:
    """SOUP-DIL with low-rank atoms: as a c_y x c_x matrix, every atom has at most the given rank.

    The best such atom is the product h of the sweep, cut to its largest singular values and normalised. A learned atom
    has fewer parameters, so less noise enters it. Start from atoms of that rank, as the cosine ones are. Differentiable
    where the last singular value that is kept differs from the first that is not; others may be equal.

    Args:
        rank: of the atoms, at least 1.
        patch_size: rows and columns (c_y, c_x) of a patch; None for square patches.
        order: "atom" or "block".
        unused: rule for atoms that no patch uses, "first" or "keep".
        bound: bound a on the codes, for heights in pixels.
        n_sweeps: sweeps in one pass.

    Raises:
        ValueError: an option is unknown or out of range.

    Source: Ravishankar, Moore, Nadakuditi, Fessler, "Efficient learning of dictionaries with low-rank atoms", 2016.

    Example:
        >>> learner = torchdls.DinoKat(rank=1)
        >>> atom = learner.project(torch.eye(3).reshape(1, 9, 1))
        >>> int(torch.linalg.matrix_rank(atom.reshape(3, 3)))
        1
    """

    rank: int = 1
    patch_size: tuple[int, int] | None = None
    order: Order = "atom"
    unused: Unused = "first"
    bound: float = math.inf
    n_sweeps: int = 1

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass of sweeps."""
        for _ in range(self.n_sweeps):
            R, D, B = residual_sweep(
                R, D, B, mu, self.bound, self.order, unused=self.unused, learn=learn, project=self.project
            )
        return R, D, B

    def project(self, h: Tensor) -> Tensor:
        """(N, n, 1), each of them cut to its largest singular values as a c_y x c_x matrix."""
        n = h.shape[1]
        side = math.isqrt(n)
        shape = (side, side) if self.patch_size is None else self.patch_size
        if shape[0] * shape[1] != n:
            raise ValueError(f"DinoKat: patch_size={self.patch_size!r} does not fit patches of {n} pixels")
        matrices = h[..., 0].unflatten(-1, shape)
        some = (matrices != 0).flatten(1).any(1)[:, None, None]
        ladder = torch.diag(torch.arange(1, max(shape) + 1, dtype=h.dtype, device=h.device))[: shape[0], : shape[1]]
        cut = nearest_of_rank(torch.where(some, matrices, ladder), self.rank)  # what stands in for 0 goes nowhere
        return torch.where(some, cut, 0).flatten(1)[..., None]


@dataclass(frozen=True)
class KSVD:
    """K-SVD: codes by orthogonal matching pursuit, then each atom together with the codes that use it.

    A patch keeps its old codes where they cost less than the new ones. An atom and its codes are the largest singular
    pair of the residual of its patches, found by `steps` alternating products (one is the usual approximation). Atoms
    that no patch uses become the patches that are fitted worst. Not for `torch.compile` or `vmap`: the pursuit works on
    the patches that are not yet done.

    With `tol`, a patch takes no more atoms than bring |p - D b|^2 down to it, and a residual below that counts as
    `tol`: codes lower max(|p - D b|^2, tol) + mu^2 ||b||_0, of equal costs that of fewer atoms is kept, and atoms lower
    the residual. The cost without `tol` may then rise. For patches of n pixels with noise of standard deviation s,
    tol = n (1.15 s)^2 is usual; mu may then be 0.

    Args:
        n_nonzero: most atoms of a patch; None leaves it to mu.
        steps: alternating products per atom, at least 1.
        bound: bound a on the codes, for heights in pixels.
        tol: squared residual of a patch that suffices, at least 0.

    Raises:
        ValueError: an option is out of range.

    Source: Aharon, Elad, Bruckstein, "K-SVD: an algorithm for designing overcomplete dictionaries for sparse
    representation", 2006; Rubinstein, Zibulevsky, Elad, 2008.

    Example:
        >>> P, D = torch.eye(4)[None], torch.eye(4)[None]
        >>> R, D, B = torchdls.KSVD(n_nonzero=1)(P, D, torch.zeros(1, 4, 4), mu=0.0)
        >>> (B != 0).sum(-2).tolist()  # one atom each
        [[1, 1, 1, 1]]
    """

    n_nonzero: int | None = None
    steps: int = 1
    bound: float = math.inf
    tol: float = 0.0

    def __post_init__(self) -> None:
        check_options(self)
        if not 0 <= self.tol < math.inf:
            raise ValueError(f"KSVD: tol={self.tol!r} given, a number of at least 0 is needed")

    @full_precision
    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass: pursuit, then atoms."""
        N, _, L = R.shape
        level = torch.as_tensor(mu, dtype=R.dtype, device=R.device).reshape(-1, 1).expand(N, L)
        P = R + D @ B
        found = orthogonal_matching_pursuit(P, D, self.n_nonzero, mu=level, tol=self.tol)
        found = found.clamp(-self.bound, self.bound)
        rest = P - D @ found
        better = self._is_better(rest, found, R, B, level)[:, None]
        R, B = torch.where(better, rest, R), torch.where(better, found, B)
        if not learn:
            return R, D, B
        if D.shape[0] == N:
            return self._atoms(R, D, B)
        # One dictionary for all: the patches of the batch side by side are the patches of one surface.
        R, D, B = self._atoms(R.transpose(0, 1).flatten(1)[None], D, B.transpose(0, 1).flatten(1)[None])
        return R[0].unflatten(1, (N, L)).transpose(0, 1), D, B[0].unflatten(1, (N, L)).transpose(0, 1)

    def _is_better(self, rest: Tensor, found: Tensor, R: Tensor, B: Tensor, level: Tensor) -> Tensor:
        """(N, L) bool: the new codes of a patch cost less, or as much (its target is met) with fewer atoms."""
        new, old = _cost(rest, found, level, self.tol), _cost(R, B, level, self.tol)
        fewer = (found != 0).sum(1) < (B != 0).sum(1)
        return (new < old) | ((new == old) & fewer)

    def _atoms(self, R: Tensor, D: Tensor, B: Tensor) -> Step:
        atoms, rows = [], []
        for d, b in zip(D.split(1, -1), B.split(1, 1), strict=True):
            users = b != 0
            E = torch.where(users, R + d @ b, 0)
            old = d @ b
            for _ in range(self.steps):
                d = _unit(E @ b.mT, d)
                b = torch.where(users, (d.mT @ E).clamp(-self.bound, self.bound), 0)
            R = R + old - d @ b
            atoms.append(d)
            rows.append(b)
        B = torch.cat(rows, 1)
        return R, _replace_unused(torch.cat(atoms, -1), R, B), B


_WORDS = {"order": ("atom", "block"), "unused": ("first", "keep"), "threshold": THRESHOLDS}


def check_options(learner: Learner) -> None:
    """ValueError for a word that is unknown, or a number out of its range."""
    name, options = type(learner).__name__, vars(learner)
    for word, known in _WORDS.items():
        if options.get(word, known[0]) not in known:
            raise ValueError(f"{name}: {word}={options[word]!r} is unknown; choose from {', '.join(map(repr, known))}")
    for count in ("rank", "n_nonzero", "steps", "n_sweeps"):
        value = options.get(count)
        if count in options and (count, value) != ("n_nonzero", None) and (not isinstance(value, int) or value < 1):
            raise ValueError(f"{name}: {count}={value!r} given, an integer of at least 1 is needed")
    if not options["bound"] > 0:
        raise ValueError(f"{name}: bound={options['bound']!r} given, a positive number is needed")


def _cost(R: Tensor, B: Tensor, level: Tensor, tol: float) -> Tensor:
    """(N, L) cost of each patch, whose residual need not be less than tol."""
    return R.square().sum(1).clamp(min=tol) + level.square() * (B != 0).sum(1)


def _unit(h: Tensor, instead: Tensor) -> Tensor:
    """h / ||h||, or what stands in for h = 0."""
    square = h.square().sum(1, keepdim=True)
    return torch.where(square > 0, h * torch.where(square > 0, square, 1).rsqrt(), instead)


def _replace_unused(D: Tensor, R: Tensor, B: Tensor) -> Tensor:
    """Unused atoms become the residuals of the patches fitted worst, the first of them that of the worst."""
    unused = ~(B != 0).any(2)
    count = min(D.shape[-1], R.shape[-1])
    worst = R.square().sum(1).topk(count, -1).indices
    rank = (unused.cumsum(1) - 1).clamp(0, count - 1)
    patches = R.gather(2, worst.gather(1, rank)[:, None].expand(-1, R.shape[1], -1))
    return torch.where(unused[:, None], _unit(patches, D), D)
