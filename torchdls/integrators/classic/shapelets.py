"""Integration by correlation with small bumps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdls._checks import check_numbers
from torchdls.integrators.classic.fourier import Extension, FrankotChellappa


class Shapelets(FrankotChellappa):
    r"""Correlation of the slopes with those of Gaussian bumps of several sizes.

        z = ln(mult) / 2 pi  sum_s  corr(grad f_s, g),     f_s(x) = exp(-|x|^2 / (2 sigma_s^2)),
        sigma_s = sigma mult^s,  s = 0 .. n_scales - 1

    No equation is solved: each bump is found as far as the slopes are like its own. On a surface that repeats, this is
    exactly the answer of `FrankotChellappa` behind the filter

        H(w) = ln(mult) sum_s (sigma_s |w|)^2 exp(-(sigma_s |w|)^2 / 2)

    and so it is computed. The source's heights have no scale; the factor here makes H about 1 between the smallest and
    the largest bump. **Longer and shorter waves are lost**: with the defaults H is within 6 % of 1 for periods of 16 to
    128 pixels, but .63 at 200, .35 at 300 and .55 at 4. It is for teaching and for comparison with the source: where
    heights matter, take `FrankotChellappa` or `LeastSquares`, and `SlopeDLS` where there is noise.

    Needs the full rectangle and equal trust: takes no mask, weights or anchors. On the constant: zero mean.

    Args:
        n_scales: number of sizes, at least 1.
        sigma: of the smallest bump, in pixels (of the same area, if pixels are oblong).
        mult: ratio of two sizes, above 1.
        extension: "periodic" or "mirrored", as in `FrankotChellappa`.
        pixel_size: (dx, dy) or one number; heights come out in its unit.

    Raises:
        ValueError: an option is out of its range.

    Source: Kovesi, "Shapelets Correlated with Surface Normals Produce Surfaces", ICCV 2005.

    Example:
        >>> waves = torch.sin(torch.arange(16.0) * torch.pi / 4).expand(1, 1, 16, 16)
        >>> slopes = torch.cat([waves, 0 * waves], 1)
        >>> methods = torchdls.FrankotChellappa(), torchdls.Shapelets(), torchdls.Shapelets(n_scales=1)
        >>> [round(float(method(slopes).max()), 2) for method in methods]
        [1.27, 1.1, 0.4]
    """

    def __init__(
        self,
        n_scales: int = 6,
        sigma: float = 1.0,
        mult: float = 2.0,
        extension: Extension = "periodic",
        *,
        pixel_size: float | Sequence[float] = 1.0,
    ) -> None:
        super().__init__(extension, pixel_size=pixel_size)
        check_numbers("Shapelets", sigma=sigma, mult=mult)
        if not isinstance(n_scales, int) or n_scales < 1:
            raise ValueError(f"Shapelets: n_scales={n_scales!r} given, an integer of at least 1 is needed")
        if not 0 < sigma < math.inf or not 1 < mult < math.inf:
            raise ValueError(f"Shapelets: sigma={sigma!r} must be positive and mult={mult!r} above 1")
        self.n_scales, self.sigma, self.mult = n_scales, sigma, mult

    def _gain(self, total: Tensor) -> Tensor:
        """H / |w|^2 at each |w|^2."""
        squares = [(self.sigma * self.mult**s) ** 2 for s in range(self.n_scales)]
        bumps = [square * torch.exp(-square / 2 * total) for square in squares]
        return math.log(self.mult) * torch.stack(bumps).sum(0)
