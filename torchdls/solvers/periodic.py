"""The solve (*) on a torus: the last column is beside the first, the last row above the first."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls.operators import GradientOperator
from torchdls.operators.modes import mode_eigenvalues


@full_precision
def solve_periodic(
    v: Tensor,
    anchor: Tensor | None = None,
    anchor_weight: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
) -> Tensor:
    r"""Heights whose differences around the torus come nearest to the slopes, by Fourier transforms.

        z = argmin_z  1/2 \sum_e ((A z)_e - v_e)^2  +  r/2 \sum_i (z_i - a_i)^2,     (A^T A + r) z = A^T v + r a

    with A the periodic forward differences. The mean slope, which no periodic surface has, is dropped. The mean of the
    height is that of the anchor, or 0 where r = 0.

    Args:
        v: (N, 2, H, W) slopes on the edges, as `wrapped_edge_slopes` gives them.
        anchor: (N, 1, H, W), or None for 0.
        anchor_weight: r, (N, 1, 1, 1), or None for 0.
        pixel_size: (dx, dy).

    Returns:
        (N, 1, H, W); differentiable any number of times.

    Source: Frankot, Chellappa (1988), with the differences of Simchony, Chellappa, Shao (1990).
    """
    h, w = v.shape[-2:]
    b = GradientOperator("forward", pixel_size, "periodic").adjoint(v)
    eigenvalues = mode_eigenvalues((h, w), b, pixel_size, "periodic")[:, : w // 2 + 1]
    mean: Tensor | float = 0.0
    if anchor_weight is not None:
        eigenvalues = eigenvalues + anchor_weight
        if anchor is not None:  # its mean is set apart: that of the height is the same, however weak the anchor is
            mean = torch.where(anchor_weight > 0, anchor.mean((-2, -1), keepdim=True), 0)
            b = b + anchor_weight * (anchor - mean)
    some = eigenvalues > 0
    gain = torch.where(some, 1 / torch.where(some, eigenvalues, 1), 0)
    return mean + torch.fft.irfft2(torch.fft.rfft2(b) * gain, s=(h, w))
