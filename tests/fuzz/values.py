"""What the code of a case calls: tensors from a few words and a seed."""

from __future__ import annotations

import random
from fractions import Fraction
from typing import Any

import torch
from torch import Tensor

from tests.helpers import seeded

F32, F64 = torch.float32, torch.float64


def field(*shape: int, kind: str = "noise", seed: int = 0, scale: float = 1.0, dtype: torch.dtype = F64) -> Tensor:
    """Noise, waves, a jump, one spike, one constant per channel, or nothing at all."""
    noise = torch.randn(shape, dtype=F64, generator=seeded(seed))
    x = {
        "noise": noise,
        "waves": torch.sin(torch.arange(shape[-1]) * noise.flatten()[0]) + 0.3 * torch.zeros(shape, dtype=F64),
        "jump": noise.sign() * (torch.arange(shape[-1]) * 2 < shape[-1]),
        "spike": torch.where(noise == noise.max(), 1.0, 0.0).double(),
        "constant": noise[..., :1, :1].expand(shape).clone() if len(shape) > 1 else noise,
        "zero": torch.zeros(shape, dtype=F64),
    }[kind]
    return (x * scale).to(dtype).expand(shape).clone()


def trust(*shape: int, kind: str = "even", seed: int = 0, scale: float = 1.0, dtype: torch.dtype = F64) -> Tensor:
    """Weights, at least 0: one number, of order 1, over 21 orders, or with holes."""
    u = torch.rand(shape, dtype=F64, generator=seeded(seed))
    x = {
        "even": torch.ones(shape, dtype=F64),
        "mild": 0.5 + u,
        "orders": 10 ** (21 * u - 9),
        "holes": torch.where(u < 0.3, 0.0, 0.5 + u),
    }[kind]
    return (x * scale).to(dtype)


def firm(mask: Tensor, kind: str, seed: int, weight: float, dtype: torch.dtype = F64) -> Tensor:
    """Anchor weights: at one pixel of the mask, at some, in its first live column, or at all."""
    inside = mask.flatten(1)
    order = torch.rand(inside.shape, generator=seeded(seed)) * inside
    chosen = {
        "one": order == order.amax(1, keepdim=True),
        "some": order > 0.7,
        "column": (mask & (mask.any(-2, keepdim=True).cumsum(-1) == 1)).flatten(1),
        "all": inside,
    }[kind]
    return torch.where(chosen.view(mask.shape), weight, 0.0).to(dtype)


def mask(n: int, h: int, w: int, kind: str = "full", seed: int = 0) -> Tensor:
    """Bool: full, islands, corridors one pixel wide, a sieve, one lone pixel."""
    rng, m = random.Random(seed), torch.zeros(n, 1, h, w, dtype=torch.bool)
    for one in m[:, 0]:
        if kind == "full":
            one[:] = True
        elif kind == "sieve":
            one |= torch.rand(h, w, generator=seeded(seed)) < 0.6
        elif kind == "islands":
            one[: (h + 1) // 2, : (w + 1) // 2] = True
            one[h // 2 + 1 :, w // 2 + 1 :] = True
        elif kind == "corridors":
            one[:: rng.choice([2, 3])] = True
            one[:, rng.randrange(w)] = True
        one[rng.randrange(h), rng.randrange(w)] = True
    return m


def hide(x: Tensor, inside: Tensor, value: float = torch.nan) -> Tensor:
    """The values outside the mask replaced."""
    return torch.where(inside, x, torch.tensor(value, dtype=x.dtype))


def view(x: Tensor, how: str) -> Tensor:
    """The same values, otherwise laid out; `expanded`: the first surface for all."""
    if how == "strided":
        return torch.stack([x, torch.full_like(x, torch.nan)], -1)[..., 0]
    if how == "turned":
        return x.mT.contiguous().mT
    if how == "negative":
        return torch._neg_view(-x)
    return x[:1].expand_as(x)


def dictionary(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    """Atoms of length 1, columns of random matrices."""
    atoms = torch.randn(shape, dtype=F64, generator=seeded(seed))
    return (atoms / atoms.norm(dim=-2, keepdim=True)).to(dtype)


def rational_solve(v: Tensor, w: Tensor, anchor: Tensor | None, r: Tensor | None) -> Tensor:
    """Minimiser (1, H, W) of (*) for one surface v (2, H, W), without rounding: elimination in rational numbers.

    The constant of a component without anchors is set by a mean of 0, as `solve` promises; lone pixels are 0.
    """
    h, wd = v.shape[-2:]
    n = h * wd
    A = [[Fraction(0)] * (n + 1) for _ in range(n)]  # the last column is the right-hand side
    parent = list(range(n))

    def root(i: int) -> int:
        while parent[i] != i:
            i = parent[i]
        return i

    for c, (dy, dx) in enumerate(((0, 1), (1, 0))):
        for y in range(h - dy):
            for x in range(wd - dx):
                i, j = y * wd + x, (y + dy) * wd + x + dx
                weight, slope = Fraction(float(w[c, y, x])), Fraction(float(v[c, y, x]))
                if not weight:
                    continue
                parent[root(i)] = root(j)
                for a, b, sign in ((i, j, -1), (j, i, 1)):
                    A[a][a] += weight
                    A[a][b] -= weight
                    A[a][n] += sign * weight * slope
    held = [Fraction(0)] * n if r is None else [Fraction(float(x)) for x in r.flatten()]
    for i in range(n):
        A[i][i] += held[i]
        A[i][n] += held[i] * (Fraction(0) if anchor is None else Fraction(float(anchor.flatten()[i])))
    parts: dict[int, list[int]] = {}
    for i in range(n):
        parts.setdefault(root(i), []).append(i)
    z = [Fraction(0)] * n
    for part in parts.values():
        free = not any(held[i] for i in part)
        unknown = part[1:] if free else part
        for i, value in zip(unknown, _eliminate(A, unknown, n), strict=True):
            z[i] = value
        if free:
            mean = sum((z[i] for i in part), Fraction(0)) / len(part)
            for i in part:
                z[i] -= mean
    return torch.tensor([float(x) for x in z], dtype=F64).view(1, h, wd)


def _eliminate(A: list[list[Fraction]], rows: list[int], last: int) -> list[Fraction]:
    """Gauss and Jordan, on a positive definite matrix."""
    M = [[A[i][j] for j in [*rows, last]] for i in rows]
    for k, pivot in enumerate(M):
        for other in M[k + 1 :]:
            if other[k]:
                factor = other[k] / pivot[k]
                other[k:] = [a - factor * b for a, b in zip(other[k:], pivot[k:], strict=True)]
    x: list[Any] = [Fraction(0)] * len(M)
    for k in reversed(range(len(M))):
        known = sum((M[k][j] * x[j] for j in range(k + 1, len(M))), Fraction(0))
        x[k] = (M[k][-1] - known) / M[k][k]
    return x
