"""Dictionaries to start from."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdls._checks import check_dtype


def dct_dictionary(
    patch_size: int | tuple[int, int] = 8,
    n_atoms: int | None = None,
    *,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    r"""Separable cosine dictionary D (n, K) of unit-norm atoms, square or overcomplete.

    Atom (p, q) is the outer product of cos(pi p (2 i + 1) / 2 P) over the rows i and cos(pi q (2 j + 1) / 2 Q) over the
    columns j. With P, Q the sides of the patch the atoms are the orthonormal two-dimensional DCT (K = n). For other K,
    P and Q are the smallest sides, grown in proportion, with P Q >= K; all atoms but the constant have their mean
    removed (as in Aharon, Elad, Bruckstein 2006), and the K of lowest frequency (p/P)^2 + (q/Q)^2 are kept.

    Args:
        patch_size: rows and columns c_y, c_x of a patch, or one number for both.
        n_atoms: K; None for the square dictionary, K = n = c_y c_x.
        dtype: of the result; computed in float64.
        device: of the result.

    Returns:
        (n, K), atoms flattened row by row; atom 0 is the constant.

    Raises:
        TypeError: the dtype is not float32 or float64.
        ValueError: a size or the number of atoms is not positive.

    Example:
        >>> D = torchdls.dct_dictionary(8)
        >>> D.shape
        torch.Size([64, 64])
        >>> torch.allclose(D.T @ D, torch.eye(64), atol=1e-5)
        True
    """
    check_dtype("dct_dictionary", dtype)
    sides = (patch_size, patch_size) if isinstance(patch_size, int) else patch_size
    if not isinstance(sides, tuple) or len(sides) != 2 or not all(isinstance(c, int) and c > 0 for c in sides):
        raise ValueError(f"patch_size: {patch_size!r} given, a positive integer or a pair (rows, columns) is needed")
    c_y, c_x = sides
    n_atoms = c_y * c_x if n_atoms is None else n_atoms
    if not isinstance(n_atoms, int) or n_atoms < 1:
        raise ValueError(f"n_atoms: {n_atoms!r} given, a positive integer is needed")
    if c_y == c_x == 1 < n_atoms:
        raise ValueError(f"n_atoms: {n_atoms} given, but a patch of one pixel has only the constant atom")
    rows, columns = _sides(c_y, c_x, n_atoms)
    atoms = torch.einsum("ip,jq->ijpq", _cosines(c_y, rows), _cosines(c_x, columns)).reshape(c_y * c_x, rows * columns)
    p, q = torch.meshgrid(torch.arange(rows, device="cpu"), torch.arange(columns, device="cpu"), indexing="ij")
    frequency = ((p / rows).square() + (q / columns).square()).flatten()
    if n_atoms < rows * columns:
        atoms = atoms[:, frequency.argsort(stable=True)[:n_atoms]]
    return atoms.to(dtype).to(device)


def _sides(c_y: int, c_x: int, n_atoms: int) -> tuple[int, int]:
    """Numbers of frequencies down and across: the patch's own for up to n atoms, else grown in proportion."""
    if n_atoms <= c_y * c_x:
        return c_y, c_x
    if c_y == 1 or c_x == 1:  # along one pixel there is nothing but the constant
        return (1, n_atoms) if c_y == 1 else (n_atoms, 1)
    growth = math.sqrt(n_atoms / (c_y * c_x))
    rows = math.ceil(c_y * growth - 1e-9)
    return rows, math.ceil(n_atoms / rows)


def _cosines(c: int, count: int) -> Tensor:
    """(c, count) unit-norm samples of cosines with `count` frequencies over c points, means removed."""
    i = torch.arange(c, dtype=torch.float64, device="cpu")[:, None]
    k = torch.arange(count, dtype=torch.float64, device="cpu")
    waves = torch.cos(math.pi * k * (2 * i + 1) / (2 * count if count > c else 2 * c))
    waves[:, 1:] -= waves[:, 1:].mean(0)
    return waves / waves.norm(dim=0)
