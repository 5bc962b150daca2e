"""Overlapping patches of a sequence of images: rows x columns x frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdls._checks import check_real, require
from torchdls._precision import full_precision
from torchdls.operators import Patches


@dataclass(frozen=True)
class SequencePatches:
    """The maps P_j that cut a sequence into overlapping patches of rows, columns and frames, covering every sample.

    Along rows and columns they lie as those of `Patches`, along the frames as those of a line: from 0 on in steps of
    `frame_stride`, and one more flush with the end where the last of them does not reach it. A patch is flattened pixel
    by pixel, each with its frames: a matrix (pixels, frames), whose rank `DinoKat(rank, (pixels, frames))` bounds.

    Args:
        size: rows and columns of a patch, or one number for both.
        frames: frames of a patch.
        stride: step between patches along rows and columns; at most the size.
        frame_stride: step between patches along the frames; at most `frames`.

    Raises:
        ValueError: a size or stride is not a positive integer, or a stride exceeds its size.

    Example:
        >>> patches = torchdls.SequencePatches(4, frames=3)
        >>> x = patches.extract(torch.zeros(1, 5, 1, 8, 6))
        >>> x.shape  # (3 x 2) x 3 patches of 16 pixels in 3 frames
        torch.Size([1, 48, 18])
        >>> patches.adjoint(x, (5, 1, 8, 6)).shape
        torch.Size([1, 5, 1, 8, 6])
    """

    size: int | tuple[int, int] = 8
    frames: int = 5
    stride: int | tuple[int, int] = 2
    frame_stride: int = 1

    def __post_init__(self) -> None:
        for name in ("frames", "frame_stride"):
            value = getattr(self, name)
            good = isinstance(value, int) and not isinstance(value, bool) and value > 0
            require(good, f"{name}: {value!r} given, a positive integer is needed")
        given = f"frame_stride: {self.frame_stride} exceeds the {self.frames} frames of a patch"
        require(self.frame_stride <= self.frames, f"{given} and would leave frames uncovered")
        object.__setattr__(self, "size", self._plane.size)
        object.__setattr__(self, "stride", self._plane.stride)

    @property
    def _plane(self) -> Patches:
        return Patches(self.size, self.stride)

    @property
    def n_samples(self) -> int:
        """n, the number of samples of a patch."""
        return self._plane.n_pixels * self.frames

    def starts(self, n_frames: int) -> Tensor:
        """The first frame of each patch in time; ValueError where the sequence is shorter than a patch."""
        require(n_frames >= self.frames, f"a sequence of {n_frames} frames is shorter than a patch of {self.frames}")
        first = torch.arange(0, n_frames - self.frames + 1, self.frame_stride, device="cpu")
        last = n_frames - self.frames
        return first if int(first[-1]) == last else torch.cat([first, first.new_tensor([last])])

    @full_precision
    def extract(self, z: Tensor) -> Tensor:
        """All patches: (N, T, 1, H, W) -> (N, n, L), patch by patch of the grid, each with all its starts in time.

        TypeError for a dtype other than float32 and float64, ValueError for another shape.
        """
        check_real("SequencePatches", "z", z)
        fits = z.ndim == 5 and z.shape[2] == 1
        require(fits, f"SequencePatches: z {tuple(z.shape)} given, (N, T, 1, H, W) is needed")
        x = self._plane.extract(z.flatten(0, 1)).unflatten(0, z.shape[:2])  # (N, T, pixels, L)
        at = self._frames_of(z.shape[1], z.device)
        return x[:, at].permute(0, 3, 2, 4, 1).flatten(3, 4).flatten(1, 2)

    @full_precision
    def adjoint(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        """Exact transpose, summing overlaps: (N, n, L) -> (N, T, 1, H, W), the last four of them those of `shape`."""
        frames, height, width = shape[-4], shape[-2], shape[-1]
        at, count = self._frames_of(frames, x.device), len(self.starts(frames))
        check_real("SequencePatches", "x", x)
        rows, columns = self._plane.grid((height, width))
        needed = (self.n_samples, rows * columns * count)
        fits = x.ndim == 3 and tuple(x.shape[1:]) == needed
        require(fits, f"SequencePatches: x {tuple(x.shape)} given, (N, {needed[0]}, {needed[1]}) is needed")
        parts = x.unflatten(1, (-1, self.frames)).unflatten(3, (-1, count)).permute(0, 4, 2, 1, 3)
        whole = parts.new_zeros(len(x), frames, *parts.shape[-2:])
        whole = whole.index_add(1, at.flatten(), parts.flatten(1, 2))
        return self._plane.adjoint(whole.flatten(0, 1), (height, width)).unflatten(0, (len(x), frames))

    def coverage(self, shape: Sequence[int], *, like: Tensor) -> Tensor:
        """(1, T, 1, H, W): how many patches hold each sample, for (T, 1, H, W) the last four of `shape`."""
        at = self._frames_of(shape[-4], like.device).flatten()
        times = like.new_zeros(shape[-4]).index_add(0, at, torch.ones_like(at, dtype=like.dtype))
        plane = self._plane.coverage(shape, dtype=like.dtype, device=like.device)
        return times.view(1, -1, 1, 1, 1) * plane[:, None]

    def _frames_of(self, n_frames: int, device: torch.device) -> Tensor:
        """(starts, frames): the frames of each patch in time."""
        return (self.starts(n_frames)[:, None] + torch.arange(self.frames, device="cpu")).to(device)
