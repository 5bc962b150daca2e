"""From the noise of normals to that of the slopes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_field, check_fit
from torchdls._precision import full_precision
from torchdls.geometry.cameras import inverse_camera, pixel_grid
from torchdls.geometry.conventions import NORMAL_CONVENTIONS, inverse_axes, permute
from torchdls.geometry.normals import normals_to_gradient

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # the entries of a symmetric 3 x 3 matrix that are kept


class SlopeNoise(NamedTuple):
    """Noise of slopes, pixel by pixel.

    Attributes:
        covariance: (N, 3, H, W), the entries xx, xy, yy of the symmetric covariance of (dz/dx, dz/dy); 0 where the
            slopes are unknown.
        weight: (N, 2, H, W), 1 / xx and 1 / yy, the `weight` of an integrator, for each component its own, in units
            that make its mean 1 over the slopes where it is positive; 0 where the slopes, or their noise, are unknown.

    Example:
        >>> noise = torchdls.slope_noise(torch.zeros(1, 3, 4, 5), torch.ones(1, 6, 4, 5))
        >>> noise.covariance.shape, noise.weight.shape
        (torch.Size([1, 3, 4, 5]), torch.Size([1, 2, 4, 5]))
    """

    covariance: Tensor
    weight: Tensor


@full_precision
def slope_noise(normals: Tensor, covariance: Tensor, *, camera: Tensor | None = None, eps: float = 1e-2) -> SlopeNoise:
    r"""Covariance of the slopes of normals whose covariance is given, to first order, and the trusts in them.

        C_g = J C_n J^T,     J = (S - g c^T) / (c.n)     for the slopes g = S n / (c.n) of `normals_to_gradient`

    with S = (-1, 0, 0; 0, 1, 0) and c = (0, 0, 1), or those of the camera. A steep slope is noisier across its rise
    than along it; integrators take the diagonal (`weight`), the correlation of the two components is left out there.
    On photometric normals of ten images it was no better than `PhotometricResult.confidence`, which is one trust for
    both components; nor are the variances of the true normals (benchmarks/results/third_experiment.md).

    Args:
        normals: (N, 3, H, W) or (3, H, W), canonical (x right, y up, z to the viewer), of the length that the
            covariance belongs to.
        covariance: (N, 6, H, W) or (6, H, W), its entries xx, xy, xz, yy, yz, zz, as of `PhotometricResult`.
        camera: intrinsics (3, 3) or (N, 3, 3): the noise is then that of the gradient of log depth.
        eps: smallest cosine that counts as visible, as in `normals_to_gradient`.

    Returns:
        SlopeNoise(covariance, weight); unbatched input comes back unbatched.

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: a shape, the camera or `eps` is not usable.

    Example:
        >>> normals = torch.tensor([0.6, 0.0, 0.8]).view(1, 3, 1, 1)
        >>> alike = torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]).view(1, 6, 1, 1)  # the same in all directions
        >>> torchdls.slope_noise(normals, alike).covariance.flatten().round(decimals=3)  # steep along x
        tensor([2.4410, 0.0000, 1.5620])
    """
    check_field("slope_noise", "normals", normals, 3)
    check_fit("slope_noise", "covariance", covariance, normals, "normals", channels=(6,))
    field = normals_to_gradient(normals, camera=camera, eps=eps)
    single = normals.ndim == 3
    n, g, inside, entries = (t[None] if single else t for t in (normals, field.gradient, field.mask, covariance))
    n, entries = torch.where(inside, n, 0), torch.where(inside, entries, 0)
    S, c = _linear(n, camera)
    depth = torch.where(inside, (c * n).sum(1, keepdim=True), 1)
    J = (S - g[:, :, None] * c[:, None]) / depth[:, :, None]  # (N, 2, 3, H, W)
    C = entries[:, [_PAIRS.index((min(i, j), max(i, j))) for i in range(3) for j in range(3)]].unflatten(1, (3, 3))
    JC = torch.einsum("naihw,nijhw->najhw", J, C)
    spread = torch.stack([(JC[:, a] * J[:, b]).sum(1) for a, b in ((0, 0), (0, 1), (1, 1))], 1)
    spread = torch.where(inside, spread, 0)
    variance = spread[:, ::2]
    known = variance > 0
    weight = torch.where(known, 1 / torch.where(known, variance, 1), 0)
    mean = weight.sum((-3, -2, -1), keepdim=True) / known.sum((-3, -2, -1), keepdim=True).clamp(min=1)
    weight = weight / torch.where(mean > 0, mean, 1)
    return SlopeNoise(*(t[0] if single else t for t in (spread, weight)))


def _linear(n: Tensor, camera: Tensor | None) -> tuple[Tensor, Tensor]:
    """S (N or 1, 2, 3, H or 1, W or 1) and c (N or 1, 3, H or 1, W or 1) of the slopes g = S n / (c.n)."""
    if camera is None:
        S = n.new_tensor([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])[None, :, :, None, None]
        return S, n.new_tensor([0.0, 0.0, 1.0])[None, :, None, None]
    k_inv = inverse_camera(camera, n).reshape(-1, 3, 3)
    basis = torch.eye(3, dtype=n.dtype, device=n.device)[:, :, None]
    lift = k_inv.mT @ permute(basis, inverse_axes(NORMAL_CONVENTIONS["opencv"]))[..., 0]  # l = K^-T n
    return lift[:, :2, :, None, None], -torch.einsum("nij,ihw->njhw", lift, pixel_grid(n))
