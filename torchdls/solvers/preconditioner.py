"""The preconditioner of the solve (*)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdls.operators.edges import edge_ends
from torchdls.solvers.cg import LinearMap
from torchdls.solvers.direct import direct_map

# From this ratio of anchor to edge weight on, the diagonal is the cheaper preconditioner (measured on a CPU).
FIRM = 0.25


# Side of the blocks over which the preconditioner averages weights.
BLOCK = 16


def preconditioner(w: Tensor, r: Tensor, pixel_size: tuple[float, float], weak: bool = False) -> LinearMap:
    r"""The map b -> S (A^T A + rho)^{-1} S b: a direct solve between two diagonal scalings.

    With d the weight of the edges around a pixel (see `local_weight`) and k = 2/dx^2 + 2/dy^2 the diagonal of A^T A,
    the scaling s_i^2 = (k + rho) / (k d_i + r_i) matches the diagonals, and rho is the mean of the scaled anchor
    weights s_i^2 r_i: rho = k q / (1 - q) with q = mean(r_i / (k d_i + r_i)). Equal weights give back the exact
    inverse; a few strong control points count as a few pixels however strong they are. Dead pixels (no edge, no
    anchor) have s = 0.
    All of it runs in single precision, at half the cost: it need only be close to the inverse.

    With `weak`, the constants of components are no concern: rho is then 0 or at least a part of the least eigenvalue,
    as anchors of next to no weight would make the constant drown the rest.
    Where the anchors hold every surface firmly the diagonal alone does nearly as well, and costs a tenth.
    """
    k = sum(2 / d**2 for d in pixel_size)
    total = k * local_weight(w) + r
    alive = total > 0
    total = torch.where(alive, total, 1)
    n_alive = alive.sum((-3, -2, -1), keepdim=True).clamp(min=1)
    q = torch.where(alive, r / total, 0).sum((-2, -1), keepdim=True) / n_alive
    rest = torch.where(alive, 1 - r / total, 0).sum((-2, -1), keepdim=True) / n_alive
    rho = k * q / rest.clamp(min=1e-6)
    if weak:
        least = min((math.pi / n / d) ** 2 for n, d in zip(w.shape[:-3:-1], pixel_size, strict=True))
        rho = torch.where(rho > 0, rho.clamp(min=0.1 * least), 0)
    if bool((rho > FIRM * k).all()):
        scale = torch.tensor(pixel_size, dtype=w.dtype, device=w.device).view(1, 2, 1, 1)
        diagonal = edge_ends(w / scale.square()) + r
        inverse = torch.where(alive, 1 / torch.where(alive, diagonal, 1), 0)
        return lambda b: b * inverse
    s = torch.where(alive, ((k + rho) / total).sqrt(), 0)
    direct = direct_map((w.shape[-2], w.shape[-1]), rho.float(), pixel_size, s.float())
    return lambda b: s * direct((s * b).float())


def local_weight(w: Tensor) -> Tensor:
    """(N, 1, H, W): geometric mean of the weights of the live edges within some pixels; 0 where a pixel has none.

    Weights that vary from pixel to pixel at random act together as one weight, this mean, while slow changes are felt
    where they are. (Followed pixel by pixel, random weights from .1 to 1 took 490 steps at 256^2; so they take 16.)
    """
    (h, width), c = w.shape[-2:], BLOCK
    live, logs = edge_ends((w > 0).to(w.dtype)), edge_ends(torch.where(w > 0, w, 1).log())
    count, total = (F.avg_pool2d(F.pad(t, (0, -width % c, 0, -h % c)), c) for t in (live, logs))
    blocks = torch.cat([(count > 0).to(w.dtype), total / torch.where(count > 0, count, 1)], 1)
    seen, mean = F.interpolate(blocks, scale_factor=float(c), mode="bilinear")[..., :h, :width].split(1, 1)
    return torch.where(live > 0, (mean / torch.where(live > 0, seen, 1)).exp(), 0)
