"""A SOUP-DIL sweep over patches that are not at hand together: one dictionary for many tiles, surfaces or processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from torchdls.dictionary.soup_dil import Unused, residual_sweep, update_atoms
from torchdls.dictionary.thresholds import Threshold

Reduce = Callable[[Tensor], Tensor]


class TiledSweep:
    r"""One sweep in the block order, exact over tiles: what the atoms need of the patches are two small sums.

    The codes of a patch do not depend on other patches. With D held fixed each tile has its codes updated, and

        H = sum_t R_t B_t^T,      C = sum_t B_t B_t^T

    are all that the new atoms are made of: h_i = H_i + d_i C_ii, less what the atoms before i have changed by their
    own steps, d_i = h_i / ||h_i||. So a surface goes through tile by tile with one dictionary, and so do tiles of many
    processes, whose H (n x K) and C (K x K) are added up by one all-reduce.

    Args:
        D: (1, n, K) the dictionary.
        mu: threshold, at least 0.
        bound: the bound on the codes.
        threshold: "hard", "soft" or "firm".
        unused: what becomes of an atom that no patch uses, "first" or "keep".

    Raises:
        ValueError: D is not one dictionary, or as `soup_dil_sweep`.

    Source: the block order of `torchdls.soup_dil_sweep`.

    Example:
        >>> from torchdls.dictionary import TiledSweep
        >>> D, R = torch.eye(4)[None], torch.diag(torch.tensor([3.0, 2.0, 0.1, 0.2]))[None]
        >>> sweep = TiledSweep(D, mu=0.5)
        >>> tiles = [sweep.codes(r, torch.zeros(1, 4, 2)) for r in R.split(2, -1)]
        >>> sweep.atoms().shape, tiles[0][1][0, :2]
        (torch.Size([1, 4, 4]), tensor([[3., 0.],
                [0., 2.]]))
    """

    def __init__(
        self,
        D: Tensor,
        mu: float | Tensor,
        bound: float = math.inf,
        *,
        threshold: Threshold = "hard",
        unused: Unused = "first",
    ) -> None:
        if D.ndim != 3 or len(D) != 1:
            raise ValueError(f"TiledSweep: D {tuple(D.shape)} given, one dictionary (1, n, K) is needed")
        self.D, self.mu, self.bound, self.threshold, self.unused = D, mu, bound, threshold, unused
        self.H, self.C = torch.zeros_like(D), D.new_zeros(1, D.shape[-1], D.shape[-1])

    def codes(self, R: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
        """Residual and codes of a tile with the codes updated; what the atoms need of them is added to the sums.

        Args:
            R: (N, n, L) residual P - D B of the patches of a tile; may be overwritten.
            B: (N, K, L) their codes; may be overwritten.
        """
        R, _, B = residual_sweep(R, self.D, B, self.mu, self.bound, "block", learn=False, threshold=self.threshold)
        self.H = self.H + (R @ B.mT).sum(0, keepdim=True)
        self.C = self.C + (B @ B.mT).sum(0, keepdim=True)
        return R, B

    def atoms(self, reduce: Reduce | None = None) -> Tensor:
        """The dictionary after the sweep; the residual of a tile then is R + (D - D_new) B.

        Args:
            reduce: adds a tensor up over all processes, such as `over_ranks`; None where there is one.
        """
        sums = torch.cat([self.H, self.C], 1)
        sums = sums if reduce is None else reduce(sums)
        H, C = sums.split([self.H.shape[1], self.C.shape[1]], 1)
        return update_atoms(H, C, self.D, self.unused)


def over_ranks(x: Tensor) -> Tensor:
    """The sum over all processes of `torch.distributed`, the same bits on each."""
    total = x.contiguous().clone()
    torch.distributed.all_reduce(total)
    return total


def learn_over_tiles(
    tiles: Callable[[], Iterable[Tensor]],
    D: Tensor,
    mu: float | Tensor,
    n_sweeps: int = 1,
    *,
    threshold: Threshold = "hard",
    unused: Unused = "first",
    reduce: Reduce | None = None,
) -> Tensor:
    """A dictionary learned from patches that come tile by tile; nothing is kept of a tile from one sweep to the next.

    The codes start from 0 in every sweep, so that memory holds one tile alone.

    Args:
        tiles: called for each sweep, gives the patches (N, n, L) of every tile in turn.
        D: (1, n, K) the dictionary to start from.
        mu: threshold, at least 0.
        n_sweeps: number of sweeps.
        threshold: "hard", "soft" or "firm".
        unused: what becomes of an atom that no patch uses, "first" or "keep".
        reduce: see `TiledSweep.atoms`; with it each process gives tiles of its own, and all get the same dictionary.

    Returns:
        (1, n, K).

    Example:
        >>> from torchdls.dictionary import learn_over_tiles
        >>> P = torch.randn(1, 16, 400, generator=torch.Generator().manual_seed(0))
        >>> D = torchdls.dct_dictionary((4, 4))[None]
        >>> learned = learn_over_tiles(lambda: P.split(100, -1), D, mu=0.5, n_sweeps=3)
        >>> bool(torch.allclose(learned.norm(dim=1), torch.ones(1, 16)))
        True
    """
    for _ in range(n_sweeps):
        sweep = TiledSweep(D, mu, threshold=threshold, unused=unused)
        for P in tiles():
            sweep.codes(P.clone(), P.new_zeros(P.shape[0], D.shape[-1], P.shape[-1]))
        D = sweep.atoms(reduce)
    return D
