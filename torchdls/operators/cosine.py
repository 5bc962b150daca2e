"""Orthonormal cosine transforms of the last two dimensions, and the Laplacian that they diagonalise."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchdls._checks import check_real, require
from torchdls._precision import full_precision
from torchdls._tracing import is_recorded
from torchdls.operators.tables import table

# Up to this side two products with the cosine matrix beat the FFT and its reordering passes (measured on a CPU).
MATRIX_LIMIT = 64


@full_precision
def dct2(x: Tensor) -> Tensor:
    r"""Orthonormal two-dimensional DCT-II.

        C[k, l] = c_k d_l \sum_{i, j} x[i, j] \cos(\pi k (2 i + 1) / 2H) \cos(\pi l (2 j + 1) / 2W)

    with c_0 = sqrt(1/H), c_k = sqrt(2/H) and d alike in W: the transform is an orthogonal matrix, so its transpose is
    `idct2`, and it diagonalises the second differences of a grid with free (Neumann) borders.

    Args:
        x: (..., H, W), float32 or float64.

    Returns:
        (..., H, W), in the dtype and on the device of `x`.

    Raises:
        TypeError: `x` is not a tensor of float32 or float64.
        ValueError: `x` is empty or has fewer than two dimensions.

    Source: Makhoul, "A fast cosine transform in one and two dimensions", IEEE TASSP 28(1), 1980.

    Example:
        >>> coefficients = torchdls.dct2(torch.ones(4, 4))
        >>> round(float(coefficients[0, 0]), 3)  # a constant is the first atom alone
        4.0
        >>> round(float(coefficients.norm()), 3)
        4.0
    """
    _check("dct2", x)
    h, w = x.shape[-2:]
    if max(h, w) <= MATRIX_LIMIT:
        return cosine_matrix(h, like=x) @ x @ cosine_matrix(w, like=x).mT
    if plain(x):
        return torch.from_numpy(_scipy().dctn(x.detach().numpy(), **_how()))
    spectrum = torch.fft.rfft2(_reordered(x))
    p = spectrum * _twiddle(h, w, like=x)
    q = _negate_rows(spectrum).conj() * _twiddle_conj(h, w, like=x)
    head, tail = (p + q).real, (q - p).imag
    return torch.cat([head, tail[..., 1 : (w + 1) // 2].flip(-1)], -1)


@full_precision
def idct2(x: Tensor) -> Tensor:
    """Inverse, and transpose, of `dct2`.

    Args:
        x: (..., H, W) coefficients, float32 or float64.

    Returns:
        (..., H, W), in the dtype and on the device of `x`. Raises as `dct2` does.

    Raises:
        TypeError: as `dct2`.
        ValueError: as `dct2`.

    Example:
        >>> x = torch.eye(5)
        >>> torch.allclose(torchdls.idct2(torchdls.dct2(x)), x, atol=1e-6)
        True
    """
    _check("idct2", x)
    h, w = x.shape[-2:]
    if max(h, w) <= MATRIX_LIMIT:
        return cosine_matrix(h, like=x).mT @ x @ cosine_matrix(w, like=x)
    if plain(x):
        return torch.from_numpy(_scipy().idctn(x.detach().numpy(), **_how()))
    # The spectrum of the reordered image, from sums C without their scale, and C[H, .] = C[., W] = 0:
    # V[k, l] = conj(a_k b_l) ((C[k, l] - C[H-k, W-l]) - i (C[H-k, l] + C[k, W-l])).
    head = x[..., : w // 2 + 1]
    tail = torch.nn.functional.pad(x[..., w - w // 2 :].flip(-1), (1, 0))
    spectrum = torch.complex(head - _reverse_rows(tail), -(_reverse_rows(head) + tail))
    y = torch.fft.irfft2(spectrum * _inverse_twiddle(h, w, like=x), s=(h, w))
    return _restored(y)


def plain(x: Tensor) -> bool:
    """Whether SciPy may do the transforms, in a third of the time: on the CPU, where nothing is recorded."""
    return x.device.type == "cpu" and not is_recorded(x)


def filtered(x: Tensor, gain: Tensor) -> Tensor:
    """idct2(gain * dct2(x)) of a `plain` x, in the memory of the result alone."""
    coefficients = _scipy().dctn(x.detach().numpy(), **_how())
    torch.from_numpy(coefficients).mul_(gain)
    return torch.from_numpy(_scipy().idctn(coefficients, overwrite_x=True, **_how()))


def _scipy() -> Any:
    """Loaded when first used."""
    import scipy.fft

    return scipy.fft


def _how() -> dict[str, Any]:
    return {"axes": (-2, -1), "norm": "ortho", "workers": torch.get_num_threads()}


def _check(name: str, x: Tensor) -> None:
    check_real(name, "x", x)
    require(x.ndim >= 2 and 0 not in x.shape, f"{name}: x {tuple(x.shape)} given, (..., H, W) is needed")


def half_spectrum(x: Tensor) -> tuple[Tensor, Tensor]:
    """U (.., H, W//2 + 1): one FFT that holds the cosine sums C of x, four to a number.

        U[k, l] = (C[k, l] - C[H-k, W-l]) - i (C[H-k, l] + C[k, W-l]),     C[H, .] = C[., W] = 0

    with C[k, l] = sum_ij x[i, j] cos(pi k (2 i + 1) / 2H) cos(pi l (2 j + 1) / 2W). A linear map that is diagonal in C
    need not unpack it. x (.., H, W) is not written to.

    Returns:
        U, and memory of the size of x for `from_half_spectrum`: fresh pages cost large images more than arithmetic.
    """
    h, w = x.shape[-2:]
    room = _reordered(x)
    return torch.fft.rfft2(room).mul_(_rotation(h, w, like=x)), room


def from_half_spectrum(spectrum: Tensor, room: Tensor, into: Tensor | None = None) -> Tensor:
    """Inverse of `half_spectrum`; overwrites its arguments, and writes to `into`, contiguous, if it is given."""
    h, w = room.shape[-2:]
    spectrum.mul_(_rotation_back(h, w, like=room))  # the rotation holds the scale
    if torch.compiler.is_compiling():
        return _restored(torch.fft.irfft2(spectrum, s=(h, w), norm="forward"))
    return _restored(torch.fft.irfft2(spectrum, s=(h, w), norm="forward", out=room), into)


def mirrored(spectrum: Tensor) -> Tensor:
    """For U (.., H, M): row H - k in row k, for k = 1 .. H - 1, with real and imaginary part swapped."""
    return spectrum[..., 1:, :].flip(-2).mul_(-1j).conj_physical_()


def neumann_eigenvalues(shape: tuple[int, int], like: Tensor, pixel_size: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    """(H, W) eigenvalues of A^T A for the forward (or backward) differences A, in the basis of `dct2`.

        4 sin^2(pi k / 2H) / dy^2 + 4 sin^2(pi l / 2W) / dx^2

    Built in float64 and then cast to the dtype of `like`. Source: Simchony, Chellappa, Shao, IEEE TPAMI 12(5), 1990.
    """
    return _eigenvalues(*shape, *pixel_size, like=like)


@table
def _eigenvalues(h: int, w: int, dx: float, dy: float) -> Tensor:
    rows = (2 / dy * torch.sin(torch.arange(h, dtype=torch.float64, device="cpu") * (math.pi / (2 * h)))).square()
    columns = (2 / dx * torch.sin(torch.arange(w, dtype=torch.float64, device="cpu") * (math.pi / (2 * w)))).square()
    return rows[:, None] + columns


@table
def cosine_matrix(n: int) -> Tensor:
    """(n, n) orthonormal DCT-II matrix: row k is c_k cos(pi k (2 i + 1) / 2n)."""
    k = torch.arange(n, device="cpu")
    angle = (k[:, None] * (2 * k + 1)) % (4 * n)  # exact integers: no accuracy lost to a large argument of the cosine
    return torch.cos(angle.double() * (math.pi / (2 * n))) * _scale(n)[:, None]


def _scale(n: int) -> Tensor:
    scale = torch.full((n,), math.sqrt(2 / n), dtype=torch.float64, device="cpu")
    scale[0] = math.sqrt(1 / n)
    return scale


def _phase(n: int, count: int) -> Tensor:
    """(count,) factors exp(-i pi k / 2n)."""
    angle = torch.arange(count, dtype=torch.float64, device="cpu") * (-math.pi / (2 * n))
    return torch.polar(torch.ones_like(angle), angle)


@table
def _rotation(h: int, w: int) -> Tensor:
    return _phase(h, h)[:, None] * _phase(w, w // 2 + 1)


@table
def _rotation_back(h: int, w: int) -> Tensor:
    return (_phase(h, h)[:, None] * _phase(w, w // 2 + 1)).conj().resolve_conj() / (h * w)


@table
def _twiddle(h: int, w: int) -> Tensor:
    scale = _scale(h)[:, None] * _scale(w)[: w // 2 + 1] / 2
    return scale * _phase(h, h)[:, None] * _phase(w, w // 2 + 1)


@table
def _twiddle_conj(h: int, w: int) -> Tensor:
    scale = _scale(h)[:, None] * _scale(w)[: w // 2 + 1] / 2
    return scale * _phase(h, h)[:, None] * _phase(w, w // 2 + 1).conj()


@table
def _inverse_twiddle(h: int, w: int) -> Tensor:
    weight = _scale(h)[:, None] * _scale(w)[: w // 2 + 1]
    return (_phase(h, h)[:, None] * _phase(w, w // 2 + 1)).conj() / weight


@table
def _order(h: int, w: int) -> Tensor:
    """(H W,) positions of the pixels with rows and columns in the order 0 2 4 .. 5 3 1.

    In this order an FFT of the same length gives the DCT.
    """
    rows, columns = (torch.cat([k[::2], k[1::2].flip(0)]) for k in (torch.arange(n, device="cpu") for n in (h, w)))
    return (rows[:, None] * w + columns).flatten()


@table
def _order_back(h: int, w: int) -> Tensor:
    return _order(h, w, like=torch.empty(0, device="cpu")).argsort()


def _reordered(x: Tensor) -> Tensor:
    return _gathered(x, _order(*x.shape[-2:], like=x))


def _restored(y: Tensor, into: Tensor | None = None) -> Tensor:
    """Inverse of `_reordered`."""
    return _gathered(y, _order_back(*y.shape[-2:], like=y), into)


def _gathered(x: Tensor, positions: Tensor, into: Tensor | None = None) -> Tensor:
    """The pixels of every image at these positions; several times faster than strided copies."""
    flat = x.flatten(-2)
    if flat.numel() == len(positions) and not torch.compiler.is_compiling():  # a single image: faster again
        out = None if into is None else into.view(-1)
        return torch.index_select(flat.flatten(), 0, positions, out=out).view(x.shape)
    out = None if into is None else into.view(flat.shape)
    return torch.gather(flat, -1, positions.expand(flat.shape), out=out).view(x.shape)


def _negate_rows(v: Tensor) -> Tensor:
    """Row k becomes row -k modulo H."""
    return torch.cat([v[..., :1, :], v[..., 1:, :].flip(-2)], -2)


def _reverse_rows(v: Tensor) -> Tensor:
    """Row k becomes row H - k, with zeros for k = 0."""
    return torch.nn.functional.pad(v[..., 1:, :].flip(-2), (0, 0, 1, 0))
