"""FOCUSS-CNDL: codes by reweighted least squares, atoms by steps along the unit spheres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.dictionary.learners import Step, check_options

_CHUNK = 1024  # patches worked on at once: each has an n x n system of its own


@dataclass(frozen=True)
class Focuss:
    r"""FOCUSS-CNDL: codes by reweighted least squares, atoms by a step along their unit spheres.

        b <- Q D^T (D Q D^T + s I)^{-1} p,     Q = diag |b|^(2 - q),  s = q mu^(2 - q) / 2

    from the shortest code, `steps` times; each step lowers |p - D b|^2 + mu^(2 - q) sum |b_i|^q. Codes up to mu
    are then cut to 0, and a patch keeps its old codes where they cost less. The atoms move by

        D <- normalised(D + t (R B^T, less its part along each atom)),     t = 1 / ||B B^T||

    if that lowers the residual. Of historical worth: a system of n equations for every patch and step, and a slow
    approach for the atoms. `SoupDIL` and `KSVD` find sparser codes sooner.

    Args:
        q: exponent, in (0, 1].
        steps: times that the codes of a pass are reweighted, at least 1.
        bound: bound a on the codes, for heights in pixels.

    Raises:
        ValueError: an option is out of range.

    Source: Kreutz-Delgado et al., "Dictionary learning algorithms for sparse representation", Neural Computation 15,
    2003, as we understand it: s, the cut and the tests of descent are ours.

    Example:
        >>> P, D = torch.eye(4)[None], torch.eye(4)[None]
        >>> R, D, B = torchdls.Focuss(steps=10)(P, D, torch.zeros(1, 4, 4), mu=0.5)
        >>> (B != 0).sum(-2).tolist()
        [[1, 1, 1, 1]]
    """

    q: float = 0.5
    steps: int = 5
    bound: float = math.inf

    def __post_init__(self) -> None:
        check_options(self)
        if not 0 < self.q <= 1:
            raise ValueError(f"Focuss: q={self.q!r} given, a number above 0 and at most 1 is needed")

    @full_precision
    def __call__(self, R: Tensor, D: Tensor, B: Tensor, mu: float | Tensor, learn: bool = True) -> Step:
        """One pass: codes, then atoms."""
        level = torch.as_tensor(mu, dtype=R.dtype, device=R.device).reshape(-1, 1).expand(len(R), 1)
        P = R + D @ B
        found = torch.cat([self._codes(p, D, level) for p in P.split(_CHUNK, -1)], -1)
        rest = P - D @ found
        price = level.square()
        cost, old = (r.square().sum(1) + price * (b != 0).sum(1) for r, b in ((rest, found), (R, B)))
        better = (cost < old)[:, None]
        R, B = torch.where(better, rest, R), torch.where(better, found, B)
        return (*_move_atoms(P, R, D, B), B) if learn else (R, D, B)

    def _codes(self, P: Tensor, D: Tensor, level: Tensor) -> Tensor:
        """(N, K, L) codes of patches (N, n, L)."""
        ridge = (self.q / 2 * level.pow(2 - self.q))[..., None, None]  # (N, 1, 1, 1)
        unit = torch.eye(P.shape[1], dtype=P.dtype, device=P.device)
        weight = P.new_ones(len(P), P.shape[-1], D.shape[-1])
        atoms, b = D[:, None], weight
        for _ in range(self.steps + 1):
            system = (atoms * weight[:, :, None]) @ atoms.mT
            least = torch.finfo(P.dtype).eps * 10 * system.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
            x = torch.linalg.solve(system + (ridge + least + torch.finfo(P.dtype).tiny) * unit, P.mT[..., None])
            b = weight * (atoms.mT @ x)[..., 0]
            weight = b.abs().pow(2 - self.q)
        b = torch.where(b.abs() > level[..., None], b, 0)
        return b.mT.clamp(-self.bound, self.bound)


def _move_atoms(P: Tensor, R: Tensor, D: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
    """Residual and dictionary after a step of the atoms, or as they were; one step for all where they share atoms."""
    shared = D.shape[0] != R.shape[0]
    step, gram = R @ B.mT, B @ B.mT
    if shared:
        step, gram = step.sum(0, keepdim=True), gram.sum(0, keepdim=True)
    top = gram.abs().sum(-1).amax(-1)[:, None, None]  # at least the largest eigenvalue
    along = step - D * (D * step).sum(1, keepdim=True)
    moved = D + along / torch.where(top > 0, top, 1)
    moved = moved / moved.norm(dim=1, keepdim=True)  # a step across the sphere makes no atom shorter
    rest = P - moved @ B
    before, after = (r.square().sum((1, 2), keepdim=True) for r in (R, rest))
    if shared:
        before, after = before.sum(0, keepdim=True), after.sum(0, keepdim=True)
    lower = after < before
    return torch.where(lower, rest, R), torch.where(lower, moved, D)
