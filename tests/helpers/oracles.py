"""Slow, plain twins of the core in NumPy and SciPy, written from the equations."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from torch import Tensor

Array = np.ndarray


def differences(h: int, w: int, dx: float = 1.0, dy: float = 1.0) -> sp.csr_matrix:
    """Forward differences of an h x w image, row by row: first the h (w-1) edges along x, then the (h-1) w along y."""

    def along(n: int, d: float) -> sp.csr_matrix:
        return (
            sp.diags([-np.ones(n - 1), np.ones(n - 1)], [0, 1], shape=(n - 1, n)) / d
            if n > 1
            else sp.csr_matrix((0, 1))
        )

    return sp.vstack([sp.kron(sp.eye(h), along(w, dx)), sp.kron(along(h, dy), sp.eye(w))]).tocsr()


def edge_vector(field: Tensor) -> Array:
    """An edge field (2, H, W) without its absent entries, in the order of `differences`."""
    x, y = field.numpy()
    return np.concatenate([x[:, :-1].ravel(), y[:-1].ravel()])


def normal_equations(
    v: Tensor, w: Tensor | None, anchor: Tensor | None, r: Tensor | None, pixel_size: tuple[float, float] = (1.0, 1.0)
) -> tuple[sp.csc_matrix, Array]:
    """H = A^T W A + R and b = A^T W v + R a of one surface: v (2, H, W), the others (2, H, W) or (1, H, W) or None."""
    h, wd = v.shape[-2:]
    A = differences(h, wd, *pixel_size)
    W = np.ones(A.shape[0]) if w is None else edge_vector(w)
    R = np.zeros(h * wd) if r is None else r.numpy().ravel()
    a = np.zeros(h * wd) if anchor is None else anchor.numpy().ravel()
    return (A.T @ sp.diags(W) @ A + sp.diags(R)).tocsc(), A.T @ (W * edge_vector(v)) + R * a


def component_labels(H: sp.spmatrix) -> Array:
    """The connected component of each pixel, from the matrix that couples them."""
    return connected_components(H, directed=False)[1]


def sparse_solve(
    v: Tensor,
    w: Tensor | None = None,
    anchor: Tensor | None = None,
    r: Tensor | None = None,
    pixel_size: tuple[float, float] = (1.0, 1.0),
) -> Array:
    """Minimiser (H, W) of (*), one factorisation per component; zero mean where no anchor holds it."""
    H, b = normal_equations(v, w, anchor, r, pixel_size)
    R = np.zeros(H.shape[0]) if r is None else r.numpy().ravel()
    z, labels = np.zeros(H.shape[0]), component_labels(H)
    for label in range(labels.max() + 1):
        inside = np.flatnonzero(labels == label)
        free = not (R[inside] > 0).any()
        unknown = inside[1:] if free else inside  # a free component is pinned at one pixel and shifted afterwards
        if len(unknown):
            z[unknown] = spsolve(H[unknown][:, unknown], b[unknown])
        if free:
            z[inside] -= z[inside].mean()
    return z.reshape(v.shape[-2:])


def soup_dil(
    P: Array,
    D: Array,
    B: Array,
    mu: Array,
    bound: float = np.inf,
    order: str = "atom",
    unused: str = "first",
    learn: bool = True,
) -> tuple[Array, Array]:
    """One sweep of SOUP-DIL on P (n, L), D (n, K), B (K, L), mu (K,), as the paper writes it: E_i formed each time."""
    D, B = D.copy(), B.copy()

    def without(i: int) -> Array:
        others = [k for k in range(D.shape[1]) if k != i]
        return P - D[:, others] @ B[others]

    def code(i: int) -> None:
        x = D[:, i] @ without(i)
        B[i] = np.clip(np.where(np.abs(x) > mu[i], x, 0), -bound, bound)

    def atom(i: int) -> None:
        h = without(i) @ B[i]
        if np.any(B[i]) and np.linalg.norm(h) > 0:
            D[:, i] = h / np.linalg.norm(h)
        elif unused == "first":
            D[:, i] = np.eye(len(D))[0]

    atoms = range(D.shape[1])
    if not learn:
        steps = [(code, i) for i in atoms]
    elif order == "atom":
        steps = [step for i in atoms for step in ((code, i), (atom, i))]
    else:
        steps = [(code, i) for i in atoms] + [(atom, i) for i in atoms]
    for step, i in steps:
        step(i)
    return D, B
