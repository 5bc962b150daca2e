"""How far a surface is from the truth, modulo what slopes cannot tell: the constant (for depths, the scale).

All measures are batched and differentiable. They take one surface (1, H, W) or a batch (N, 1, H, W) and give
one number per surface. Pixels outside the mask, NaN or not, are never read; NaN inside it gives NaN. A mask
or a reference of batch size 1 serves the whole batch.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_field, check_fit
from torchdls._precision import full_precision
from torchdls._statistics import midpoint_median
from torchdls.operators import as_pixel_size

_WINDOW = 11  # scikit-image's gaussian window: sigma 1.5 cut at 3.5 sigma


@full_precision
def rmse(height: Tensor, reference: Tensor, mask: Tensor | None = None) -> Tensor:
    """Root of the mean squared error modulo the constant.

        sqrt(mean_i (d_i - mean(d))^2),   d = height - reference, i over the mask

    One constant is removed per surface, also where the mask has several components.

    Args:
        height: (N, 1, H, W), or (1, H, W).
        reference: the true height, of the same shape.
        mask: the valid pixels, bool, of the same shape; None for all.

    Returns:
        (N,), or () for an unbatched height; in the unit of the heights.

    Raises:
        ValueError: the shapes differ, or a mask is empty.
        TypeError: a field is not floating point, or `mask` is not bool.

    Example:
        >>> reference = torch.tensor([[[0.0, 1.0]]])
        >>> torchdls.rmse(reference + 5, reference)  # the constant is free
        tensor(0.)
        >>> torchdls.rmse(3 * reference, reference)
        tensor(1.)
    """
    height, reference, mask = _fields("rmse", height, reference, mask)
    difference = torch.where(mask, height - reference, 0)
    count = mask.sum((-3, -2, -1))
    centred = torch.where(mask, difference - _mean(difference, mask)[..., None, None, None], 0)
    return torch.linalg.vector_norm(centred, dim=(-3, -2, -1)) / count.sqrt()


@full_precision
def ssim(height: Tensor, reference: Tensor, data_range: float, mask: Tensor | None = None) -> Tensor:
    """Structural similarity of the heights, their levels aligned first.

    The height is moved to the mean level of the reference. The windows are gaussian (11 x 11, sigma 1.5) and
    only those that lie inside the image and the mask count: the value is scikit-image's
    `structural_similarity` with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`. Evaluated in
    float64, and from sums of squares: a variance of 0 is 0, so that no value is above 1 however small L is.

    The SSIM also compares local levels, so it depends on the level of the reference, and it saturates near 1
    where `data_range` is as large as the surface: report `rmse` beside it.

    Args:
        height: (N, 1, H, W), or (1, H, W), at least 11 x 11.
        reference: the true height, of the same shape.
        data_range: L in the stabilising constants (.01 L)^2 and (.03 L)^2, in the unit of the heights.
        mask: the valid pixels, bool, of the same shape; None for all.

    Returns:
        (N,), or () for an unbatched height; 1 for equal surfaces.

    Raises:
        ValueError: the shapes differ, `data_range` is not positive, or no window fits.
        TypeError: a field is not floating point, or `mask` is not bool.

    Source: Wang, Bovik, Sheikh, Simoncelli, IEEE TIP 13(4), 2004.

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> torchdls.ssim(surface.height, surface.height, surface.data_range)
        tensor([1.])
    """
    if not 0 < data_range < float("inf"):
        raise ValueError(f"ssim: data_range {data_range} given, a positive number is needed")
    given = height
    height, reference, mask = _fields("ssim", height, reference, mask)
    if min(height.shape[-2:]) < _WINDOW:
        raise ValueError(f"ssim: height {tuple(given.shape)} is smaller than the {_WINDOW} x {_WINDOW} window")
    wide = torch.float32 if height.device.type == "mps" else torch.float64  # MPS has no float64
    reference = torch.where(mask, reference, 0).to(wide)
    shift = _mean(reference - torch.where(mask, height, 0), mask)[..., None, None, None]
    height = torch.where(mask, height + shift, 0)
    height, reference, mask = (t.reshape(-1, 1, *given.shape[-2:]) for t in (height, reference, mask))
    values = _similarity(height, reference, data_range)
    complete = ~_dilate(~mask)
    if not complete.flatten(1).any(1).all():
        raise ValueError(f"ssim: no {_WINDOW} x {_WINDOW} window lies inside the mask")
    return _mean(torch.where(complete, values, 0), complete).reshape(given.shape[:-3]).to(given.dtype)


@full_precision
def mean_angular_error(
    height: Tensor,
    reference: Tensor,
    mask: Tensor | None = None,
    pixel_size: float | tuple[float, float] = 1.0,
) -> Tensor:
    """Mean angle in degrees between the normals of the surface and the true ones.

    Normals are taken at the centres of the cells of 2 x 2 pixels, as a mesh shows them, all four inside the mask:

        dz/dx = (z[i, j+1] - z[i, j] + z[i+1, j+1] - z[i+1, j]) / (2 dx),   dz/dy alike,   n = (-dz/dx,
        -dz/dy, 1)

    A reference given as slopes is averaged over the four pixels, one given as heights is differenced like the
    surface. Both are exact at the centre of a cell for quadratic surfaces.

    Args:
        height: (N, 1, H, W), or (1, H, W).
        reference: the true gradient (N, 2, H, W), or the true height (N, 1, H, W); unbatched like `height`.
        mask: (N, 1, H, W) bool; None for all.
        pixel_size: the spacing of the pixels, one number or (dx, dy), in the unit of the heights.

    Returns:
        (N,), or () for an unbatched height; in degrees.

    Raises:
        ValueError: the shapes do not fit, no cell lies inside the mask, or a pixel size is not positive.
        TypeError: a field is not floating point, or `mask` is not bool.

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> torchdls.mean_angular_error(0 * surface.height, torch.ones(1, 2, 32, 32) / 2**0.5)
        tensor([45.])
    """
    given = reference
    height, reference, mask = _fields("mean_angular_error", height, reference, mask, channels=(1, 2))
    dx, dy = as_pixel_size(pixel_size)
    reference = torch.where(mask, reference, 0)
    slopes = _cell_slopes(torch.where(mask, height, 0), dx, dy)
    truth = _corner_sums(reference) / 4 if given.shape[-3] == 2 else _cell_slopes(reference, dx, dy)
    cells = _corner_sums(mask.to(torch.uint8)) == 4
    if not cells.flatten(-3).any(-1).all():
        raise ValueError("mean_angular_error: no cell of 2 x 2 pixels lies inside the mask")
    return _mean(torch.where(cells, _angle(slopes, truth), 0), cells)


@full_precision
def mean_absolute_depth_error(depth: Tensor, reference: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean absolute depth error after scaling by the median ratio: the measure of the DiLiGenT objects.

        mean_i |s depth_i - reference_i|,   s = median_i(reference_i / depth_i), i over the mask

    For perspective integration, which leaves the scale free, and not the constant.

    Args:
        depth: (N, 1, H, W), or (1, H, W), nonzero inside the mask.
        reference: the true depth, of the same shape.
        mask: the valid pixels, bool, of the same shape; None for all.

    Returns:
        (N,), or () for an unbatched depth; in the unit of the reference. For an even count the median is the
        mean of the two middle ratios.

    Raises:
        ValueError: the shapes differ, or a mask is empty.
        TypeError: a field is not floating point, or `mask` is not bool.

    Source: Cao, Santo, Shi, Okura, Matsushita, "Bilateral normal integration", ECCV 2022.

    Example:
        >>> depth = torch.tensor([[[1.0, 2.0, 3.5]]])
        >>> torchdls.mean_absolute_depth_error(depth, torch.tensor([[[2.0, 4.0, 6.0]]]))
        tensor(0.3333)
    """
    depth, reference, mask = _fields("mean_absolute_depth_error", depth, reference, mask, label="depth")
    depth, reference = torch.where(mask, depth, 1), torch.where(mask, reference, 0)
    ratio = (reference / depth).flatten(-3)
    scale = midpoint_median(ratio, mask.flatten(-3) & ~ratio.isnan())
    return _mean(torch.where(mask, scale[..., None, None, None] * depth - reference, 0).abs(), mask)


def _similarity(x: Tensor, y: Tensor, data_range: float) -> Tensor:
    """SSIM of every window (N, 1, H - 10, W - 10)."""
    unit = torch.maximum(x.abs(), y.abs()).detach().amax((1, 2, 3), keepdim=True).clamp(min=data_range)
    c1, c2 = (0.01 * data_range / unit).square(), (0.03 * data_range / unit).square()
    none = torch.zeros_like(x)
    (mx, my), xx, yy, xy = _Window((x / unit, y / unit), none, none, none).along(-2).along(-1)
    alike, size = (2 * mx * my + c1) * (2 * xy + c2), (mx.square() + my.square() + c1) * (xx + yy + c2)
    flat = size == 0  # nothing there, and constants beyond the dtype
    return torch.where(flat, 1, alike / torch.where(flat, 1, size))


class _Window(NamedTuple):
    """Means of two fields in gaussian windows, and their variances and covariance."""

    means: tuple[Tensor, Tensor]
    xx: Tensor
    yy: Tensor
    xy: Tensor

    def along(self, dim: int) -> _Window:
        """Windows that are longer along one more axis: variances within add to those of the means, nothing cancels."""
        place = torch.arange(_WINDOW) - _WINDOW // 2
        weight = (place.double().square() / (-2 * 1.5**2)).exp()
        count = self.xx.shape[dim] - _WINDOW + 1
        taps = [(float(g), k) for k, g in enumerate(weight / weight.sum())]

        def mean(t: Tensor) -> Tensor:
            return reduce(torch.add, (g * t.narrow(dim, k, count) for g, k in taps))

        (x, y), (mx, my) = self.means, (mean(t) for t in self.means)
        xx, yy, xy = mean(self.xx), mean(self.yy), mean(self.xy)
        for g, k in taps:
            dx, dy = x.narrow(dim, k, count) - mx, y.narrow(dim, k, count) - my
            xx, yy, xy = xx + g * dx * dx, yy + g * dy * dy, xy + g * dx * dy
        return _Window((mx, my), xx, yy, xy)


def _fields(
    name: str,
    height: Tensor,
    reference: Tensor,
    mask: Tensor | None,
    channels: tuple[int, ...] = (1,),
    label: str = "height",
) -> tuple[Tensor, Tensor, Tensor]:
    """The checked fields, with a reference and a mask of batch size 1 expanded, and a mask in any case."""
    check_field(name, label, height, 1)
    check_fit(name, "reference", reference, height, label, channels=channels)
    shape = tuple(height.shape)
    reference = reference.expand(*shape[:-3], -1, -1, -1)
    if mask is None:
        return height, reference, torch.ones_like(height, dtype=torch.bool)
    check_fit(name, "mask", mask, height, label, channels=(1,), dtype=torch.bool)
    if not mask.flatten(-3).any(-1).all():
        raise ValueError(f"{name}: mask {tuple(mask.shape)} holds a surface without any valid pixel")
    return height, reference, mask.expand(shape)


def _mean(values: Tensor, where: Tensor) -> Tensor:
    """Mean over the pixels of `where`; values are 0 elsewhere."""
    return values.sum((-3, -2, -1)) / where.sum((-3, -2, -1))


def _corner_sums(x: Tensor) -> Tensor:
    """(..., H - 1, W - 1) sums over cells of 2 x 2 pixels."""
    pairs = x[..., 1:] + x[..., :-1]
    return pairs[..., 1:, :] + pairs[..., :-1, :]


def _cell_slopes(z: Tensor, dx: float, dy: float) -> Tensor:
    """(..., 2, H - 1, W - 1) slopes at the centres of the cells."""
    right, down = z[..., 1:] - z[..., :-1], z[..., 1:, :] - z[..., :-1, :]
    x = (right[..., 1:, :] + right[..., :-1, :]) / (2 * dx)
    y = (down[..., 1:] + down[..., :-1]) / (2 * dy)
    return torch.cat([x, y], -3)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Degrees between the normals of two fields of slopes: by atan2, as accurate at 0 as elsewhere."""
    normal_a, normal_b = (torch.cat([-g, torch.ones_like(g[..., :1, :, :])], -3) for g in (a, b))
    sine = torch.linalg.vector_norm(torch.linalg.cross(normal_a, normal_b, dim=-3), dim=-3, keepdim=True)
    cosine = (normal_a * normal_b).sum(-3, keepdim=True)
    return torch.atan2(sine, cosine).rad2deg()


def _dilate(outside: Tensor) -> Tensor:
    """Centres of the windows, of those inside the image, that hold a pixel of `outside`."""
    return torch.nn.functional.max_pool2d(outside.float(), _WINDOW, stride=1) > 0


def describe(
    height: Tensor,
    truth: Tensor,
    *,
    data_range: float | None = None,
    gradient: Tensor | None = None,
    mask: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
) -> dict[str, float]:
    """Figures of merit of one surface: `rmse` modulo the constant, `ssim` and `angle` (mean angular error, degrees).

    Args:
        height: (1, 1, H, W).
        truth: (1, 1, H, W).
        data_range: for the SSIM, which is left out without it.
        gradient: true slopes (1, 2, H, W) for the angle; default: those of `truth`.
        mask: (1, 1, H, W) bool.
        pixel_size: (dx, dy).
    """
    measures = {"rmse": float(rmse(height, truth, mask))}
    if data_range is not None:
        measures["ssim"] = float(ssim(height, truth, data_range, mask))
    angle = mean_angular_error(height, truth if gradient is None else gradient, mask, pixel_size)
    return measures | {"angle": float(angle)}
