"""Grossly wrong samples of a gradient field: found by what the surface through the others says, and replaced by it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import edges_of
from torchdls.operators import GradientOperator, edge_slopes
from torchdls.operators.edges import edges_at_pixels, present_edges
from torchdls.solvers import solve

_LIMITS = (16.0, 12.0, 9.0, 7.0, 6.0, 5.0, 4.0, 4.0)  # robust standard deviations, loop by loop
_WITNESSES = 2  # neighbours that must agree with a sample to protect it
_SPOILT = 2  # neighbours that may be wrong themselves


def replace_outliers(fields: Fields, *, tol: float = 1e-5) -> tuple[Tensor, Tensor]:
    r"""Expectation and maximisation over which samples are wrong, eight loops.

        z = least squares through the present slopes;   g^_i = mean slope of z on the two edges at pixel i
        wrong where |g_i - g^_i| > c s,   s = the scaled median of |g - g^| over the pixels, c = 16, 12, .. 4
        present slope = g^_i where wrong, else g_i

    Replacing a sample by what the surface says is the majorising step for leaving it out, and keeps the noise uniform
    and the solve direct.

    True steps and creases also differ from the smooth surface, but they come in lines: a sample is protected if
    at least two of its eight neighbours measure the same slope in both components, to within 4 s or, on a steep bend,
    to within the spread of the neighbours among themselves. Isolated errors have no such witnesses.

    Args:
        fields: checked input of an integrator.
        tol: relative residual of the solve, where it is not direct.

    Returns:
        The gradient (N, 2, H, W) with wrong samples replaced, and where they were (N, 1, H, W) bool. Differentiable
        in the gradient, with the set of wrong samples held fixed.
    """
    given, a = fields.gradient, GradientOperator("forward", fields.steps)
    inside = torch.ones_like(given[:, :1], dtype=torch.bool) if fields.mask is None else fields.mask
    inside = inside.expand(given.shape[0], -1, -1, -1)
    nearest, spread = _surroundings(given.detach(), inside)
    present, wrong, z = given, torch.zeros_like(inside), None
    for limit in _LIMITS:
        v, w = edges_of(fields._replace(gradient=present))
        guess = None if z is None else z.detach()
        z = solve(v, w, fields.anchor, fields.anchor_weight, tol=tol, z0=guess, pixel_size=fields.steps).height
        expected = _at_pixels(a(z), fields.mask)
        distance = (given - expected).detach().norm(dim=1, keepdim=True)
        median = masked_median(distance.flatten(1), inside.flatten(1))[:, None, None, None]
        scale = median / NORMAL_MEDIAN / 1.7  # the norm of two components is larger than one
        wrong = inside & (distance > limit * scale) & (nearest > torch.maximum(4 * scale, spread))
        present = torch.where(wrong, expected, given)
    return present, wrong


def _at_pixels(slopes: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the (one or two) edges at each pixel and direction, (N, 2, H, W)."""
    there = edge_slopes(torch.zeros_like(slopes), mask)[1]
    there = (present_edges(slopes) if there is None else there > 0).to(slopes.dtype)
    return edges_at_pixels(slopes * there) / edges_at_pixels(there).clamp(min=1)


def _surroundings(g: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """How far the second nearest of the eight neighbours' slopes is from a sample's, and how far they spread.

    The distance is the larger one of the two components; the spread is the third largest distance of the neighbours
    from their median, which two wrong ones do not change. Both (N, 1, H, W).
    """
    h, w = g.shape[-2:]
    padded = functional.pad(torch.where(inside, g, torch.nan), (1, 1, 1, 1), value=torch.nan)
    around = [padded[..., i : i + h, j : j + w] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    near = torch.stack(around, 1)
    distance = (near - g[:, None]).abs().amax(2).nan_to_num(torch.inf).kthvalue(_WITNESSES, 1).values
    spread = (near - near.nanmedian(1, keepdim=True).values).abs().amax(2).nan_to_num(0).topk(_SPOILT + 1, 1).values
    return distance[:, None], spread[:, -1:]
