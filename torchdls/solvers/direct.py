"""The direct solve: shifted Poisson equations on a rectangle, diagonal in the cosine basis."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls._tracing import is_concrete, is_recorded
from torchdls.operators import dct2, idct2, neumann_eigenvalues, slope_divergence
from torchdls.operators.cosine import (
    MATRIX_LIMIT,
    cosine_matrix,
    filtered,
    from_half_spectrum,
    half_spectrum,
    mirrored,
    plain,
)  # fmt: skip
from torchdls.operators.tables import table
from torchdls.solvers.cg import LinearMap

# Pixels of small surfaces that are transformed together: they stay in the cache from one pass to the next.
_IN_CACHE = 2**18

# Sides up to which four products with matrices are faster than the FFT and what it needs around it (measured on a CPU).
_PRODUCTS = 128


def solve_direct(b: Tensor, r: Tensor | float | None, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """(A^T A + r)^{-1} b by cosine transforms, r one number per surface (N, 1, 1, 1); zero mean where r = 0.

    The map is symmetric: its derivative in b is itself, and with lambda = (A^T A + r)^{-1} dL/dz, dL/dr = -<lambda, z>.

    Args:
        b: (N, 1, H, W).
        r: (N, 1, 1, 1), a number, or None for 0.
        pixel_size: (dx, dy).
    """
    r = torch.as_tensor(r, dtype=b.dtype, device=b.device) if isinstance(r, int | float) else r
    if torch.compiler.is_compiling() or not is_recorded(b, *([] if r is None else [r])):
        return direct_map((b.shape[-2], b.shape[-1]), r, pixel_size, b)(b)
    return _Direct.apply(b, r, pixel_size)


def integrate_direct(gradient: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """argmin_z ||A z - v||^2 (N, 1, H, W) for the slopes v = `edge_slopes(gradient)` of full rectangles, mean 0."""
    if max(gradient.shape[-2:]) <= _PRODUCTS:
        return _few_at_a_time(lambda g: _by_products(g, pixel_size), gradient)
    if is_recorded(gradient):
        return _few_at_a_time(lambda g: solve_direct(slope_divergence(g, pixel_size), None, pixel_size), gradient)
    solve_part = direct_map((gradient.shape[-2], gradient.shape[-1]), None, pixel_size, gradient, overwrite=True)
    return _few_at_a_time(lambda g: solve_part(slope_divergence(g, pixel_size)), gradient)


def _by_products(gradient: Tensor, pixel_size: tuple[float, float]) -> Tensor:
    """`integrate_direct` of small surfaces as products with matrices of their sides, which any transform can follow.

        z = C_y^T (gain * (C_y g_x (C_x T_x)^T + C_y T_y g_y C_x^T)) C_x

    with the cosine matrices C, the divergence along a line T (see `slope_divergence`), and gain = 1 / eigenvalue.
    """
    (h, w), (dx, dy) = gradient.shape[-2:], pixel_size
    across, down, back, forth, gain = _products(h, w, dx, dy, like=gradient)
    if gradient.shape[0] == 1 and not torch.compiler.is_compiling():  # the same by plain products, without a batch
        sums = down.mm(gradient[0].bmm(across).view(2 * h, w))
        return back.mm(sums * gain).mm(forth)[None, None]
    sums = down @ (gradient @ across).flatten(1, 2)
    return (back @ (sums * gain) @ forth)[:, None]


@table
def _products(h: int, w: int, dx: float, dy: float) -> tuple[Tensor, ...]:
    """What `_by_products` multiplies by.

    Returns:
        What the rows of g_x and of g_y are multiplied by from the right (2, W, W); by what the columns of both are then
        multiplied from the left and added up (H, 2H); the transpose of C_y; C_x; the gain.
    """
    rows, columns = _cosine(h), _cosine(w)
    across = torch.stack([(columns @ _line_divergence(w, dx)).mT, columns.mT])
    down = torch.cat([rows, rows @ _line_divergence(h, dy)], 1)
    gain = _inverse(neumann_eigenvalues((h, w), torch.zeros(0, dtype=torch.float64, device="cpu"), (dx, dy)))
    return across, down, rows.mT.contiguous(), columns, gain


@table
def _gain(h: int, w: int, dx: float, dy: float) -> Tensor:
    return _inverse(neumann_eigenvalues((h, w), torch.zeros(0, dtype=torch.float64, device="cpu"), (dx, dy)))


def _cosine(n: int) -> Tensor:
    return cosine_matrix(n, like=torch.zeros(0, dtype=torch.float64, device="cpu"))


def _line_divergence(n: int, d: float) -> Tensor:
    """(n, n) matrix of (g_{j-1} - g_{j+1}) / 2d along a line, continued with opposite sign; a part of tables."""
    one = torch.ones(n - 1, dtype=torch.float64, device="cpu")
    T = torch.diag(one, -1) - torch.diag(one, 1)
    T[0, 0] -= 1
    T[-1, -1] += 1
    return T * (0.5 / d)


def _few_at_a_time(height: LinearMap, x: Tensor) -> Tensor:
    """Heights (N, 1, H, W) of a batch x (N, C, H, W), as many surfaces at once as stay in the cache."""
    several = max(1, _IN_CACHE // (x.shape[-2] * x.shape[-1]))
    if torch.compiler.is_compiling() or len(x) <= several:  # a graph serves every batch size
        return height(x)
    if is_recorded(x):
        return torch.cat([height(part) for part in x.split(several)])
    result = torch.empty_like(x[:, :1], memory_format=torch.contiguous_format)
    for part, piece in zip(x.split(several), result.split(several), strict=True):
        piece.copy_(height(part))
    return result


def direct_map(
    size: tuple[int, int],
    r: Tensor | None,
    pixel_size: tuple[float, float],
    like: Tensor,
    overwrite: bool = False,
) -> LinearMap:
    """The map b -> (A^T A + r)^{-1} b for repeated use: its gains are computed once. It may overwrite b on request."""
    small, by_scipy = max(size) <= MATRIX_LIMIT, plain(like) and (r is None or plain(r))
    if small or by_scipy:
        if r is None:
            gain = _gain(*size, *pixel_size, like=like)
        else:
            gain = _inverse(neumann_eigenvalues(size, like, pixel_size) + r)
        if small:
            return lambda b: idct2(dct2(b) * gain)
        shared = gain.ndim == 2 or len(gain) == 1
        return lambda b: _few_at_a_time(lambda x: filtered(x, gain), b) if shared else filtered(b, gain)
    own, other = _tables(size, r, pixel_size, like)

    def solve_part(b: Tensor) -> Tensor:
        spectrum, room = half_spectrum(b)
        values = torch.view_as_real(spectrum)
        opposite = torch.view_as_real(mirrored(spectrum))
        values.mul_(own)[..., 1:, :, :].addcmul_(opposite, other, value=-1)
        return from_half_spectrum(spectrum, room, b if overwrite else None)

    alike = own.ndim == 3 or len(own) == 1  # one table for all surfaces
    return (lambda b: _few_at_a_time(solve_part, b)) if alike else solve_part


def _inverse(eigenvalues: Tensor) -> Tensor:
    singular = eigenvalues == 0
    return torch.where(singular, 0, 1 / torch.where(singular, 1, eigenvalues))


def _tables(
    size: tuple[int, int], r: Tensor | None, pixel_size: tuple[float, float], like: Tensor
) -> tuple[Tensor, Tensor]:
    """Gains of the half spectrum: what U[k, l] keeps, and what U[H - k, l] passes to it.

    U mixes four cosine coefficients C (see `half_spectrum`), whose eigenvalues differ. With f the inverse eigenvalue of
    C[k, l], f' of C[H-k, W-l], g of C[H-k, l], g' of C[k, W-l], multiplying every coefficient by its own gives

        Re U <- (f + f')/2 Re U - (f - f')/2 Im U~        Im U <- (g + g')/2 Im U - (g - g')/2 Re U~

    with U~ the same column in row H - k; in row 0 there is none and Re U <- f Re U, Im U <- g' Im U.
    """
    if r is None or (is_concrete(r) and not bool(r.any())):
        return _own(*size, *pixel_size, like=like), _other(*size, *pixel_size, like=like)
    return _gains(size, pixel_size, r.to(like))


@table
def _own(h: int, w: int, dx: float, dy: float) -> Tensor:
    return _gains((h, w), (dx, dy), torch.zeros(1, 1, 1, dtype=torch.float64, device="cpu"))[0][0]


@table
def _other(h: int, w: int, dx: float, dy: float) -> Tensor:
    return _gains((h, w), (dx, dy), torch.zeros(1, 1, 1, dtype=torch.float64, device="cpu"))[1][0]


def _gains(size: tuple[int, int], pixel_size: tuple[float, float], r: Tensor) -> tuple[Tensor, Tensor]:
    (h, w), (dx, dy) = size, pixel_size
    y = neumann_eigenvalues((h, 1), r, (1.0, dy))
    x = neumann_eigenvalues((1, w), r, (dx, 1.0))[:, : w // 2 + 1]
    y_mirror, x_mirror = 4 / dy**2 - y, 4 / dx**2 - x
    f, f_mirror, g, g_mirror = (
        _inverse(a + b + r) for a, b in ((y, x), (y_mirror, x_mirror), (y_mirror, x), (y, x_mirror))
    )
    own = torch.stack([f + f_mirror, g + g_mirror], -1) / 2
    own[..., 0, :, :] = torch.stack([f[..., 0, :], g_mirror[..., 0, :]], -1)
    other = torch.stack([f - f_mirror, g - g_mirror], -1)[..., 1:, :, :] / 2
    return own, other


class _Direct(torch.autograd.Function):
    """z = (A^T A + r)^+ b, symmetric in b."""

    @staticmethod
    def forward(b: Tensor, r: Tensor | None, pixel_size: tuple[float, float]) -> Tensor:
        return direct_map((b.shape[-2], b.shape[-1]), r, pixel_size, b)(b)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, r, ctx.pixel_size = inputs
        saved = (None, None) if r is None else (r, output)
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)

    @staticmethod
    @full_precision
    def backward(ctx: Any, dz: Tensor) -> tuple[Tensor | None, ...]:
        r, z = ctx.saved_tensors
        adjoint = _Direct.apply(dz, r, ctx.pixel_size)
        dr = -(adjoint * z).sum_to_size(r.shape) if ctx.needs_input_grad[1] else None
        return adjoint, dr, None

    @staticmethod
    def jvp(ctx: Any, db: Tensor | None, dr: Tensor | None, *_: Any) -> Tensor:
        r, z = ctx.saved_tensors
        change = db if dr is None else -dr * z if db is None else db - dr * z
        return _Direct.apply(change, r, ctx.pixel_size)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], b: Tensor, r: Tensor | None, pixel_size: tuple[float, float]
    ) -> tuple[Tensor, int]:
        size = info.batch_size
        b = b.expand(size, *b.shape) if in_dims[0] is None else b.movedim(in_dims[0], 0)
        if r is not None:
            r = r.expand(size, *r.shape) if in_dims[1] is None else r.movedim(in_dims[1], 0)
            r = r.reshape(size, -1, 1, 1, 1).expand(size, b.shape[1], 1, 1, 1).flatten(0, 1)
        return _Direct.apply(b.flatten(0, 1), r, pixel_size).unflatten(0, (size, -1)), 0
