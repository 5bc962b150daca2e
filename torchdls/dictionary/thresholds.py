r"""How a code is shrunk, and what it then costs: each rule is the minimiser of (b - x)^2 + penalty(b).

| rule | b for x >= 0 (odd in x) | penalty |
|---|---|---|
| "hard" | x where x > mu, else 0 | mu^2 [b != 0] |
| "soft" | max(x - mu, 0) | 2 mu \|b\| |
| "firm" | 0 up to mu, 2 (x - mu) up to 2 mu, x beyond | 2 mu \|b\| - b^2/2 up to \|b\| = 2 mu, 2 mu^2 beyond |

"hard" is the paper's. Its codes do not move with mu (the derivative is zero almost everywhere), so to train mu choose
"soft" or "firm": both are continuous and have a derivative in mu. Soft shrinks every code by mu, firm leaves large ones
alone. Sources: Donoho, Johnstone 1994; Gao, Bruce 1997 (firm); Zhang 2010 (its penalty, the minimax concave one).
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

Threshold = Literal["hard", "soft", "firm"]
THRESHOLDS: tuple[Threshold, ...] = ("hard", "soft", "firm")

# Codes that are counted at once: PyTorch takes nine bytes of memory for each.
_AT_ONCE = 2**20


def shrink(x: Tensor, mu: float | Tensor, bound: float = math.inf, rule: Threshold = "hard") -> Tensor:
    """Minimiser b of (b - x)^2 + penalty(b) over [-bound, bound]; 0 where |x| = mu. Shapes broadcast."""
    if rule == "hard":
        edge = cut(mu, bound)
        b = torch.hardshrink(x, edge) if isinstance(edge, float) else torch.where(x.abs() > edge, x, 0)
    else:
        size = x.abs()
        rest = torch.where(size > mu, x.sign() * (size - mu), 0)
        b = rest if rule == "soft" else torch.where(size > 2 * mu, x, 2 * rest)
    return b if math.isinf(bound) else b.clamp(-bound, bound)


def cut(mu: float | Tensor, bound: float) -> float | Tensor:
    """Up to where a code is cut: mu, but beyond a bound below mu a clipped code must still save mu^2.

    There x^2 - (x - bound)^2 > mu^2.
    """
    if math.isinf(bound):
        return mu
    if isinstance(mu, float):
        return (mu**2 + bound**2) / (2 * bound) if mu > bound else mu
    return torch.where(mu > bound, (mu.square() + bound**2) / (2 * bound), mu)


def penalty(b: Tensor, mu: Tensor, rule: Threshold = "hard") -> Tensor:
    """What each code costs under the rule; the objective weighs the sum by lam."""
    if rule == "hard":
        return torch.where(b != 0, mu.square(), 0)  # not a product: mu may be so large that its square is infinite
    size = b.abs()
    if rule == "soft":
        return 2 * mu * size
    return torch.where(size < 2 * mu, 2 * mu * size - size.square() / 2, 2 * mu.square())


def total_penalty(B: Tensor, mu: Tensor, rule: Threshold = "hard") -> Tensor:
    """(N,) the penalties of all codes (N, K, L) of each surface, with one mu (N,) for each."""
    if rule == "hard":
        rows = max(1, _AT_ONCE // max(1, B.shape[0] * B.shape[2]))
        count = torch.stack([part.count_nonzero((1, 2)) for part in B.split(rows, 1)]).sum(0)
        return torch.where(count > 0, mu.square() * count, 0)
    return penalty(B, mu[:, None, None], rule).sum((1, 2))
