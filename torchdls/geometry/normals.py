r"""Normals, gradients, conventions and cameras: everything is converted here, once, at the door.

**Frame.** Canonical normals have x to the right, y up and z toward the viewer (OpenGL). Canonical gradients follow the
rows and columns of the image: `gradient[:, 0] = dz/dx` to the right, `gradient[:, 1] = dz/dy` down; z grows toward
the viewer. The tangents (1, 0, z_x) and (0, -1, z_y) are orthogonal to the normal, hence

    z_x = -n1/n3,    z_y = +n2/n3,        n = (-z_x, z_y, 1) / sqrt(1 + z_x^2 + z_y^2).

Other conventions are signed permutations of these components: the tables of `torchdls._conventions` say which.

**Perspective camera.** With intrinsics K and homogeneous pixel m = (column, row, 1), the surface point is
X = Z K^-1 m. A tangent plane n.X = d reads l.m = d/Z in the image, with the covector l = K^-T n. Differentiating,

    grad log Z = -(l1, l2) / (l.m),        l = (-u_x, -u_y, 1 + u_x column + u_y row)   for u = log Z,

so the logarithm of the depth is integrated like a height, and its free constant is the free scale of the scene
(Durou and Courteille 2007; Queau, Durou and Aujol 2018). Integrators never hear of cameras.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from torchdls._checks import check_field, check_fit, check_real
from torchdls._precision import full_precision
from torchdls.geometry.cameras import apply_matrix, check_camera, inverse_camera, pixel_grid
from torchdls.geometry.conventions import NORMAL_CONVENTIONS, Axes, inverse_axes, lookup, permute
from torchdls.operators import as_pixel_size


class GradientField(NamedTuple):
    """Gradients from normals, and where they can be trusted.

    Attributes:
        gradient: (N, 2, H, W); 0 at invalid pixels.
        mask: (N, 1, H, W) bool; True where the pixel lies in the caller's mask and its normal is valid.
        invalid: (N,) number of pixels inside the caller's mask whose normal is invalid.

    Example:
        >>> field = torchdls.normals_to_gradient(torch.zeros(1, 3, 4, 5))
        >>> field.gradient.shape, int(field.invalid)
        (torch.Size([1, 2, 4, 5]), 20)
    """

    gradient: Tensor
    mask: Tensor
    invalid: Tensor


class ConventionGuess(NamedTuple):
    """The most integrable reading of a normal map.

    Attributes:
        convention: the candidate with the smallest residual.
        residual: for each candidate its non-integrable part, from 0 (a surface) to 1 (no surface).
    """

    convention: str
    residual: dict[str, float]


@full_precision
def normals_to_gradient(
    normals: Tensor,
    convention: str = "opengl",
    *,
    mask: Tensor | None = None,
    camera: Tensor | None = None,
    pixel_size: float | Sequence[float] = 1.0,
    eps: float = 1e-2,
) -> GradientField:
    r"""Gradient of the surface whose normals are given.

        orthographic:  z_x = -dx n1/n3,  z_y = +dy n2/n3       perspective:  grad log Z = -(l1, l2)/(l.m),  l = K^-T n

    Only the direction of a normal counts. A pixel is invalid when its normal is zero, not finite, or at grazing angle
    (the cosine to the viewing direction is at most `eps`); it gets slope 0, mask False, and derivatives that are
    exactly 0. Differentiable in `normals` and `camera`.

    Args:
        normals: (N, 3, H, W) or (3, H, W), of any length.
        convention: a key of `NORMAL_CONVENTIONS` (the table of `torchdls._conventions`).
        mask: (N, 1, H, W) bool; pixels outside are not counted as invalid. Default: all pixels.
        camera: intrinsics K, (3, 3) or (N, 3, 3), in pixels, with integer coordinates at pixel centres and the first
            pixel at (0, 0). The result is then the gradient of log depth per pixel; see `log_depth_to_depth`.
        pixel_size: spacing (dx, dy) of the pixels. Leave it at 1 when the integrator is given the pixel size: the
            result is then the slope, without unit. Otherwise the result is the rise per pixel.
        eps: smallest cosine that counts as visible; 0.01 is 89.4 degrees, about one step of an 8-bit normal map.

    Returns:
        `GradientField(gradient, mask, invalid)`; unbatched input comes back unbatched.

    Raises:
        TypeError: a tensor has the wrong type.
        ValueError: a shape, the convention, the camera, `pixel_size` or `eps` is not usable, or a camera comes with
            a pixel size.

    Example:
        >>> torchdls.normals_to_gradient(torch.tensor([-0.6, 0.0, 0.8]).view(1, 3, 1, 1)).gradient.flatten()
        tensor([0.7500, 0.0000])
    """
    check_field("normals_to_gradient", "normals", normals, 3)
    axes = lookup(NORMAL_CONVENTIONS, "convention", convention)
    if mask is not None:
        check_fit("normals_to_gradient", "mask", mask, normals, "normals", channels=(1,), dtype=torch.bool)
    if not 0 <= eps < 1:
        raise ValueError(f"eps: {eps!r} given, a cosine from 0 to below 1 is needed")
    dx, dy = _pixel_size(pixel_size, camera)
    n = permute(normals, axes)
    finite = n.isfinite().all(-3, keepdim=True)
    n = torch.where(finite, n, 0)
    if camera is None:
        a, b, c = n.split(1, -3)
        numerators, length = torch.cat([-dx * a, dy * b], -3), _length(a, b, c)
    else:
        k_inv = inverse_camera(camera, normals)
        covector = apply_matrix(k_inv.mT, permute(n, inverse_axes(NORMAL_CONVENTIONS["opencv"])))
        pixel = pixel_grid(n)
        ray = apply_matrix(k_inv, pixel)
        numerators = covector[..., :2, :, :]
        c = -(covector * pixel).sum(-3, keepdim=True)
        length = _length(*n.split(1, -3)) * _length(*ray.split(1, -3))
    visible = finite & (c > eps * length.detach())
    inside = visible if mask is None else visible & mask
    # The safe denominator comes before the division: masking afterwards would multiply inf by 0 in the backward pass.
    gradient = torch.where(inside, numerators, 0) / torch.where(inside, c, 1)
    blind = ~visible if mask is None else ~visible & mask
    return GradientField(gradient, inside, blind.sum((-3, -2, -1)))


@full_precision
def gradient_to_normals(
    gradient: Tensor,
    convention: str = "opengl",
    *,
    camera: Tensor | None = None,
    pixel_size: float | Sequence[float] = 1.0,
) -> Tensor:
    r"""Unit normals of the surface with the given gradient; the inverse of `normals_to_gradient` at valid pixels.

        orthographic:  n ~ (-z_x/dx, z_y/dy, 1)            perspective:  n ~ -K^T (-u_x, -u_y, 1 + u_x column + u_y row)

    Args:
        gradient: (N, 2, H, W) or (2, H, W); of log depth when a camera is given.
        convention: the convention of the normals that are returned.
        camera: intrinsics K, (3, 3) or (N, 3, 3), as in `normals_to_gradient`.
        pixel_size: spacing (dx, dy) if the gradient is the rise per pixel; 1 if it is a slope without unit.

    Returns:
        (N, 3, H, W), of length 1; NaN where the gradient is NaN. Raises as `normals_to_gradient` does.

    Example:
        >>> torchdls.gradient_to_normals(torch.tensor([0.75, 0.0]).view(1, 2, 1, 1)).flatten()
        tensor([-0.6000,  0.0000,  0.8000])
    """
    check_field("gradient_to_normals", "gradient", gradient, 2)
    axes = lookup(NORMAL_CONVENTIONS, "convention", convention)
    dx, dy = _pixel_size(pixel_size, camera)
    gx, gy = gradient.split(1, -3)
    if camera is None:
        n = torch.cat([gx / -dx, gy / dy, torch.ones_like(gx)], -3)
    else:
        columns, rows, one = pixel_grid(gradient).split(1, -3)
        covector = torch.cat([-gx, -gy, one + gx * columns + gy * rows], -3)
        k = check_camera(camera, gradient)
        n = permute(-apply_matrix(k.mT, covector), NORMAL_CONVENTIONS["opencv"])
    n = n / n.detach().abs().amax(-3, keepdim=True)  # of order 1: the square of a slope of 1e20 is beyond float32
    return permute(n / torch.linalg.vector_norm(n, dim=-3, keepdim=True), inverse_axes(axes))


class _Conversion(nn.Module):
    camera: Tensor | None

    def __init__(
        self, convention: str = "opengl", *, camera: Tensor | None = None, pixel_size: float | Sequence[float] = 1.0
    ) -> None:
        super().__init__()
        lookup(NORMAL_CONVENTIONS, "convention", convention)
        if camera is not None:
            check_real("camera", "K", camera)
        self.convention, self.pixel_size = convention, _pixel_size(pixel_size, camera)
        if isinstance(camera, nn.Parameter):
            self.register_parameter("camera", camera)
        else:
            self.register_buffer("camera", camera)

    def extra_repr(self) -> str:
        """The options, for `repr`."""
        return f"{self.convention!r}, pixel_size={self.pixel_size}"


class NormalsToGradient(_Conversion):
    """`normals_to_gradient` as a module: normals (N, 3, H, W) in, gradient (N, 2, H, W) out.

    `nn.Sequential(normal_net, NormalsToGradient(), DLS())` trains through the integration. Invalid pixels get slope 0
    and derivative 0; call `normals_to_gradient` to know which they are. A camera that is an `nn.Parameter` is
    trained, a plain tensor is a buffer.

    Example:
        >>> model = torch.nn.Sequential(torchdls.NormalsToGradient("directx"), torchdls.LeastSquares())
        >>> model(torch.ones(1, 3, 8, 8)).shape
        torch.Size([1, 1, 8, 8])
    """

    def __init__(
        self,
        convention: str = "opengl",
        *,
        camera: Tensor | None = None,
        pixel_size: float | Sequence[float] = 1.0,
        eps: float = 1e-2,
    ) -> None:
        super().__init__(convention, camera=camera, pixel_size=pixel_size)
        self.eps = eps

    def forward(self, normals: Tensor) -> Tensor:
        """Gradient (N, 2, H, W) of normals (N, 3, H, W)."""
        field = normals_to_gradient(
            normals, self.convention, camera=self.camera, pixel_size=self.pixel_size, eps=self.eps
        )
        return field.gradient

    if TYPE_CHECKING:

        def __call__(self, normals: Tensor) -> Tensor:
            """As `forward`."""


class GradientToNormals(_Conversion):
    """`gradient_to_normals` as a module: gradient (N, 2, H, W) in, unit normals (N, 3, H, W) out.

    Example:
        >>> torchdls.GradientToNormals("directx")(torch.zeros(1, 2, 4, 5)).shape
        torch.Size([1, 3, 4, 5])
    """

    def forward(self, gradient: Tensor) -> Tensor:
        """Normals (N, 3, H, W) of a gradient (N, 2, H, W)."""
        return gradient_to_normals(gradient, self.convention, camera=self.camera, pixel_size=self.pixel_size)

    if TYPE_CHECKING:

        def __call__(self, gradient: Tensor) -> Tensor:
            """As `forward`."""


@full_precision
def guess_convention(
    normals: Tensor,
    mask: Tensor | None = None,
    candidates: Sequence[str] = ("opengl", "directx"),
    *,
    camera: Tensor | None = None,
) -> ConventionGuess:
    r"""Which convention makes the normals most nearly those of a surface.

    Second derivatives commute, so each reading is scored by the curl of its gradient over complete 2x2 cells,
    relative to the two terms that should cancel, the whole batch together:

        residual = sum |D_x g_y - D_y g_x| / max over the candidates of sum (|D_x g_y| + |D_y g_x|)

    The scale is one for all candidates: where the terms themselves are small (z_xy near 0, as at the top of a sphere),
    their ratio is noise, and the curl alone tells.

    This tells OpenGL from DirectX as far as the surface is twisted (z_xy is not 0); residuals close to each other mean
    that the data does not tell. Readings that differ by the sign of the height alone can never be told apart.

    Args:
        normals: (N, 3, H, W) or (3, H, W).
        mask: (N, 1, H, W) bool; default: all pixels.
        candidates: conventions to compare.
        camera: intrinsics K, as in `normals_to_gradient`.

    Raises as `normals_to_gradient` does, and ValueError if no candidate has a complete 2x2 cell of valid pixels.

    Example:
        >>> normals = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](32).gradient, "directx")
        >>> torchdls.guess_convention(normals).convention
        'directx'
    """
    check_field("guess_convention", "normals", normals, 3)
    total, terms = {}, 0.0
    known, sums = dict[Hashable, tuple[Axes, _Cells]](), dict[Hashable, tuple[float, float]]()
    for name in candidates:
        axes = lookup(NORMAL_CONVENTIONS, "convention", name)
        frame = name if camera is not None else axes[2]
        if frame not in known:
            known[frame] = axes, _cells(normals_to_gradient(normals.detach(), name, mask=mask, camera=camera))
        own, cells = known[frame]
        reading = _reading(own, axes)
        if (frame, reading) not in sums:
            curl, scale = _curl(cells, *reading)
            sums[frame, reading] = float(curl.sum()), float(scale.sum())
        total[name], terms = sums[frame, reading][0], max(terms, sums[frame, reading][1])
    residual = {name: value / (terms or 1.0) for name, value in total.items()}
    if not residual or min(residual.values()) == float("inf"):
        raise ValueError(f"normals: no 2x2 cell of valid pixels in any of the conventions {', '.join(candidates)}")
    return ConventionGuess(min(residual, key=residual.__getitem__), residual)


def convention_residuals(field: GradientField, convention: str, candidates: Sequence[str]) -> dict[str, Tensor]:
    """The residuals of `guess_convention` for each surface (N,) by itself, from its slopes under one convention.

    Args:
        field: slopes (N, 2, H, W) without a camera.
        convention: under which they were found.
        candidates: conventions with the same z.
    """
    own, cells = lookup(NORMAL_CONVENTIONS, "convention", convention), _cells(field)
    readings = {name: _reading(own, lookup(NORMAL_CONVENTIONS, "convention", name)) for name in candidates}
    sums = {reading: _curl(cells, *reading) for reading in set(readings.values())}
    terms = torch.stack([scale for _, scale in sums.values()]).amax(0)
    return {name: sums[reading][0] / torch.where(terms > 0, terms, 1) for name, reading in readings.items()}


class _Cells(NamedTuple):
    """Differences along x and y of both slopes (N, 2, H - 1, W - 1) on the complete 2x2 cells; are there any?"""

    x: Tensor
    y: Tensor
    some: bool


def _cells(field: GradientField) -> _Cells:
    g = field.gradient
    down, across = (g[..., 1:, :] + g[..., :-1, :]) / 2, (g[..., 1:] + g[..., :-1]) / 2
    x, y = down.diff(dim=-1), across.diff(dim=-2)
    if field.mask.all():
        return _Cells(x, y, x.numel() > 0)
    pairs = field.mask[..., 1:] & field.mask[..., :-1]
    cells = pairs[..., 1:, :] & pairs[..., :-1, :]
    return _Cells(x * cells, y * cells, bool(cells.any()))


def _reading(own: Axes, other: Axes) -> tuple[bool, bool]:
    """How slopes found under `own` read under `other`, with the same z: exchanged or not, with equal signs or not.

    Without a camera they are each other's, but for places and signs; the curl asks for the product of the signs alone.
    """
    exchanged = own[0][0] != other[0][0]
    first = own[1] if exchanged else own[0]
    second = own[0] if exchanged else own[1]
    return exchanged, other[0][1] * first[1] != other[1][1] * second[1]


def _curl(cells: _Cells, exchanged: bool, opposed: bool) -> tuple[Tensor, Tensor]:
    """The sums (N,) of the curl and of its two terms; infinite curl where there is no cell."""
    a, b = cells.x[..., 0 if exchanged else 1, :, :], cells.y[..., 1 if exchanged else 0, :, :]
    curl = (a + b if opposed else a - b).abs().sum((-2, -1))
    # A plane is a surface in every reading; a reading without any cell is none.
    return curl if cells.some else torch.full_like(curl, torch.inf), (a.abs() + b.abs()).sum((-2, -1))


def _length(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return torch.hypot(torch.hypot(a.detach(), b.detach()), c.detach())  # no overflow in the square; only compared with


def _pixel_size(pixel_size: float | Sequence[float], camera: Tensor | None) -> tuple[float, float]:
    pair = as_pixel_size(pixel_size)
    if camera is not None and pair != (1.0, 1.0):
        raise ValueError(f"pixel_size: {pixel_size!r} given beside a camera, whose intrinsics already hold it")
    return pair
