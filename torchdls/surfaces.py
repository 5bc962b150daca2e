"""Test surfaces with exact slopes, real terrain, and noise at a given signal-to-noise ratio.

Every surface is a formula z = f(x, y) on the unit square -1/2 <= x, y <= 1/2 (x along the columns to the
right, y along the rows, **down**), sampled on pixels one unit apart. With S = max(H, W) - 1 and the pixel in
row i and column j at x = (j - (W - 1)/2)/S, y = (i - (H - 1)/2)/S,

    height = S f(x, y)        gradient = (df/dx, df/dy)

so the slopes keep their size at every resolution, heights are in pixels, and a surface that is not square is
the central window of the square one. Slopes are derivatives of the formula, never differences of the samples:
differenced slopes are not those of the surface, and they make noise estimates too high.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_dtype

Formula = Callable[[Tensor, Tensor], Tensor]
Size = int | tuple[int, int]

_PHASE = math.pi * (3 - math.sqrt(5))  # the golden angle: directions and phases that never line up


class Surface(NamedTuple):
    """A sampled surface with its exact slopes.

    Attributes:
        name: the key in `SURFACES`, or "terrain".
        height: (1, 1, H, W), in pixels.
        gradient: (1, 2, H, W), [:, 0] = dz/dx to the right, [:, 1] = dz/dy down. On a crease, the mean of the
            two sides.
        data_range: the range for `torchdls.metrics.ssim`, in pixels. A range as large as the surface
            saturates the SSIM near 1, so it is a tenth of the range of the heights, except for `tent` and
            `vase`.

    Example:
        >>> surface = torchdls.SURFACES["tent"](64)
        >>> surface.name, surface.height.shape, surface.gradient.shape
        ('tent', torch.Size([1, 1, 64, 64]), torch.Size([1, 2, 64, 64]))
    """

    name: str
    height: Tensor
    gradient: Tensor
    data_range: float


@dataclass(frozen=True)
class AnalyticSurface:
    """A formula on the unit square, called with a size: `tent(200)`, `peaks((120, 160), dtype=torch.float64)`.

    Args of the call:
        n: the side in pixels, or (H, W).
        dtype: torch.float32 or torch.float64; values are computed in float64 first.
        device: where the tensors are made; None is PyTorch's default device.

    Returns:
        A `Surface`.

    Raises:
        ValueError: `n` is not at least 2.
        TypeError: `n` is not made of integers, or `dtype` is not float32 or float64.

    Attributes:
        name: the name of the surface.
        formula: (x, y) -> z, elementwise and differentiable by autograd.
        data_range: the range for the SSIM in the unit of the formula, None for a tenth of the range of the
            heights.
    """

    name: str
    formula: Formula
    data_range: float | None = None

    def __call__(
        self, n: Size = 200, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> Surface:
        """Sample the surface."""
        h, w = _check_size(n)
        check_dtype(self.name, dtype)
        side = max(h, w) - 1
        x, y = _unit_grid(h, w, device)
        z, slopes = _differentiate(self.formula, x, y)
        span = float(z.max() - z.min()) / 10 if self.data_range is None else self.data_range
        height = (side * z)[None, None].to(dtype)
        return Surface(self.name, height, slopes[None].to(dtype), side * span)


SURFACES: dict[str, AnalyticSurface] = {}
"""The analytic surfaces by name. `terrain` is not among them: its data come with matplotlib."""


def _surface(data_range: float | None = None) -> Callable[[Formula], AnalyticSurface]:
    def register(formula: Formula) -> AnalyticSurface:
        surface = AnalyticSurface(formula.__name__, formula, data_range)
        object.__setattr__(surface, "__doc__", formula.__doc__)
        SURFACES[surface.name] = surface
        return surface

    return register


@_surface(data_range=5 / 199)
def tent(x: Tensor, y: Tensor) -> Tensor:
    """The paper's Tent, a hip roof: in pixels at n = 200, z = max(0, min(100 - |x|, (90 - |y|) 100/36)).

    A slope on a hip (16 pixels at n = 200) is the mean of both sides. The formula and the SSIM range of 5
    were found by search: plain least squares on it gives the paper's DCTLS column.
    """
    side, front = 100 / 199 - x.abs(), (90 / 199 - y.abs()) * (100 / 36)
    hip = (side - front).abs() < 1e-9  # not left to rounding
    return torch.where(hip, (side + front) / 2, torch.minimum(side, front)).clamp_min(0)


@_surface(data_range=20 / 199)
def vase(x: Tensor, y: Tensor) -> Tensor:
    """The paper's Vase: z = F max(0, 1 - (x/F)^2), a stack of parabolas.

        F = (.83/.3) (.15 - .1 t (6t + 1)^2 (t - 1)^2 (3t - 2)),   t = y + 1/2

    The formula and the SSIM range of 20 (at n = 200) were found by search, as for `tent`.
    """
    t = y + 0.5
    radius = (0.83 / 0.3) * (0.15 - 0.1 * t * (6 * t + 1) ** 2 * (t - 1) ** 2 * (3 * t - 2))
    return radius * (1 - (x / radius) ** 2).clamp_min(0)


# Smooth


@_surface()
def peaks(x: Tensor, y: Tensor) -> Tensor:
    """The hills and hollows of MATLAB's `peaks`, over [-3, 3]^2 and lowered to slopes of about 1."""
    a, b = 6 * x, 6 * y
    hill = 3 * (1 - a) ** 2 * torch.exp(-(a**2) - (b + 1) ** 2)
    middle = 10 * (a / 5 - a**3 - b**5) * torch.exp(-(a**2) - b**2)
    return 0.02 * (hill - middle - torch.exp(-((a + 1) ** 2) - b**2) / 3)


@_surface()
def sphere(x: Tensor, y: Tensor) -> Tensor:
    """The cap of a sphere of radius .8 (it ends outside the image, where its slope is still finite)."""
    return (0.64 - x**2 - y**2).sqrt()


@_surface()
def gaussians(x: Tensor, y: Tensor) -> Tensor:
    """Five round bumps of either sign and of several widths."""
    bumps = (
        (0.16, -0.2, -0.15, 0.15),
        (-0.1, 0.22, -0.2, 0.1),
        (0.12, 0.15, 0.2, 0.12),
        (0.05, -0.25, 0.25, 0.06),
        (-0.04, 0.0, 0.02, 0.05),
    )
    waves = [a * torch.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * s * s)) for a, u, v, s in bumps]
    return torch.stack(waves).sum(0)


@_surface()
def saddle(x: Tensor, y: Tensor) -> Tensor:
    """A hyperbolic paraboloid, z = x^2 - y^2 + xy/2. Averaged slopes are exact on it."""
    return x**2 - y**2 + x * y / 2


# Creased


@_surface()
def pyramid(x: Tensor, y: Tensor) -> Tensor:
    """A square pyramid of slope 1 on a flat ground: creases along the axes' diagonals and around the base."""
    return (0.4 - torch.maximum(x.abs(), y.abs())).clamp_min(0)


@_surface()
def cone(x: Tensor, y: Tensor) -> Tensor:
    """A round cone of slope 1 on a flat ground. At the tip itself the slope is 0."""
    return (0.4 - _radius(x, y)).clamp_min(0)


@_surface()
def ridge(x: Tensor, y: Tensor) -> Tensor:
    """A curved ridge over two slopes: one winding crease."""
    return 0.3 - 0.6 * (x - 0.12 * torch.sin(2 * math.pi * y)).abs()


# Stepped


@_surface()
def steps(x: Tensor, y: Tensor) -> Tensor:
    """Smooth steep stairs: four rises of .07, tanh profiles .012 wide (2.4 pixels at n = 200, slope 2.9)."""
    rises = [torch.tanh((x + 0.15 * y - c) / 0.012) for c in (-0.3, -0.1, 0.1, 0.3)]
    return 0.035 * torch.stack(rises).sum(0)


@_surface()
def plateau(x: Tensor, y: Tensor) -> Tensor:
    """A true step: a disk of radius .3 stands .1 above a gentle tilt. The slopes do not see the jump.

    No method can recover the jump from slopes alone; the disk's height over its surroundings is unknown to
    them.
    """
    return 0.2 * x + 0.1 * y + torch.where(x**2 + y**2 < 0.09, 0.1, 0.0)


# Textured


@_surface()
def ripples(x: Tensor, y: Tensor) -> Tensor:
    """Round waves with a period of a twelfth of the image, fading outward."""
    r = _radius(x, y)
    return 0.012 * torch.cos(24 * math.pi * r) * torch.exp(-4 * r**2)


@_surface()
def chirp(x: Tensor, y: Tensor) -> Tensor:
    """A sweep in x from 2 to 18 periods per side (11 pixels each at n = 200), crossed by slow waves in y."""
    t = x + 0.5
    return 0.01 * torch.sin(2 * math.pi * (2 * t + 8 * t**2)) + 0.02 * torch.cos(6 * math.pi * y)


@_surface()
def fractal(x: Tensor, y: Tensor) -> Tensor:
    """A rough relief: five octaves (1.5 to 24 periods per side) of five plane waves each, with fixed phases."""
    z = torch.zeros_like(x)
    for wave in range(25):
        frequency, angle = 3 * math.pi * 2 ** (wave // 5), _PHASE * wave
        along = x * math.cos(angle) + y * math.sin(angle)
        z = z + 0.2 / frequency * torch.sin(frequency * along + _PHASE * wave**2)
    return z


def terrain(
    n: Size = 320,
    *,
    smoothing: float = 1.0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Surface:
    """Real terrain: the elevation model around the Jacksboro fault (Tennessee) that matplotlib brings along.

    The model (344 x 403 samples 92.7 m by 74.4 m apart, whole metres) is smoothed by a gaussian and
    interpolated by a bicubic spline, which is resampled on square pixels: n of them across the largest square
    in the middle of the map, 29.8 km, north up. Heights and slopes are the spline's own, so they belong
    together exactly. Heights are divided by the pixel spacing (29.8 km/(n - 1)): one unit is one pixel and
    the slopes are the true ones, in metres per metre.

    Args:
        n: side in pixels, or (H, W) for the central window of the square of side max(H, W).
        smoothing: standard deviation of the gaussian in pixels of the result (and at least one sample of the
            model, whose metre steps it must hide).
        dtype: torch.float32 or torch.float64.
        device: where the tensors are made; None is PyTorch's default device.

    Returns:
        A `Surface` with name "terrain".

    Raises:
        ImportError: matplotlib is missing; `pip install "torchdls[plots]"` brings it.
        ValueError: `n` or `smoothing` is out of range.
        TypeError: `n` is not made of integers, or `dtype` is not float32 or float64.

    Example:
        >>> torchdls.terrain((48, 64)).height.shape
        torch.Size([1, 1, 48, 64])
    """
    h, w = _check_size(n)
    check_dtype("terrain", dtype)
    if not 0 <= smoothing < math.inf:
        raise ValueError(f"smoothing: {smoothing} given, a finite number of at least 0 is needed")
    import numpy as np
    from scipy.interpolate import RectBivariateSpline
    from scipy.ndimage import gaussian_filter

    metres, dx, dy = _elevation()
    rows, columns = metres.shape
    spacing = min((rows - 1) * dy, (columns - 1) * dx) / (max(h, w) - 1)
    blur = [max(1.0, smoothing * spacing / d) for d in (dy, dx)]
    y, x = (np.arange(k) - (k - 1) / 2 for k in (rows, columns))
    spline = RectBivariateSpline(y * dy, x * dx, gaussian_filter(metres, blur, mode="nearest"))
    at = [(np.arange(k) - (k - 1) / 2) * spacing for k in (h, w)]
    height = torch.from_numpy(spline(*at) / spacing)[None, None]
    slopes = np.stack([spline(*at, dy=1), spline(*at, dx=1)])  # SciPy calls the first argument, our rows, x
    gradient = torch.from_numpy(slopes)[None]
    span = float(height.max() - height.min()) / 10
    return Surface("terrain", height.to(device, dtype), gradient.to(device, dtype), span)


def _check_size(n: Size) -> tuple[int, int]:
    pair = (n, n) if isinstance(n, int) else n
    if not isinstance(pair, tuple | list) or len(pair) != 2 or not all(isinstance(k, int) for k in pair):
        raise TypeError(f"n: {n!r} given, an integer or a pair (H, W) of integers is needed")
    if min(pair) < 2:
        raise ValueError(f"n: {n!r} given, at least 2 pixels a side are needed")
    return pair[0], pair[1]


def _unit_grid(h: int, w: int, device: torch.device | str | None) -> tuple[Tensor, Tensor]:
    """Coordinates x, y (H, W) in float64, their ends exactly opposite: symmetric surfaces stay symmetric."""
    side = 2 * (max(h, w) - 1)
    x, y = ((2 * torch.arange(k, dtype=torch.float64, device=device) - (k - 1)) / side for k in (w, h))
    return x.expand(h, w), y[:, None].expand(h, w)


def _differentiate(formula: Formula, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Value (H, W) and derivatives (2, H, W) of an elementwise formula: one backward pass gives both."""
    with torch.inference_mode(False), torch.enable_grad():
        x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
        z = formula(x, y)
        slopes = torch.autograd.grad(z.sum(), (x, y), materialize_grads=True)
    return z.detach(), torch.stack(slopes)


def _radius(x: Tensor, y: Tensor) -> Tensor:
    """sqrt(x^2 + y^2) with derivative 0, not NaN, at the origin."""
    return (x**2 + y**2).clamp_min(1e-30).sqrt()


def _elevation() -> tuple[Any, float, float]:
    """The elevation model in metres (rows from north to south) and its spacing dx, dy in metres."""
    try:
        from matplotlib import cbook
    except ImportError as error:
        message = "terrain: its elevation model comes with matplotlib; pip install 'torchdls[plots]'"
        raise ImportError(message) from error
    sample: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    with sample as model:
        metres = model["elevation"].astype(float)
        latitude = math.radians(float(model["ymin"] + model["ymax"]) / 2)
        dx, dy = (111_200 * float(model[key]) for key in ("dx", "dy"))
    return metres, dx * math.cos(latitude), dy
