"""Heights known from elsewhere: coarse depths whose scale and offset are fitted, and pieces moved to their places."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_field, check_fit
from torchdls._precision import full_precision
from torchdls._statistics import masked_median
from torchdls.operators import edge_slopes
from torchdls.solvers import connected_components

_STEPS = 20  # of reweighting
_FLAT = 1e-6  # share of the variance of the coarse depth below which a surface tells no scale


class CoarseFit(NamedTuple):
    """What `fit_coarse` returns.

    Attributes:
        anchor: (N, 1, H, W), the coarse depth in the unit of the surface; 0 where it is not known.
        known: (N, 1, H, W) bool, where it is known.
        scale: (N,) the coarse depth grows by so much where the surface grows by 1 (in the largest piece).
        offset: (N,) of the coarse depth, where the surface is 0 (in the largest piece).

    Example:
        >>> height = torch.arange(12.0).view(1, 1, 3, 4)
        >>> torchdls.fit_coarse(height, 2 * height).known.all()
        tensor(True)
    """

    anchor: Tensor
    known: Tensor
    scale: Tensor
    offset: Tensor


@full_precision
def fit_coarse(
    height: Tensor,
    coarse: Tensor,
    mask: Tensor | None = None,
    pieces: Tensor | None = None,
    *,
    log_depth: bool = False,
) -> CoarseFit:
    r"""Scale and offset between a surface and a coarse depth, such as a network guesses from one picture.

        c_p = a z_p + b_k      (heights)            c_p = a_k exp(z_p) + b      (log_depth)      for p in piece k

    by 20 least-squares fits, reweighted so that what is far off has no say (Cauchy). What is common to all pieces (a,
    or b under a camera) is read off their shapes alone; the rest belongs to each, since the surface does not tell where
    they are. With those of the largest piece the coarse depth becomes anchors in the unit of the surface:

        (c - b_1) / a        or        log((c - b) / a_1)

    Integrating once more with these and a small weight moves each piece to its place. The sign of a is free.

    Args:
        height: (N, 1, H, W), float32 or float64; of log depth with `log_depth`.
        coarse: (N, 1, H, W), not finite where unknown.
        mask: (N, 1, H, W) bool, where there is a surface; None for everywhere.
        pieces: (N, 1, H, W) int64 as `PiecewiseResult` has them, 1 for the largest; None for the parts of the mask.
        log_depth: whether the height is that of log depth.

    Returns:
        `CoarseFit(anchor, known, scale, offset)`.

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: a shape does not fit, a surface is too flat, or the coarse depth is known at too few places.

    Source: iteratively reweighted least squares, Holland, Welsch (1977).

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> fit = torchdls.fit_coarse(surface.height, 3 * surface.height + 5)
        >>> round(float(fit.scale), 4), round(float(fit.offset), 4)
        (3.0, 5.0)
    """
    name = "fit_coarse"
    _check_height(name, height)
    check_fit(name, "coarse", coarse, height, "height", channels=(1,))
    if mask is not None:
        check_fit(name, "mask", mask, height, "height", channels=(1,), dtype=torch.bool)
    if pieces is not None:
        check_fit(name, "pieces", pieces, height, "height", channels=(1,), dtype=torch.int64)
    inside = torch.ones_like(height, dtype=torch.bool) if mask is None else mask.expand_as(height)
    z, c = height.double(), coarse.expand_as(height).double()
    known = inside & c.isfinite() & z.isfinite()
    z, c = torch.where(known, z.exp() if log_depth else z, 0), torch.where(known, c, 0)
    label = (parts_of(inside) if pieces is None else pieces).expand_as(height)
    label = torch.where(known, label, 0).flatten(1)
    fit = _fit_log if log_depth else _fit
    scale, offset = fit(z.flatten(1), c.flatten(1), known.flatten(1).double(), label)
    if not bool((scale.isfinite() & offset.isfinite() & (scale != 0)).all()):
        shape = tuple(height.shape)
        raise ValueError(f"{name}: height {shape} is too flat to tell the scale, or coarse is known at too few places")
    anchor = (c - offset.view(-1, 1, 1, 1)) / scale.view(-1, 1, 1, 1)
    if log_depth:
        known = known & (anchor > 0)
        anchor = torch.where(known, anchor, 1).log()
    return CoarseFit(torch.where(known, anchor, 0).to(height), known, scale.to(height), offset.to(height))


def _check_height(name: str, height: Tensor) -> None:
    check_field(name, "height", height, 1)
    if height.ndim != 4:
        raise ValueError(f"{name}: height {tuple(height.shape)} given, (N, 1, H, W) is needed")


def parts_of(inside: Tensor) -> Tensor:
    """(N, 1, H, W) int64: the connected parts of a mask, 1 for the largest, 2 for the next, ..; 0 outside."""
    live = edge_slopes(torch.zeros_like(inside, dtype=torch.float64).expand(-1, 2, -1, -1), inside)[1]
    joined = torch.zeros_like(inside).expand(-1, 2, -1, -1) if live is None else live > 0
    labels, flat = connected_components(joined).flatten(1), inside.flatten(1)
    sizes = torch.zeros_like(labels).scatter_add(1, labels, flat.to(labels.dtype))
    rank = (-sizes).argsort(dim=1, stable=True).argsort(dim=1)
    return torch.where(flat, 1 + rank.gather(1, labels), 0).view_as(inside)


def _sums(x: Tensor, label: Tensor, count: int) -> Tensor:
    """(N, K): sums of x (N, P) over the pieces, 0 for what is in none."""
    return x.new_zeros(len(x), count).scatter_add(1, label, x)


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)


def _reweighted(r: Tensor, known: Tensor) -> Tensor:
    """Weights 1 / (1 + (r / s)^2) with s 1.5 times the median |r|: what lies far off, as at contours, has no say."""
    usual = masked_median(r.abs(), known > 0)[:, None]
    return known / (1 + (r / (1.5 * usual).clamp(min=1e-12 * r.abs().amax(1, keepdim=True) + 1e-300)).square())


def _fit(z: Tensor, c: Tensor, known: Tensor, label: Tensor) -> tuple[Tensor, Tensor]:
    """Common slope, and the intercept of piece 1: both (N,)."""
    w, count = known, int(label.max()) + 1
    for _ in range(_STEPS):
        total = _sums(w, label, count)
        z_mean, c_mean = (_ratio(_sums(w * f, label, count), total) for f in (z, c))
        dz, dc = z - z_mean.gather(1, label), c - c_mean.gather(1, label)
        a = (w * dz * dc).sum(1) / (w * dz.square()).sum(1)
        w = _reweighted(dc - a[:, None] * dz, known)
    a = torch.where((w * dz.square()).sum(1) * a.square() > _FLAT * (w * dc.square()).sum(1), a, torch.nan)
    return a, c_mean[:, 1] - a * z_mean[:, 1]


def _fit_log(z: Tensor, c: Tensor, known: Tensor, label: Tensor) -> tuple[Tensor, Tensor]:
    """The slope of piece 1, and the common intercept: both (N,)."""
    w, count = known, int(label.max()) + 1
    for _ in range(_STEPS):
        zz, z_sum, zc = (_sums(w * f, label, count) for f in (z.square(), z, z * c))
        with_c, with_1 = (z * _ratio(f, zz).gather(1, label) for f in (zc, z_sum))
        told, every = (w * (1 - with_1)).sum(1), w.sum(1)
        b = torch.where(told > _FLAT * every, (w * (c - with_c)).sum(1) / told, 0)
        a = _ratio(zc - b[:, None] * z_sum, zz)
        w = _reweighted(c - a.gather(1, label) * z - b[:, None], known)
    return a[:, 1], b


@full_precision
def place_pieces(height: Tensor, pieces: Tensor, offsets: Tensor) -> Tensor:
    """The height with each piece moved by its own offset.

    Args:
        height: (N, 1, H, W).
        pieces: (N, 1, H, W) int64, as `PiecewiseResult` has them: from 1 to K, and 0 outside the mask.
        offsets: (N, K), of pieces 1 to K; what no piece holds stays.

    Returns:
        (N, 1, H, W). Differentiable in height and offsets.

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: a shape does not fit, or a piece has no offset.

    Example:
        >>> height, pieces = torch.zeros(1, 1, 1, 3), torch.tensor([[[[1, 2, 2]]]])
        >>> torchdls.place_pieces(height, pieces, torch.tensor([[0.0, 5.0]])).flatten().tolist()
        [0.0, 5.0, 5.0]
    """
    name = "place_pieces"
    _check_height(name, height)
    check_fit(name, "pieces", pieces, height, "height", channels=(1,), dtype=torch.int64)
    check_alike(name, "offsets", offsets, height.dtype)
    count = int(pieces.max())
    if offsets.ndim != 2 or len(offsets) != len(height) or offsets.shape[1] < count:
        raise ValueError(f"{name}: offsets {tuple(offsets.shape)} given, ({len(height)}, {count}) are needed")
    zero = torch.zeros_like(offsets[:, :1])
    return height + torch.cat([zero, offsets], 1).gather(1, pieces.flatten(1)).view_as(height)
