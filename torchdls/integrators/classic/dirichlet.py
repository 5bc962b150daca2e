"""Least squares with known heights on the border."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls._tracing import is_concrete
from torchdls.integrators.base import Fields
from torchdls.integrators.data_term import edges_of
from torchdls.operators import GradientOperator, dirichlet_eigenvalues, dst2, edge_slopes
from torchdls.solvers import SolveResult, solve


def border(mask: Tensor) -> Tensor:
    """The pixels of a mask (N, 1, H, W) with a neighbour (of four) outside the mask or the image."""
    m = F.pad(mask, (1, 1, 1, 1))
    inner = m[..., 1:-1, 2:] & m[..., 1:-1, :-2] & m[..., 2:, 1:-1] & m[..., :-2, 1:-1]
    return mask & ~inner


def solve_dirichlet(fields: Fields, *, tol: float, max_iter: int, z0: Tensor | None = None) -> SolveResult:
    """The solve (*) for all pixels but those of the border, which keep their anchor heights (0 where they have none).

    With equal trust on a full rectangle the interior is solved at once by sine transforms; else by conjugate gradients.
    """
    mask = torch.ones_like(fields.gradient[:, :1], dtype=torch.bool) if fields.mask is None else fields.mask
    known = border(mask)
    held = torch.zeros_like(fields.gradient[:, :1])
    if fields.anchor is not None:
        held = torch.where(known, fields.anchor, held)
    r = fields.anchor_weight
    if r is not None and r[0].numel() > 1 and is_concrete(r):
        r = r if bool((r[..., 1:-1, 1:-1] > 0).any()) else None  # the usual case: anchors on the border alone
    if fields.mask is None and fields.weight is None and (r is None or r[0].numel() == 1):
        return _direct(fields, held, r)
    return _iterative(fields, mask, known, held, tol, max_iter, z0)


def _direct(fields: Fields, held: Tensor, r: Tensor | None) -> SolveResult:
    a = GradientOperator("forward", fields.steps)
    z = held
    if min(held.shape[-2:]) > 2:
        b = a.adjoint(edge_slopes(fields.gradient)[0] - a(held))
        if r is not None and fields.anchor is not None:
            b = b + r * fields.anchor
        b = b[..., 1:-1, 1:-1]
        eigenvalues = dirichlet_eigenvalues((b.shape[-2], b.shape[-1]), b, fields.steps)
        z = held + F.pad(dst2(dst2(b) / (eigenvalues if r is None else eigenvalues + r)), (1, 1, 1, 1))
    zeros = torch.zeros(z.shape[0], dtype=z.dtype, device=z.device)
    return SolveResult(z, zeros.long(), zeros, zeros == 0)


def _iterative(
    fields: Fields, mask: Tensor, known: Tensor, held: Tensor, tol: float, max_iter: int, z0: Tensor | None
) -> SolveResult:
    """An edge from a pixel to the border is an anchor of the pixel: its weight is that of the edge."""
    a = GradientOperator("forward", fields.steps)
    v, w = edges_of(fields._replace(mask=mask))
    assert w is not None
    touching = a(known.to(w.dtype)) != 0  # edges with one end on the border; those with both ends there do not matter
    inner, outer = torch.where(touching | known, 0, w), torch.where(touching, w, 0)
    weight = -a.adjoint(outer * a(known.to(w.dtype)))
    pull = a.adjoint(outer * (v - a(held)))
    if fields.anchor is not None and fields.anchor_weight is not None:
        weight, pull = weight + fields.anchor_weight, pull + fields.anchor_weight * fields.anchor
    weight = torch.where(mask & ~known, weight, 0)
    anchor = torch.where(weight > 0, pull, 0) / torch.where(weight > 0, weight, 1)
    inside = solve(v, inner, anchor, weight, tol=tol, max_iter=max_iter, z0=z0, pixel_size=fields.steps)
    return inside._replace(height=torch.where(known, held, inside.height))
