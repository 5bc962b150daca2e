"""Several heights of the same data blended by Stein's unbiased estimate of the risk."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor

from torchdls.integrators.slope_dls.waves import slow_modes
from torchdls.noise import height_noise
from torchdls.operators.modes import Boundary, from_modes, to_modes
from torchdls.operators.tables import table

_PERIOD = 16.0  # of the slow waves, in pixels
_SHARED = 0.1  # of the risk of the other part


def signs(like: Tensor) -> Tensor:
    """(1, 2, H, W) random signs, the same at every call: the last bits of SplitMix64, which vmap and compilers bear."""
    found: Tensor = _signs(*like.shape[-2:], like=like)
    return found


@table
def _signs(h: int, w: int) -> Tensor:
    k = (torch.arange(2 * h * w, device="cpu") + 1) * -0x61C8864680B583EB  # wraps around at 2^64
    k = (k ^ (k >> 30 & (1 << 34) - 1)) * -0x40A7B892E31B1A47
    k = (k ^ (k >> 27 & (1 << 37) - 1)) * -0x6B2FB644ECCEEE15
    return ((k ^ k >> 31) & 1).double().mul(2).sub(1).view(1, 2, h, w)


def sure_weights(
    heights: Tensor,
    changes: Tensor,
    reference: Tensor,
    moved: Tensor,
    noise: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    norm: float = 0.5,
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Weights w >= 0, sum w <= 1, of z_ls + sum_m w_m (z_m - z_ls) with the least predicted risk.

        minimise 1/2 w^T G w + b^T w,   G_mn = sum W D_m D_n,   b_m = sigma^2 sum W dct2(C_m - a) dct2(a)
        D_m = dct2(z_m - z_ls),   W = S^-norm, 0 for the mean

    with S the variance that white noise leaves in the coefficients of z_ls, C_m the derivative of z_m along the probe
    and a that of z_ls. With norm = 0 the risk is the squared error of the height, with 1 all coefficients count by
    their own noise.

    Args:
        heights: (M, N, 1, H, W), on full rectangles with equal trust.
        changes: (M, N, 1, H, W), their derivatives along the probe.
        reference: (N, 1, H, W), the least-squares height.
        moved: (N, 1, H, W), its derivative along the probe.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).
        norm: 0 to 1.
        boundary: "neumann" or "periodic".

    Returns:
        (N, M), without a derivative: a choice.

    Source: Stein (1981); Ramani, Blu, Unser, "Monte-Carlo SURE", IEEE TIP 17(9), 2008.
    """
    weight = _weight(reference, pixel_size, norm, boundary)
    D, push, change = (to_modes(t.detach(), boundary) for t in (heights - reference, moved, changes - moved))
    return _least_risk(*_risk(D, push, change, weight, noise)).to(reference)


def blend_by_waves(
    heights: Tensor,
    changes: Tensor,
    reference: Tensor,
    moved: Tensor,
    noise: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    norm: float = 0.5,
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""z_ls + sum_m w_m (z_m - z_ls), with weights of their own for the slow waves (period above 16) and the others.

    What sees the slow waves best need not be best in the fine ones. Each part has the weights of `sure_weights` for its
    own risk, over that of least squares, to which a tenth of that of the other part is added: few modes make it
    scatter. Where little of the noise of the fine waves was found, as on texture, they return to least squares: their
    part of the sum counts

        r = clip(5 q - 2, 0, 1) times,   q = sum |D|^2 S^-3/4 / (sigma^2 sum S^1/4)   over the fine waves

    Args:
        heights: see `sure_weights`, and so for the others.
        changes: without a derivative.
        reference: the least-squares height.
        moved: without a derivative.
        noise: without a derivative.
        pixel_size: (dx, dy).
        norm: 0 to 1.
        boundary: "neumann" or "periodic".

    Returns:
        (N, 1, H, W); differentiable in the heights and the reference, with the weights held fixed.
    """
    weight = _weight(reference, pixel_size, norm, boundary)
    shape = (reference.shape[-2], reference.shape[-1])
    slow = slow_modes(shape, shape, _PERIOD, reference, boundary)
    D, push, change = (to_modes(t, boundary) for t in (heights - reference, moved, changes - moved))
    parts = slow, ~slow
    variance = height_noise(shape, reference, pixel_size, boundary)
    risks = []
    for part in parts:
        counted = torch.where(part, weight, 0)
        plain = (counted * variance).sum()
        G, b = _risk(D.detach(), push, change, counted / torch.where(plain > 0, plain, 1), noise)
        risks.append((G, b))
    blends = []
    for own, other in zip(risks, reversed(risks), strict=True):
        w = _least_risk(*(x + _SHARED * y for x, y in zip(own, other, strict=True))).to(reference)
        blends.append((w.mT[:, :, None, None, None] * D).sum(0))
    fine = torch.where(slow, 0, _weight(reference, pixel_size, 0.75, boundary))
    expected = noise.detach().square() * torch.where(slow, 0, _weight(reference, pixel_size, -0.25, boundary)).sum()
    share = (fine * blends[1].detach().square()).sum((-3, -2, -1)) / torch.where(expected > 0, expected, 1)
    share = (5 * share - 2).clamp(0, 1)[:, None, None, None]
    return reference + from_modes(torch.where(slow, blends[0], share * blends[1]), boundary)


def _weight(reference: Tensor, pixel_size: tuple[float, float], norm: float, boundary: Boundary) -> Tensor:
    """(H, W) W."""
    variance = height_noise((reference.shape[-2], reference.shape[-1]), reference, pixel_size, boundary)
    return torch.where(variance > 0, torch.where(variance > 0, variance, 1).pow(-norm), 0)


def _risk(D: Tensor, push: Tensor, change: Tensor, weight: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """G (N, M, M) and b (N, M), from cosine modes (M, N, 1, H, W)."""
    along = (weight * push * change).movedim(0, 1).flatten(2).sum(2)
    D = D.movedim(0, 1).flatten(2)
    return (D * weight.flatten()) @ D.mT, noise.detach().square()[:, None] * along


def _least_risk(G: Tensor, b: Tensor) -> Tensor:
    """(N, M) in double precision, whatever the unit of the heights."""
    scale = G.diagonal(dim1=1, dim2=2).mean(1)
    scale = torch.where(scale > 0, scale, 1)
    return least_in_simplex((G / scale[:, None, None]).double(), (b / scale[:, None]).double())


def least_in_simplex(G: Tensor, b: Tensor) -> Tensor:
    r"""The w >= 0, sum w <= 1 with the least 1/2 w^T G w + b^T w, by trying every set of positive weights.

    Args:
        G: (N, M, M) positive semidefinite, M small: 2^(M+1) systems of at most M + 1 equations are solved.
        b: (N, M).

    Returns:
        (N, M).
    """
    m = b.shape[1]
    ridge = 1e-9 * torch.eye(m, dtype=G.dtype, device=G.device)
    best, least = torch.zeros_like(b), torch.zeros_like(b[:, 0])
    for size in range(1, m + 1):
        for chosen in combinations(range(m), size):
            rows = torch.tensor(chosen, device=G.device)
            for full in (False, True):
                part = _stationary((G + ridge)[:, rows][:, :, rows], b[:, rows], full)
                w = torch.zeros_like(b).index_copy(1, rows, part)
                cost = 0.5 * (w[:, None] @ G @ w[:, :, None]).flatten() + (b * w).sum(1)
                better = (part >= 0).all(1) & (w.sum(1) <= 1 + 1e-6) & (cost < least)
                best, least = torch.where(better[:, None], w, best), torch.where(better, cost, least)
    return best


def _stationary(G: Tensor, b: Tensor, full: bool) -> Tensor:
    """Where 1/2 w^T G w + b^T w is stationary, among all w or among those of sum 1."""
    solved = torch.linalg.solve(G, torch.stack([-b, torch.ones_like(b)], 2))
    free, direction = solved.unbind(2)
    if not full:
        return free
    along = direction.sum(1, keepdim=True)
    return free + direction * (1 - free.sum(1, keepdim=True)) / along
