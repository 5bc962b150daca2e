"""Sparse codes of slopes: one pass over all patches of one size, thresholded by the noise that each atom sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torchdls._tracing import is_recorded
from torchdls.dictionary import dct_dictionary, soup_dil_sweep
from torchdls.noise import cosine_noise, slope_covariance
from torchdls.operators import Patches
from torchdls.operators.cosine import cosine_matrix

Aggregate = Literal["mean", "sparsity"]

_GOLDEN = 0.381966  # of a stride: the shifts of the patch grid from one iteration to the next, never in step


class Noise(NamedTuple):
    """The level of the noise in the slopes.

    Attributes:
        level: (N,) for a trust of 1.
        trust: (N, 2, H, W) relative inverse variance on the edges, or None for 1 everywhere.
        pixels: (N, 1 or 2, H, W) the same of the samples, likewise.
        overall: (N,) for the largest trust of a surface, which is the trust of all samples where it is `even`.
        even: (N, 1, 1, 1) bool: whether the surface is a full rectangle with one trust everywhere and no anchor.
    """

    level: Tensor
    trust: Tensor | None
    pixels: Tensor | None
    overall: Tensor
    even: Tensor


class Coded(NamedTuple):
    """Estimates of the slopes summed over the patches, (N, 2, H, W), and their weights, which broadcast to it."""

    total: Tensor
    weight: Tensor


@dataclass(frozen=True)
class SlopeScale:
    """The patches of one size, on a grid that may start before the image.

    Args:
        size: rows and columns of a patch; patches overlap by three quarters.
        steps: the sides of a pixel (dx, dy), of which only the ratio counts.
        offset: rows and columns by which the grid starts before the image; the slopes are continued there.
    """

    size: tuple[int, int]
    steps: tuple[float, float]
    offset: int = 0

    @property
    def patches(self) -> Patches:
        """The patches on the continued image."""
        rows, columns = self.size
        return Patches(self.size, (max(1, rows // 4), max(1, columns // 4)))

    def shifted(self, iteration: int) -> SlopeScale:
        """The same patches on the grid of an iteration."""
        stride = max(1, min(self.size) // 4)
        return replace(self, offset=round(iteration * _GOLDEN * stride) % stride)

    def extract(self, field: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, n, L)."""
        o, shape = self.offset, field.shape[:2]
        field = functional.pad(field, (o, 0, o, 0), mode="replicate")
        return self.patches.extract(field.flatten(0, 1)[:, None]).unflatten(0, shape)

    def fold(self, patches: Tensor, shape: torch.Size) -> Tensor:
        """(N, C, n, L) -> (N, C, H, W), summing overlaps; what lies before the image is dropped."""
        o = self.offset
        field = self.patches.adjoint(patches.flatten(0, 1), (shape[-2] + o, shape[-1] + o))
        return field[:, 0, o:, o:].unflatten(0, patches.shape[:2])

    def coverage(self, like: Tensor) -> Tensor:
        """(1, 1, H, W), the number of patches over each pixel."""
        o, (h, w) = self.offset, like.shape[-2:]
        return self.patches.coverage((h + o, w + o), dtype=like.dtype, device=like.device)[..., o:, o:]

    def level(self, noise: Noise) -> Tensor:
        """(N, 1 or 2, 1, 1 or L): noise level of each patch, from its mean trust; without any, that of the surface."""
        level = noise.level[:, None, None, None]
        if noise.trust is None:
            return level
        trust = self.extract(noise.trust)
        count = (trust > 0).sum(2, keepdim=True)
        mean = trust.sum(2, keepdim=True) / count.clamp(min=1)
        usual = noise.trust.sum((1, 2, 3)) / (noise.trust > 0).sum((1, 2, 3)).clamp(min=1)
        mean = torch.where(count > 0, mean, usual[:, None, None, None])
        return level * torch.where(mean > 0, mean, 1).rsqrt()

    def code_cosines(self, slopes: Tensor, noise: Noise, tau: float, aggregate: Aggregate) -> Coded:
        """Keep the cosine coefficients of each patch and component that exceed tau times their own noise."""
        down, across = (cosine_matrix(k, like=slopes) for k in self.size)
        threshold = tau * cosine_noise(self.size, slopes, self.steps).flatten(1)[:, :, None] * self.level(noise)
        coefficients = _separable(self.extract(slopes), down, across)
        kept = coefficients.abs() > threshold
        estimate = _separable(torch.where(kept, coefficients, 0), down.mT, across.mT)
        if aggregate == "mean":
            return Coded(self.fold(estimate, slopes.shape), self.coverage(slopes))
        weight = 1 / (1 + kept.sum(2, keepdim=True)).to(slopes.dtype)
        total = self.fold(weight * estimate, slopes.shape)
        return Coded(total, self.fold(weight.expand_as(estimate), slopes.shape))

    def code_atoms(
        self, slopes: Tensor, noise: Noise, tau: float, D: Tensor, B: Tensor | None
    ) -> tuple[Coded, Tensor, Tensor]:
        """One sweep over codes and atoms of both components together, in units of the noise; returns D and B too.

        The codes must go on from those of the last sweep (B None is a start from 0): learned atoms are not orthogonal,
        and a start from 0 each time shrinks what they say together. Patches without noise are their own estimate: atoms
        learned from what rounding leaves of a plane would have no derivative.
        """
        level = self.level(noise).mean(1)
        P = self.extract(slopes)
        scale = torch.where(level > 0, level, 1)
        covariance = slope_covariance(self.size, slopes, self.steps)
        threshold = tau * ((covariance @ D.detach()) * D.detach()).sum(1).clamp(min=0).sqrt()
        noisy = level > 0
        B = P.new_zeros(P.shape[0], D.shape[-1], P.shape[-1]) if B is None else B / scale
        flat = P.flatten(1, 2)
        noisy_patches = torch.where(noisy, flat / scale, 0)
        D, B = soup_dil_sweep(noisy_patches, D, B, threshold, order="block", unused="keep")
        B = B * scale
        estimate = torch.where(noisy, D @ B, flat)
        return Coded(self.fold(estimate.view_as(P), slopes.shape), self.coverage(slopes)), D, B

    def initial_dictionary(self, slopes: Tensor) -> Tensor:
        """(N, 2n, 2n): cosines of the slopes in x and, separately, in y."""
        d = dct_dictionary(self.size, dtype=slopes.dtype, device=slopes.device)
        return torch.block_diag(d, d).expand(slopes.shape[0], -1, -1)


def added(part: Coded, so_far: Coded | None) -> Coded:
    """The sum of both, in the memory of the second where nothing is recorded."""
    if so_far is None:
        return part
    if is_recorded(*part, *so_far) or so_far.weight.shape != part.total.shape:
        return Coded(so_far.total + part.total, so_far.weight + part.weight)
    return Coded(so_far.total.add_(part.total), so_far.weight.add_(part.weight))


def average(parts: Sequence[Coded], otherwise: Tensor | None = None) -> Tensor:
    """(N, 2, H, W): the weighted mean of all estimates of all patches, and another field where no weight is."""
    total, weight = parts[0]
    for part in parts[1:]:
        total, weight = total + part.total, weight + part.weight
    if otherwise is None:
        return total / weight
    some = weight > 0
    return torch.where(some, total / torch.where(some, weight, 1), otherwise)


def _separable(patches: Tensor, down: Tensor, across: Tensor) -> Tensor:
    """`down` along the rows and `across` along the columns of patches (N, C, n, L), n = rows x columns."""
    (rows, columns), count = (down.shape[-1], across.shape[-1]), patches.shape[-1]
    half = down @ patches.reshape(-1, rows, columns * count)
    return (across @ half.view(-1, columns, count)).view_as(patches)
