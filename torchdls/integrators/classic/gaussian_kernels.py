"""Integration by a sum of Gaussian bumps, one on each pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls.integrators.base import Fields, Integrator
from torchdls.operators.tables import table


class GaussianKernels(Integrator):
    r"""A Gaussian bump on each pixel: one smooth surface whose slopes are those of the bumps, without differences.

        z(x) = p^T x + \sum_j a_j G(x - x_j) + constant,     G(x) = exp(-|x|^2 / (2 sigma^2))
        min over a   sigma^2 \sum_i |grad z(x_i) - g_i|^2 + lam a^T K a,     K_ij = G(x_i - x_j)

    with p the mean slope, so that planes are exact, and the bumps mirrored at the border, so that the normal equations
    are diagonal in Fourier space: one transform of twice the size each way, exact, where dense matrices take N^3. It
    is Frankot-Chellappa with mirrored borders, waves shorter than the bumps taken out: under noise the surface is
    smoother than that of least squares, its slow errors, and so its RMSE, are no smaller. For smooth surfaces, and to
    compare with `integrate_scattered`, the same for slopes that lie on no grid. The mirror flattens what the slopes at
    the border have beyond their mean; creases and jumps are rounded: see `SlopeDLS` for noise, `Bilateral` for jumps.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean.

    Args:
        sigma: width of the bumps in pixels, positive. Far above a pixel there is little that they can follow.
        lam: weight of the penalty, positive; the larger, the more it takes out of the shortest waves, and of the
            longest: at 1e-2 waves of 100 pixels lose a quarter.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is not positive.

    Source: after Ng, Wu, Tang, "Surface-from-gradients without discrete integrability enforcement: a Gaussian kernel
    approach", IEEE TPAMI 32(11), 2010. Their penalty is not confirmed; the plane and the mirror are ours.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> noisy = torchdls.add_noise(surface.gradient, 0, torch.Generator().manual_seed(0))
        >>> methods = torchdls.LeastSquares(), torchdls.GaussianKernels(sigma=2.0, lam=1.0)
        >>> heights = [method(noisy) for method in methods]
        >>> [round(float(torchdls.mean_angular_error(z, surface.height)), 1) for z in heights]  # degrees
        [8.0, 6.4]
    """

    accepts = frozenset()

    def __init__(self, sigma: float = 1.0, lam: float = 1e-4, *, pixel_size: float | Sequence[float] = 1.0) -> None:
        super().__init__(pixel_size=pixel_size)
        check_numbers("GaussianKernels", sigma=sigma, lam=lam)
        if not 0 < sigma < math.inf or not 0 < lam < math.inf:
            raise ValueError(f"GaussianKernels: sigma={sigma!r} and lam={lam!r} given, both must be positive")
        self.sigma, self.lam = sigma, lam

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        g, (dx, dy) = fields.gradient, fields.steps
        (h, w), mean = g.shape[-2:], g.mean((-2, -1), keepdim=True)
        rows, columns = (_spectra(n, self.sigma / step, like=g) for n, step in ((h, dy), (w, dx)))
        gx, gy = (g - mean).split(1, 1)
        across, down = (torch.fft.rfft2(_mirrored(x, odd)) for x, odd in ((gx, -1), (gy, -2)))
        (k_y, d_y), (k_x, d_x) = rows, columns[:, : w + 1]
        value = k_y[:, None] * k_x
        slope_x, slope_y = k_y[:, None] * d_x / dx, d_y[:, None] * k_x / dy
        weight = self.sigma**2 * (slope_x.square() + slope_y.square()) + self.lam * value
        live = weight > torch.finfo(g.dtype).eps ** 2 * weight.max()
        gain = torch.where(live, self.sigma**2 * value / torch.where(live, weight, 1), 0)
        z = torch.fft.irfft2(-1j * gain * (slope_x * across + slope_y * down), s=(2 * h, 2 * w))[..., :h, :w]
        z = z + _plane(mean, h, w, dx, dy)
        return z - z.mean((-2, -1), keepdim=True)


def _mirrored(x: Tensor, odd: int) -> Tensor:
    """(.., 2 H, 2 W): a component of the slopes of a surface that is mirrored at both borders."""
    for dim in (-1, -2):
        x = torch.cat([x, -x.flip(dim) if dim == odd else x.flip(dim)], dim)
    return x


def _plane(slope: Tensor, h: int, w: int, dx: float, dy: float) -> Tensor:
    """The plane of a slope (N, 2, 1, 1)."""
    x = torch.arange(w, dtype=slope.dtype, device=slope.device) * dx
    y = torch.arange(h, dtype=slope.dtype, device=slope.device)[:, None] * dy
    return slope[:, :1] * x + slope[:, 1:] * y


@table
def _spectra(n: int, sigma: float) -> Tensor:
    """(2, 2 n): Fourier transform of the bump on a ring of 2 n pixels, and that of its derivative over i.

    Sharp bumps are summed around the ring, wide ones, by Poisson's formula, over the periods of their own transform.
    """
    turn = torch.arange(-2, 3, dtype=torch.float64, device="cpu")[:, None]
    x = torch.arange(2 * n, dtype=torch.float64, device="cpu")
    if sigma > 1:
        frequency = 2 * math.pi * (x / (2 * n) + turn)
        whole = math.sqrt(2 * math.pi) * sigma * torch.exp(-0.5 * (sigma * frequency).square())
        value, slope = whole.sum(0), (frequency * whole).sum(0)
        slope[0] = slope[n] = 0.0
        return torch.stack([value, slope])
    reach = torch.arange(-(10 // (2 * n) + 1), 10 // (2 * n) + 2, dtype=torch.float64, device="cpu")[:, None]
    x = x + 2 * n * reach
    bump = torch.exp(-x.square() / (2 * sigma**2))
    value = torch.fft.fft(bump.sum(0)).real.clamp(min=0)
    slope = torch.fft.fft((-x / sigma**2 * bump).sum(0)).imag
    slope[0] = slope[n] = 0.0
    return torch.stack([value, slope])
