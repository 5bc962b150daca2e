"""Dictionary least squares frame by frame, each from what the last one learned."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchdls._precision import full_precision
from torchdls.dictionary import dct_dictionary
from torchdls.dictionary.learners import Learner, Step
from torchdls.operators import Patches
from torchdls.sequences.common import Frames, centred, check_sequence, choose_learner, codes_like, positive, strength


class OnlineDLS(nn.Module):
    r"""Online dictionary least squares: every frame starts from the dictionary and the codes of the one before.

        min over z_t, B_t, D   1/2 ||A z_t - v_t||^2 + lam ( \sum_j ||P_j z_t - D b_j||^2 + mu^2 ||B_t||_0 )

    for t = 1 .. T in turn, by the iteration of `DLS`: `first` iterations for the first frame, `n_iter` for each of the
    others, which begin with D and B of frame t - 1 and least squares for z_t. For streams (tactile sensors, adaptive
    optics), whose patches change little from frame to frame: a few iterations then do what `DLS` needs dozens for, and
    frames that have passed are not needed again. It removes no more noise than `DLS` on each frame; where frames are
    alike, `SequenceDLS` does.

    The derivative is that of the iterations run, as in `DLS`. Frames are full rectangles of equal trust.

    Args:
        patch_size: rows and columns of a patch, or one number for both.
        stride: step between patches.
        lam: weight of the patch model, positive.
        mu: threshold for heights in pixels, or "auto": the noise of the slopes, over all frames.
        n_iter: iterations for a frame.
        first: iterations for the first frame.
        learner: a name of `torchdls.dictionary.LEARNERS` or a learner.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of range.

    Source: after Moore, Ravishankar, Nadakuditi, Fessler, "Online adaptive image reconstruction (OnAIR) using
    dictionary models", IEEE Transactions on Computational Imaging 6, 2020; without their window over several frames.

    Example:
        >>> surface = torchdls.SURFACES["tent"](24)
        >>> frames = surface.gradient.expand(3, -1, -1, -1)
        >>> noisy = torchdls.add_noise(frames, 10, torch.Generator().manual_seed(0))
        >>> torchdls.OnlineDLS(first=5, n_iter=2)(noisy[None]).shape
        torch.Size([1, 3, 1, 24, 24])
    """

    def __init__(
        self,
        patch_size: int | tuple[int, int] = 8,
        stride: int | tuple[int, int] = 2,
        lam: float = 0.5,
        mu: float | str = "auto",
        n_iter: int = 5,
        first: int = 30,
        *,
        learner: str | Learner = "soup_dil",
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__()
        positive("OnlineDLS", n_iter=n_iter, first=first)
        self.patches, self.pixel_size = Patches(patch_size, stride), pixel_size
        self.lam, self.mu = strength("OnlineDLS", "lam", lam), strength("OnlineDLS", "mu", mu)
        self.n_iter, self.first, self.learner = n_iter, first, choose_learner("OnlineDLS", learner)

    @full_precision
    def forward(self, gradient: Tensor) -> Tensor:
        """Heights (N, T, 1, H, W) of a sequence (N, T, 2, H, W), or without the batch dimension.

        TypeError or ValueError where the gradient is no such sequence, or its frames are smaller than a patch.
        """
        sequence = check_sequence("OnlineDLS", gradient)
        whole = Frames(sequence, self.pixel_size)
        mu = whole.noise(sequence) if self.mu == "auto" else sequence.new_full((len(sequence),), float(self.mu))
        D = dct_dictionary(self.patches.size, dtype=sequence.dtype, device=sequence.device)
        D, B, heights = D.expand(len(sequence), -1, -1), None, []
        for t in range(sequence.shape[1]):
            frame = Frames(sequence[:, t : t + 1], self.pixel_size)
            z, D, B = self._fit(frame, D, B, mu, self.n_iter if t else self.first)
            heights.append(z)
        z = centred(torch.cat(heights, 1)) * whole.unit
        return z if gradient.ndim == 5 else z[0]

    def _fit(self, frame: Frames, D: Tensor, B: Tensor | None, mu: Tensor, n_iter: int) -> Step:
        """Height (N, 1, 1, H, W), dictionary and codes of one frame."""
        z = frame.height()
        coverage = self.patches.coverage(z.shape, dtype=z.dtype, device=z.device)[None]
        P = self.patches.extract(z[:, 0])
        B = codes_like(P, D) if B is None else B
        for _ in range(n_iter):
            _, D, B = self.learner(P - D @ B, D, B, mu[:, None])
            fold = self.patches.adjoint(D @ B, z.shape)[:, None]
            z = frame.height(None, fold / coverage, 2 * float(self.lam) * coverage)
            P = self.patches.extract(z[:, 0])
        return z, D, B
