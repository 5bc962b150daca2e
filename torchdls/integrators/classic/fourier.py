"""Integration in Fourier space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchdls.integrators.base import Fields, Integrator
from torchdls.operators.tables import table

Extension = Literal["periodic", "mirrored"]


class FrankotChellappa(Integrator):
    r"""Projection on the integrable fields in Fourier space.

        Z(k, l) = -i (w_x G_x + w_y G_y) / (w_x^2 + w_y^2),     w_x = 2 pi k / (W dx),  w_y = 2 pi l / (H dy)

    the least-squares surface whose derivative is that of its Fourier series, which is exact for a periodic surface
    without detail beyond the sampling limit. The surface is taken to repeat ("periodic"): then a plane, which does not,
    comes out flat. With "mirrored" it is reflected at its borders first, to twice the size, which makes any surface
    periodic, but leaves creases at the borders: a plane of slope s is off by s/8 pixels there, and hardly inside.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean.

    Args:
        extension: "periodic" or "mirrored".
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: `extension` is unknown or `pixel_size` is not positive.

    Source: Frankot, Chellappa, "A Method for Enforcing Integrability in Shape from Shading Algorithms", IEEE TPAMI
    10(4), 1988.

    Example:
        >>> waves = torch.sin(torch.arange(16.0) * torch.pi / 4).expand(1, 1, 16, 16)
        >>> slopes = torch.cat([waves, 0 * waves], 1)
        >>> round(float(torchdls.FrankotChellappa()(slopes).max()), 3)  # 4 / pi
        1.273
    """

    accepts = frozenset()

    def __init__(self, extension: Extension = "periodic", *, pixel_size: float | Sequence[float] = 1.0) -> None:
        super().__init__(pixel_size=pixel_size)
        if extension not in ("periodic", "mirrored"):
            raise ValueError(
                f"FrankotChellappa: extension={extension!r} is unknown; choose from 'periodic', 'mirrored'"
            )
        self.extension = extension

    def _integrate(self, fields: Fields) -> Tensor:
        """Height (N, 1, H, W) in pixels."""
        gx, gy = fields.gradient.split(1, -3)
        h, w = gx.shape[-2:]
        if self.extension == "mirrored":
            gx, gy = _mirror(gx, odd=-1, even=-2), _mirror(gy, odd=-2, even=-1)
        rows, columns = gx.shape[-2:]
        dx, dy = fields.steps
        wx = _frequencies(columns, columns // 2 + 1, like=gx) / dx
        wy = _frequencies(rows, rows, like=gx)[:, None] / dy
        gain = self._gain(wx.square() + wy.square())
        spectrum = torch.fft.rfft2(gx) * (wx * gain) + torch.fft.rfft2(gy) * (wy * gain)
        return torch.fft.irfft2(spectrum * -1j, s=(rows, columns))[..., :h, :w]

    def _gain(self, total: Tensor) -> Tensor:
        """The factor 1 / |w|^2 at each |w|^2, and 0 at 0."""
        flat = total == 0
        return torch.where(flat, 0, 1 / torch.where(flat, 1, total))


def _mirror(g: Tensor, odd: int, even: int) -> Tensor:
    """The slopes of the reflected surface: those across a reflection change sign."""
    g = torch.cat([g, -g.flip(odd)], odd)
    return torch.cat([g, g.flip(even)], even)


@table
def _frequencies(n: int, count: int) -> Tensor:
    """The first `count` of the n angular frequencies 2 pi k / n; the highest of an even n has no derivative: 0."""
    k = torch.fft.fftfreq(n, dtype=torch.float64, device="cpu")
    k = torch.where(k == -0.5, 0, k)
    return 2 * math.pi * k[:count]
