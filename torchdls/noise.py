"""How noisy a gradient field is, read from the part of it that no surface can explain."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls._checks import check_field, check_fit, check_numbers, require
from torchdls._precision import full_precision
from torchdls._statistics import NORMAL_MEDIAN, masked_median
from torchdls._tracing import holds_everywhere
from torchdls.operators import as_pixel_size, dst2, edge_slopes, present_edges
from torchdls.operators.cosine import cosine_matrix
from torchdls.operators.edges import (
    cell_curl,
    cell_edges,
    complete_cells,
    mean_trust,
    wrapped_cell_curl,
    wrapped_edge_slopes,
)
from torchdls.operators.modes import Boundary, mode_sines
from torchdls.operators.sine import squared_sines
from torchdls.operators.tables import table
from torchdls.solvers.units import unit_of

_CUT = 3.0  # samples beyond so many standard deviations belong to the surface (creases, waves), not to the noise
_KEPT = math.erf(_CUT / math.sqrt(2))
_TRIMMED_VARIANCE = 1 - _CUT * math.sqrt(2 / math.pi) * math.exp(-_CUT * _CUT / 2) / _KEPT  # of a cut standard normal


@full_precision
def noise_level(
    gradient: Tensor,
    mask: Tensor | None = None,
    weight: Tensor | None = None,
    pixel_size: float | tuple[float, float] = 1.0,
) -> Tensor:
    r"""Standard deviation of white noise in a gradient field, without knowing the surface.

    The slopes v of a surface on the edges of the grid (see `edge_slopes`) add up to zero around every cell of
    2 x 2 pixels. What remains is the curl, which is noise but for the error of averaging slopes on a curved
    surface:

        c = dx (v_x[i, j] - v_x[i+1, j]) + dy (v_y[i, j+1] - v_y[i, j])

    White noise of standard deviation sigma in g gives Var c = sigma^2 (dx^2 + dy^2), since each v averages
    two samples. The curl is not white, but the sine transform (DST-I) of all cells makes its coefficients
    C_kl independent:

        Var C_kl = 4 sigma^2 (dx^2 s_k (1 - s_l) + dy^2 s_l (1 - s_k))
        s_k = sin^2(pi k / 2H),   s_l = sin^2(pi l / 2W),   k = 1 .. H - 1,   l = 1 .. W - 1

    (Divided by their Laplacian eigenvalues 4 (dx^2 s_k + dy^2 s_l), the C_kl^2 are the residual of plain
    least squares, mode by mode.) Both families of numbers, each over its own standard deviation, are normal
    variables of standard deviation sigma, and the estimate is the smaller of their robust scales. Creases are
    few cells but many modes, smooth relief and texture are many cells but few modes, so one of the two sees
    the noise alone; modes of low frequency (s_k + s_l <= 1/2) are left to the surface. The robust scale is
    the root mean square of the values within 3 times the scaled median of their magnitudes, calibrated for
    the normal distribution.

    With a mask that is not full, or with weights that vary, the cells decide alone. Weights are taken as
    inverse relative variances: the result is the standard deviation of a sample of weight 1.

    Measured: pure noise is estimated to 0.9 % at 96 x 96 (standard deviation; 3 % at 32 x 32, 6 % at 16 x 16).
    On the smooth surfaces of `torchdls.surfaces` it is within 3 % of the truth from 1 to 40 dB at 96 x 96 and
    above, on the creased ones up to 4 % too high at 96 x 96. Relief near the sampling limit reads as noise
    at high SNR: terrain 10 % too high at 30 dB. By the cells alone, ripples read 25 % too high at 40 dB.

    Differentiable in the gradient (almost everywhere: which samples are kept is piecewise constant); the
    derivative at a field without any curl is 0.

    Args:
        gradient: (N, 2, H, W), or (2, H, W); at least 2 x 2 pixels.
        mask: (N, 1, H, W) bool, or None for a full rectangle. What lies outside is never read.
        weight: (N, 1, H, W) or (N, 2, H, W), at least 0, or None for equal trust.
        pixel_size: the spacing of the pixels, one number or (dx, dy); it counts only where dx and dy differ.

    Returns:
        (N,) in the unit of the slopes, or () for an unbatched gradient.

    Raises:
        ValueError: shapes do not fit, the gradient is not finite inside the mask, a weight is negative or not
            finite, no complete cell lies inside a mask, or a pixel size is not positive.
        TypeError: the gradient is not float32 or float64, or the mask is not bool.

    Example:
        >>> gradient = torchdls.SURFACES["peaks"](96).gradient
        >>> noisy = gradient + 0.1 * torch.randn(gradient.shape, generator=torch.Generator().manual_seed(0))
        >>> round(float(torchdls.noise_level(noisy)), 2)
        0.1
    """
    steps = as_pixel_size(pixel_size)
    check_field("noise_level", "gradient", gradient, 2)
    single = gradient.ndim == 3
    if single:
        gradient = gradient[None]
        mask, weight = (None if t is None else t[None] for t in (mask, weight))
    _check(gradient, mask, weight)
    sigma, told = noise_if_told(gradient, mask, weight, steps)
    if not holds_everywhere(told):
        raise ValueError("noise_level: a mask (or the positive weights) holds no complete cell of 2 x 2 pixels")
    return sigma[0] if single else sigma


def noise_if_told(
    gradient: Tensor,
    mask: Tensor | None,
    weight: Tensor | None,
    pixel_size: tuple[float, float],
    boundary: Boundary = "neumann",
) -> tuple[Tensor, Tensor]:
    """`noise_level` of checked fields (N,), and whether a cell tells it (N,): 0 where none does.

    Fields of a single row or column have no cell; a mask may leave none.
    """
    n, (dx, dy) = gradient.shape[0], pixel_size  # not len(), which a graph for every batch size cannot follow
    if min(gradient.shape[-2:]) < 2:
        return gradient.new_zeros(n), torch.zeros(n, dtype=torch.bool, device=gradient.device)
    v, w = edge_slopes(gradient, mask) if boundary == "neumann" else (wrapped_edge_slopes(gradient), None)
    unit = unit_of(v.detach().abs().amax((1, 2, 3)))  # squares of slopes of order 1 are within any dtype
    curl = cell_curl(v / unit[:, None, None, None], (dx, dy))
    scale = math.hypot(dx, dy)
    if boundary == "periodic":
        curl = wrapped_cell_curl(v / unit[:, None, None, None], (dx, dy))
        spectral = _wrapped_spectral_scale(curl, dx, dy)
        sigma = torch.minimum(_robust_scale(curl / scale), spectral)
        return sigma * unit, torch.ones(n, dtype=torch.bool, device=gradient.device)
    if w is None and weight is None:
        sigma = torch.minimum(_robust_scale(curl / scale), _spectral_scale(curl, dx, dy))
        return sigma * unit, torch.ones(n, dtype=torch.bool, device=gradient.device)
    even, cells = _normalised(curl, _trusts(gradient, mask, weight), dx, dy)
    local, spectral = _robust_scale(even, cells), _spectral_scale(even * scale, dx, dy)
    sigma = torch.where(_stationary(mask, weight), torch.minimum(local, spectral), local)
    return sigma * unit, cells.flatten(1).any(1)


def edge_noise_if_told(v: Tensor, w: Tensor | None, pixel_size: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Noise (N,) of slopes measured on the edges (N, 2, H, W), for trust 1, and whether a cell tells it (N,).

    The robust scale of the sums around cells, each over its own standard deviation for independent slopes of variances
    1/w.
    """
    dx, dy = pixel_size
    if min(v.shape[-2:]) < 2:
        return v.new_zeros(v.shape[0]), torch.zeros(v.shape[0], dtype=torch.bool, device=v.device)
    w = present_edges(v).expand_as(v) if w is None else w
    spread = cell_edges(torch.where(w > 0, 1 / torch.where(w > 0, w, 1), 0))
    variance = dx * dx * spread[:, :2].sum(1) + dy * dy * spread[:, 2:].sum(1)
    cells = complete_cells(w > 0)
    unit = unit_of(v.detach().abs().amax((1, 2, 3)))
    curl = torch.where(cells, cell_curl(v / unit[:, None, None, None], pixel_size), 0)
    return _robust_scale(curl / torch.where(cells, variance, 1).sqrt(), cells) * unit, cells.flatten(1).any(1)


def _trusts(gradient: Tensor, mask: Tensor | None, weight: Tensor | None) -> Tensor:
    """(N, 2, H, W) trust in each sample, 0 outside the mask."""
    trust = torch.ones_like(gradient) if weight is None else weight.expand_as(gradient)
    return trust if mask is None else torch.where(mask, trust, 0)


def _normalised(curl: Tensor, trust: Tensor, dx: float, dy: float) -> tuple[Tensor, Tensor]:
    """The curl over its standard deviation for sigma = 1, and the cells all of whose samples are trusted.

    The mean of two samples of variance sigma^2/t has variance sigma^2 (1/t_i + 1/t_j)/4.
    """
    good = trust > 0
    v, there = (edge_slopes(x)[0] for x in (torch.where(good, 1 / torch.where(good, trust, 1), 0), good.to(trust)))
    cells = complete_cells(there == 1)
    spread = cell_edges(v)
    variance = 0.5 * (dx * dx * spread[:, :2].sum(1) + dy * dy * spread[:, 2:].sum(1))
    return torch.where(cells, curl, 0) / torch.where(cells, variance, 1).sqrt(), cells


def _stationary(mask: Tensor | None, weight: Tensor | None) -> Tensor:
    """(N,) bool: the mask is full and the weights are all the same, so that the noise is alike in every cell."""
    parts = [] if mask is None else [mask.flatten(1).all(1)]
    if weight is not None:
        parts.append(weight.flatten(1).amin(1) == weight.flatten(1).amax(1))
    return torch.stack(torch.broadcast_tensors(*parts)).all(0)


def _spectral_scale(curl: Tensor, dx: float, dy: float) -> Tensor:
    """(N,) robust scale of the sine coefficients of the curl, each over its standard deviation for sigma = 1."""
    h, w = curl.shape[-2] + 1, curl.shape[-1] + 1
    coefficients = dst2(curl)
    return _robust_scale(coefficients * _gain(h, w, dx, dy, like=curl), _high_modes(h, w, like=curl) > 0)


def _wrapped_spectral_scale(curl: Tensor, dx: float, dy: float) -> Tensor:
    """(N,) the same on a torus, from the magnitudes of Fourier coefficients, whose squares are exponential variables.

    A turn around the torus changes their phases alone. The root mean square of those within `_CUT` root mean squares,
    as the median tells them, over what it is for pure exponentials.
    """
    h, w = curl.shape[-2:]
    gain = _wrapped_gain(h, w, dx, dy, like=curl)
    magnitude = torch.fft.fft2(curl, norm="ortho").abs() * gain
    live = (gain > 0).expand_as(magnitude)
    median = masked_median(magnitude.detach().flatten(1), live.flatten(1))
    kept = live & (magnitude <= (_CUT / math.sqrt(math.log(2)) * median)[:, None, None])
    rest = math.exp(-_CUT * _CUT)
    norm = torch.linalg.vector_norm(torch.where(kept, magnitude, 0), dim=(-2, -1))
    share = 1 - _CUT * _CUT * rest / (1 - rest)
    return norm / (share * kept.sum((-2, -1), dtype=curl.dtype).clamp(min=1)).sqrt()


def _robust_scale(x: Tensor, valid: Tensor | None = None) -> Tensor:
    """(N,) standard deviation of normal variables (N, h, w) among outliers.

    Root mean square of the values within `_CUT` times the scaled median magnitude, over what it is for pure
    normals.
    """
    magnitude = x.detach().abs()
    live = torch.ones_like(x, dtype=torch.bool) if valid is None else valid.expand_as(x)
    limit = _CUT * masked_median(magnitude.flatten(1), live.flatten(1)) / NORMAL_MEDIAN
    kept = live & (magnitude <= limit[:, None, None])
    norm = torch.linalg.vector_norm(torch.where(kept, x, 0), dim=(-2, -1))  # derivative 0, not NaN, at 0
    return norm / (_TRIMMED_VARIANCE * kept.sum((-2, -1), dtype=x.dtype).clamp(min=1)).sqrt()


@table
def _gain(h: int, w: int, dx: float, dy: float) -> Tensor:
    y, x = squared_sines(h)[:, None], squared_sines(w)
    return (4 * (dx * dx * y * (1 - x) + dy * dy * x * (1 - y))).rsqrt()


@table
def _high_modes(h: int, w: int) -> Tensor:
    return (squared_sines(h)[:, None] + squared_sines(w) > 0.5).double()


@table
def _wrapped_gain(h: int, w: int, dx: float, dy: float) -> Tensor:
    """Of the high modes; 0 for the others, and for a chequerboard, which has no curl."""
    y, x = mode_sines(h, "periodic")[:, None], mode_sines(w, "periodic")
    variance = 4 * (dx * dx * y * (1 - x) + dy * dy * x * (1 - y))
    return torch.where((y + x > 0.5) & (variance > 1e-9), variance.clamp(min=1e-9).rsqrt(), 0)


def _check(gradient: Tensor, mask: Tensor | None, weight: Tensor | None) -> None:
    check_field("noise_level", "gradient", gradient, 2)
    if min(gradient.shape[-2:]) < 2:
        shape = tuple(gradient.shape)
        raise ValueError(f"noise_level: gradient {shape} given, (N, 2, H, W) of at least 2 x 2 pixels is needed")
    if mask is not None:
        check_fit("noise_level", "mask", mask, gradient, "gradient", channels=(1,), dtype=torch.bool)
    if weight is not None:
        check_fit("noise_level", "weight", weight, gradient, "gradient", channels=(1, 2))
    inside = gradient if mask is None else torch.where(mask, gradient, 0)
    if not holds_everywhere(inside.isfinite()):
        raise ValueError(
            "noise_level: gradient holds NaN or infinite values" + (" inside the mask" if mask is not None else "")
        )
    if weight is not None and not holds_everywhere(weight.isfinite() & (weight >= 0)):
        raise ValueError("noise_level: weight holds negative, NaN or infinite values")


_ORDINARY = 600.0  # 30 times u for trusts of 1
_LARGEST_ERROR = 1e4  # of averaging, in units of the noise: beyond it all weights are alike anyway


def averaging_error(
    gradient: Tensor,
    mask: Tensor | None,
    weight: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
) -> Tensor:
    r"""How far the mean of two neighbouring slopes is from the slope between them, in units of the noise.

    A crease somewhere between the pixels i and i + 1 turns the slope by c and puts their mean off by c (f - 1/2), where
    f is uniform: by c^2/12 on average. c shows in the third difference of the slopes, and so does the error on a curved
    surface (where it is smaller):

        r = g_{i-1} - 3 g_i + 3 g_{i+1} - g_{i+2},     mean error^2 = mean (r^2 - sigma^2 u) / 48
        u = 1/t_{i-1} + 9/t_i + 9/t_{i+1} + 1/t_{i+2}

    The mean over the surface is weighted by 1 / (u + 600) for trusts of mean 1: all edges alike, also those where steep
    relief is trusted less, but for the worst, whose noise would drown the rest. sigma is read from the curl, as by
    `noise_level`.

    Args:
        gradient: (N, 2, H, W).
        mask: (N, 1, H, W) bool, or None.
        weight: (N, 1 or 2, H, W).
        pixel_size: (dx, dy).

    Returns:
        (N, 1, 1, 1): the mean squared error over the noise variance of a sample of mean trust, from 0 to 1e4; 0 where
        the field is too small or too sparse to tell. It does not depend on the scale of the slopes or the weights.
    """
    trust = _trusts(gradient, mask, weight)
    gradient = gradient if mask is None else torch.where(mask, gradient, 0)
    trust = trust / mean_trust(trust)
    if min(gradient.shape[-2:]) < 2 or max(gradient.shape[-2:]) < 4:
        return 0 * trust[:, :1, :1, :1]
    dx, dy = pixel_size
    unit, cells = _normalised(cell_curl(edge_slopes(gradient)[0], (dx, dy)), trust, dx, dy)
    power = _robust_scale(unit, cells).nan_to_num(0.0).square()
    sums = [_third_differences(gradient[:, c], trust[:, c], dim) for c, dim in ((0, -1), (1, -2))]
    square, noise, total = (torch.stack(parts).sum(0) for parts in zip(*sums, strict=True))
    noisy, known = power > 0, (total > 0) & cells.flatten(1).any(1)
    over = (square / torch.where(noisy, power, 1) - noise) / torch.where(known, total, 1) / 48
    over = torch.where(noisy, over, _LARGEST_ERROR * (square > 0)).clamp(0, _LARGEST_ERROR)
    return torch.where(known, over, 0)[:, None, None, None]


def _third_differences(g: Tensor, trust: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) sums of q r^2, q u and q along one axis of (N, H, W), where all four samples are trusted."""
    n = g.shape[dim] - 3
    if n < 1:
        return (0 * g[:, 0, 0],) * 3
    ends = [(g.narrow(dim, k, n), trust.narrow(dim, k, n)) for k in range(4)]
    live = torch.stack([t > 0 for _, t in ends]).all(0)
    r, u = torch.zeros_like(ends[0][0]), torch.zeros_like(ends[0][0])
    for factor, (slope, t) in zip((1, -3, 3, -1), ends, strict=True):
        r, u = r + factor * slope, u + factor**2 / torch.where(live, t, 1)
    q = torch.where(live, 1 / (u + _ORDINARY), 0)
    return (q * r.square()).sum((-2, -1)), (q * u).sum((-2, -1)), q.sum((-2, -1))


# --- what least squares makes of white noise --------------------------------------------------------------------------

_PERIOD = 128  # side of the periodic grid on which the spectrum of the projected noise is sampled


def height_noise(
    shape: tuple[int, int],
    like: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Variance of the cosine coefficients of a least-squares height, for white noise of variance 1 in the gradient.

        S_kl = (a_x c_x + a_y c_y) / (a_x + a_y)^2,   S_00 = 0
        a_x = 4 sin^2(w_x / 2) / dx^2,   c_x = cos^2(w_x / 2),   w_x = pi l / W,   and alike in y

    c is what averaging the slopes of two neighbours leaves of their noise, 1 / a what integration makes of it. The
    coefficients (of `dct2`) are exactly uncorrelated on a rectangle with equal trust in all slopes. On a torus they are
    those of `hartley2`, with w_x = 2 pi l / W.

    Args:
        shape: (H, W).
        like: a tensor of the wanted dtype and device.
        pixel_size: (dx, dy).
        boundary: "neumann" or "periodic".

    Returns:
        (H, W).
    """
    return _height_noise(tuple(shape), tuple(pixel_size), boundary, like=like)


@table
def _height_noise(shape: tuple[int, int], pixel_size: tuple[float, float], boundary: Boundary) -> Tensor:
    y, x = (mode_sines(n, boundary) for n in shape)
    return _noise_of_modes(y, x, pixel_size)


def height_noise_part(
    shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int], pixel_size: tuple[float, float]
) -> Tensor:
    """`height_noise` in float64 of the modes from and up to (without) a row, and alike for columns; not kept."""
    y, x = (
        torch.sin(torch.arange(*part, dtype=torch.float64, device="cpu") * (math.pi / (2 * n))).square()
        for part, n in zip((rows, columns), shape, strict=True)
    )
    return _noise_of_modes(y, x, pixel_size)


def _noise_of_modes(y: Tensor, x: Tensor, pixel_size: tuple[float, float]) -> Tensor:
    """From the sin^2(w / 2) of rows and columns."""
    a_y, a_x = 4 * y[:, None] / pixel_size[1] ** 2, 4 * x / pixel_size[0] ** 2
    total = a_x + a_y
    total = torch.where(total > 0, total, 1)  # 0 for the mean alone
    return (a_x * (1 - x) + a_y * (1 - y)[:, None]) / total.square()


def cosine_noise(size: tuple[int, int], like: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    r"""Standard deviation of the cosine coefficients of a patch of projected slopes, for white noise of level 1.

    The slopes A z of the least-squares height carry the part of the noise that is a gradient. Its spectrum (far from
    the border) is that of `slope_covariance`, and with the discrete-time Fourier transform of an atom d

        std^2 = mean over w of S_xx(w) |d(w)|^2   (S_yy for the slopes in y)

    Args:
        size: (rows, columns) of a patch.
        like: a tensor of the wanted dtype and device.
        pixel_size: (dx, dy).

    Returns:
        (2, rows, columns): for dz/dx and dz/dy, coefficients in the order of `dct2`.
    """
    return _cosine_noise(tuple(size), tuple(pixel_size), like=like)


@table
def _cosine_noise(size: tuple[int, int], pixel_size: tuple[float, float]) -> Tensor:
    n = _spectrum_side(size)
    xx, yy, _ = _projected_spectra(n, pixel_size)
    down, across = (torch.fft.fft(cosine_matrix(k, like=xx), n).abs().square() for k in size)
    return torch.stack([(down @ s @ across.mT).sqrt() / n for s in (xx, yy)])


def slope_covariance(size: tuple[int, int], like: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    r"""Covariance of the projected noise in a patch of slopes (x above y), for white noise of level 1.

    The inverse Fourier transforms of

        S_xx = a_x q,   S_yy = a_y q,   S_xy = g_x conj(g_y) q,   q = (a_x c_x + a_y c_y) / (a_x + a_y)^2

    with g_x = (exp(i w_x) - 1) / dx, a_x = |g_x|^2, c_x = cos^2(w_x / 2), alike in y, and S_xx(0) = S_yy(0) = 1/2 (the
    mean over all directions).

    Args:
        size: (rows, columns) of a patch, n pixels.
        like: a tensor of the wanted dtype and device.
        pixel_size: (dx, dy).

    Returns:
        (2n, 2n).
    """
    return _slope_covariance(tuple(size), tuple(pixel_size), like=like)


@table
def _slope_covariance(size: tuple[int, int], pixel_size: tuple[float, float]) -> Tensor:
    n = _spectrum_side(size)
    i, j = (t.flatten() for t in torch.meshgrid(*(torch.arange(k, device="cpu") for k in size), indexing="ij"))
    lag = (i[:, None] - i) % n, (j[:, None] - j) % n
    xx, yy, xy = (torch.fft.ifft2(s).real[lag] for s in _projected_spectra(n, pixel_size))
    return torch.cat([torch.cat([xx, xy], 1), torch.cat([xy.mT, yy], 1)])


def _spectrum_side(size: tuple[int, int]) -> int:
    """Side of the periodic grid: at least twice the patch, so that no lag wraps around."""
    return max(_PERIOD, 2 * max(size))


def _projected_spectra(n: int, pixel_size: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """S_xx, S_yy (real) and S_xy (complex) on an n x n grid of frequencies, rows first."""
    w = torch.arange(n, dtype=torch.float64, device="cpu") * (2 * math.pi / n)
    difference, c = torch.polar(torch.ones_like(w), w) - 1, torch.cos(w / 2).square()
    g_x, g_y = (difference / pixel_size[0]).expand(n, n), (difference / pixel_size[1])[:, None].expand(n, n)
    a_x, a_y = g_x.abs().square(), g_y.abs().square()
    total = a_x + a_y
    total[0, 0] = 1
    q = (a_x * c + a_y * c[:, None]) / total.square()
    xx, yy = a_x * q, a_y * q
    xx[0, 0] = yy[0, 0] = 0.5
    return xx, yy, g_x * g_y.conj() * q


@full_precision
def noise_sigma(gradient: Tensor, snr_db: float, mask: Tensor | None = None) -> Tensor:
    """Standard deviation of the noise on one gradient sample at a signal-to-noise ratio.

        SNR = 10 log10(||g||^2 / E||noise||^2),  E||noise||^2 = M sigma^2:  sigma = ||g|| 10^(-SNR/20) /
        sqrt(M)

    per surface, with ||g|| over both components and M samples (2 H W of them without a mask). The mean of g
    is not removed. With this definition plain least squares reproduces the DCTLS column of the paper's
    tables.

    Args:
        gradient: (N, 2, H, W), or (2, H, W).
        snr_db: the ratio in decibels.
        mask: (N, 1, H, W) bool, or (1, H, W): the pixels that count.

    Returns:
        (N,), or () for an unbatched gradient.

    Raises:
        TypeError: the gradient is not float32 or float64, or the mask is not bool.
        ValueError: the gradient has no two components, the shapes differ, a surface has no pixel in the mask, or
            `snr_db` is not finite.

    Example:
        >>> torchdls.noise_sigma(torch.ones(1, 2, 4, 4), snr_db=20)
        tensor([0.1000])
    """
    check_field("noise_sigma", "gradient", gradient, 2)
    check_numbers("noise_sigma", snr_db=snr_db)
    if not math.isfinite(snr_db):
        raise ValueError(f"snr_db: {snr_db} given, a finite number of decibels is needed")
    square = gradient.square()
    if mask is None:
        power = square.mean((-3, -2, -1))
    else:
        check_fit("noise_sigma", "mask", mask, gradient, "gradient", channels=(1,), dtype=torch.bool)
        some = holds_everywhere(mask.flatten(-3).any(-1))
        require(some, f"noise_sigma: mask {tuple(mask.shape)} is False everywhere on a surface")
        inside = mask.expand_as(gradient)
        power = torch.where(inside, square, 0).sum((-3, -2, -1)) / inside.sum((-3, -2, -1))
    return power.sqrt() * 10 ** (-snr_db / 20)


@full_precision
def add_noise(
    gradient: Tensor, snr_db: float, generator: torch.Generator | None = None, mask: Tensor | None = None
) -> Tensor:
    """Add white gaussian noise at a signal-to-noise ratio, independent in every sample and both components.

    The standard deviation is `noise_sigma(gradient, snr_db, mask)`, which also defines the ratio. The noise
    is drawn in float64 on the generator's device, so a seed means the same noise in float32 and float64.

    Args:
        gradient: (N, 2, H, W), or (2, H, W); not written to.
        snr_db: the ratio in decibels.
        generator: the source of randomness; None is PyTorch's default generator.
        mask: (N, 1, H, W) bool, or (1, H, W): the pixels over which the ratio is taken. Noise is added
            everywhere.

    Returns:
        The noisy gradient, in the shape and dtype of `gradient`.

    Raises:
        TypeError: as `noise_sigma`.
        ValueError: as `noise_sigma`.

    Example:
        >>> gradient = torch.ones(1, 2, 64, 64)
        >>> noisy = torchdls.add_noise(gradient, snr_db=20, generator=torch.Generator().manual_seed(0))
        >>> round(float((noisy - gradient).std()), 2)
        0.1
    """
    sigma = noise_sigma(gradient, snr_db, mask)
    source = "cpu" if generator is None else generator.device
    noise = torch.randn(gradient.shape, generator=generator, dtype=torch.float64, device=source)
    return gradient + sigma[..., None, None, None] * noise.to(gradient)
