"""Sequences as a low-rank part and one that is sparse in a learned dictionary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchdls._precision import full_precision
from torchdls.dictionary import dct_dictionary
from torchdls.dictionary.learners import Learner
from torchdls.operators import GradientOperator
from torchdls.sequences.common import Frames, centred, check_sequence, choose_learner, codes_like, positive, strength
from torchdls.sequences.patches import SequencePatches


class SequenceResult(NamedTuple):
    """What `SequenceDLS.solve` returns; always batched.

    Attributes:
        height: (N, T, 1, H, W), of zero mean in each frame.
        low_rank: (N, T, 1, H, W), the part of few shapes.
        sparse: (N, T, 1, H, W), the rest; both before their free constants are taken out.
        dictionary: (N, n, K), atoms of rows x columns x frames.
        codes: (N, K, L).
        objective: (N, n_iter + 1), from the start on, for heights in pixels; it never rises.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](16)
        >>> frames = surface.gradient.expand(1, 3, -1, -1, -1)
        >>> result = torchdls.SequenceDLS(patch_size=4, frames=3, n_iter=2).solve(frames)
        >>> result.height.shape, result.dictionary.shape
        (torch.Size([1, 3, 1, 16, 16]), torch.Size([1, 48, 48]))
    """

    height: Tensor
    low_rank: Tensor
    sparse: Tensor
    dictionary: Tensor
    codes: Tensor
    objective: Tensor


class SequenceDLS(nn.Module):
    r"""All frames of a sequence together: a low-rank part, and one that is sparse in a learned dictionary.

        min over L, S, B, D   1/2 \sum_t ||A (L_t + S_t) - v_t||^2 + low_rank^2/2 rank(L)
                              + lam ( \sum_j ||P_j S - D b_j||^2 + mu^2 ||B||_0 ),        z_t = L_t + S_t

    with L as a matrix of pixels x frames and patches P_j of rows, columns and frames (`SequencePatches`). In turn: a
    pass of the learner over B and D; S, by the solve (*) of every frame; and L, from the singular values of the
    integrable slopes of v - A S, of which those up to `low_rank` are left out. Each is exact, and the objective never
    rises.

    What all frames have in common is seen T times, and its noise falls with the root of T: for still or slowly moving
    surfaces (tactile video, adaptive optics). Where frames have little in common it is `DLS` on patches with a third
    axis. The start is S = 0. The derivative is that of the iterations run; that of the singular vectors needs singular
    values that differ. Frames are full rectangles of equal trust.

    Args:
        patch_size: rows and columns of a patch, or one number for both.
        frames: frames of a patch, at most T.
        stride: step between patches along rows and columns.
        frame_stride: step between patches along the frames.
        lam: weight of the patch model, positive.
        mu: threshold for heights in pixels, or "auto": the noise of the slopes.
        low_rank: singular value of the slopes, pixels x frames, up to which they are left out of L; infinite for no
            low-rank part; or "auto": the noise times sqrt(H W) + sqrt(T), the largest that noise itself is likely to
            have.
        n_iter: iterations.
        learner: a name of `torchdls.dictionary.LEARNERS` or a learner; `DinoKat(r, (c_y c_x, frames))` has atoms whose
            matrix of pixels x frames is of rank r, as the source has them.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: after Ravishankar, Moore, Nadakuditi, Fessler, "Low-rank and adaptive sparse signal (LASSI) models for
    highly accelerated dynamic imaging", IEEE Transactions on Medical Imaging 36, 2017. There L has a penalty on the sum
    of its singular values, or a rank (OptShrink); a penalty on those of the heights takes away slow waves, which slopes
    hardly see, so it is on the rank here, and its threshold on the slopes. Their lam is twice this one.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](24)
        >>> still = surface.gradient.expand(8, -1, -1, -1)
        >>> noisy = torchdls.add_noise(still, 0, torch.Generator().manual_seed(0))
        >>> heights = torchdls.LeastSquares()(noisy), torchdls.SequenceDLS(n_iter=5)(noisy)
        >>> [round(float(torchdls.rmse(z, surface.height.expand_as(z)).mean()), 2) for z in heights]
        [0.28, 0.12]
    """

    def __init__(
        self,
        patch_size: int | tuple[int, int] = 8,
        frames: int = 5,
        stride: int | tuple[int, int] = 2,
        frame_stride: int = 1,
        lam: float = 0.5,
        mu: float | str = "auto",
        low_rank: float | str = "auto",
        n_iter: int = 30,
        *,
        learner: str | Learner = "soup_dil",
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__()
        positive("SequenceDLS", n_iter=n_iter)
        self.patches, self.pixel_size = SequencePatches(patch_size, frames, stride, frame_stride), pixel_size
        self.lam, self.mu = strength("SequenceDLS", "lam", lam), strength("SequenceDLS", "mu", mu)
        self.low_rank = strength("SequenceDLS", "low_rank", low_rank)
        self.n_iter, self.learner = n_iter, choose_learner("SequenceDLS", learner)

    def forward(self, gradient: Tensor) -> Tensor:
        """Heights (N, T, 1, H, W) of a sequence (N, T, 2, H, W), or without the batch dimension; see `solve`."""
        height = self.solve(gradient).height
        return height if gradient.ndim == 5 else height[0]

    @full_precision
    def solve(self, gradient: Tensor) -> SequenceResult:
        """The sequence, and all that was found on the way.

        Args:
            gradient: (N, T, 2, H, W) or (T, 2, H, W), float32 or float64.

        Returns:
            SequenceResult, batched.

        Raises:
            TypeError: the gradient is not a tensor of floats.
            ValueError: its shape does not fit, it is not finite, or it is smaller than a patch.
        """
        sequence = check_sequence("SequenceDLS", gradient)
        frames = Frames(sequence, self.pixel_size)
        noise = frames.noise(sequence) if "auto" in (self.mu, self.low_rank) else sequence.new_zeros(len(sequence))
        mu = noise if self.mu == "auto" else torch.full_like(noise, float(self.mu))
        (n, t), pixels = sequence.shape[:2], math.prod(sequence.shape[-2:])
        size = pixels**0.5 + t**0.5
        level = noise * size if self.low_rank == "auto" else torch.full_like(noise, float(self.low_rank))
        sides = self.patches.size, (1, self.patches.frames)
        D = torch.kron(*(dct_dictionary(side, dtype=torch.float64) for side in sides))
        D = D.to(sequence).expand(n, -1, -1)
        z = centred(frames.height())
        S, L = torch.zeros_like(z), torch.zeros_like(z)
        problem = _Problem(frames, self.patches, float(self.lam), mu, level)
        B = codes_like(self.patches.extract(z[:1]), D).expand(n, -1, -1).clone()
        if self.low_rank == math.inf:
            S = z
        else:
            L = problem.low_rank_part(S)
        costs = [problem.cost(L, S, D, B)]
        for _ in range(self.n_iter):
            _, D, B = self.learner(self.patches.extract(S) - D @ B, D, B, mu[:, None])
            S = problem.sparse_part(L, D, B)
            L = L if self.low_rank == math.inf else problem.low_rank_part(S)
            costs.append(problem.cost(L, S, D, B))
        unit = frames.unit
        return SequenceResult(centred(L + S) * unit, L * unit, S * unit, D, B * unit, torch.stack(costs, 1))


class _Problem(NamedTuple):
    """The functional of a sequence and its steps."""

    frames: Frames
    patches: SequencePatches
    lam: float
    mu: Tensor
    level: Tensor

    def cost(self, L: Tensor, S: Tensor, D: Tensor, B: Tensor) -> Tensor:
        """(N,) its value."""
        n = len(L)
        slopes = GradientOperator("forward", self.frames.steps)((L + S).flatten(0, 1))
        data = (slopes - self.frames.slopes).square().view(n, -1).sum(1) / 2
        fit = (self.patches.extract(S) - D @ B).square().flatten(1).sum(1)
        used = (B != 0).flatten(1).sum(1)
        values = torch.linalg.svdvals(slopes_of(L, self.frames).flatten(2))
        rank = (values > 100 * torch.finfo(values.dtype).eps * values[:, :1]).sum(1)
        level = torch.where(rank > 0, self.level.square() / 2 * rank, 0)
        return data + level + self.lam * (fit + self.mu.square() * used)

    def sparse_part(self, L: Tensor, D: Tensor, B: Tensor) -> Tensor:
        """S for the other variables: exact."""
        coverage = self.patches.coverage(L.shape, like=L)
        fold = self.patches.adjoint(D @ B, L.shape)
        return self.frames.height(L, fold / coverage, 2 * self.lam * coverage)

    def low_rank_part(self, S: Tensor) -> Tensor:
        """L for S: exact, since what is left of the singular vectors of integrable slopes is integrable."""
        rest = self.frames.height(S)
        slopes = slopes_of(rest, self.frames).flatten(2)
        square, U = torch.linalg.eigh(slopes @ slopes.mT)
        kept = (square > self.level.square()[:, None]).to(U.dtype)
        share = (U * kept[:, None]) @ U.mT  # frames x frames
        return (share @ rest.flatten(2)).view_as(rest)


def slopes_of(z: Tensor, frames: Frames) -> Tensor:
    """(N, T, 2, H, W), A z."""
    return GradientOperator("forward", frames.steps)(z.flatten(0, 1)).unflatten(0, z.shape[:2])
