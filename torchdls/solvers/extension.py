"""Heights continued beyond a mask."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls.operators import GradientOperator, edge_slopes
from torchdls.solvers.poisson import solve


def harmonic_extension(
    z: Tensor,
    mask: Tensor,
    region: Tensor | None = None,
    *,
    tol: float = 1e-3,
    max_iter: int = 500,
    pixel_size: tuple[float, float] = (1.0, 1.0),
) -> Tensor:
    r"""Continue z beyond its mask as the smoothest membrane that is fixed to it.

        minimise ||A u||^2 with u = z inside

    This is the solve (*) on the complement of the mask: no slopes, and every neighbour inside is an anchor of weight
    1/spacing^2. With L = A^T A these anchors are r = -L 1_inside and r a = -L (z 1_inside), read outside.

    Args:
        z: (N, 1, H, W); what it holds outside the mask is not read.
        mask: (N, 1, H, W) bool.
        region: (N, 1, H, W) bool, how far the membrane reaches, with a free border; None for the whole image.
        tol: relative residual of the solve.
        max_iter: limit of its iterations.
        pixel_size: (dx, dy).

    Returns:
        (N, 1, H, W), equal to z inside the mask, and 0 where the membrane does not reach.
    """
    beyond = ~mask if region is None else region & ~mask
    a = GradientOperator("forward", pixel_size)
    inside = mask.to(z.dtype)
    weight, pull = (torch.where(beyond, -a.adjoint(a(x)), 0) for x in (inside, torch.where(mask, z, 0)))
    anchor = pull / torch.where(weight > 0, weight, 1)
    v, w = edge_slopes(torch.zeros_like(z).expand(-1, 2, -1, -1), beyond)
    outside = solve(v, w, anchor, weight, tol=tol, max_iter=max_iter, pixel_size=pixel_size).height
    return torch.where(mask, z, outside)
