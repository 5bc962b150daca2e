"""What a user would take instead of torchdls, called with the same data. Optional packages are found or skipped."""

from __future__ import annotations

import contextlib
import importlib
import io
from typing import Any

import numpy as np
import scipy.fft
import scipy.sparse as sp
import scipy.sparse.linalg as spl


def optional(name: str) -> Any | None:
    """The module, or None and a line that says so."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # a peer may fail in its own imports
        print(f"skipped: {name} ({type(error).__name__}: {error})")
        return None


class ScipyPoisson:
    """Averaged slopes, divergence, and SciPy's cosine transforms; eigenvalues are computed once."""

    def __init__(self, h: int, w: int, dtype: Any, workers: int) -> None:
        k, m = np.arange(h), np.arange(w)
        eigenvalues = 4 * np.sin(np.pi * k / 2 / h)[:, None] ** 2 + 4 * np.sin(np.pi * m / 2 / w) ** 2
        eigenvalues[0, 0] = 1
        self.eigenvalues, self.workers = eigenvalues.astype(dtype), workers

    def __call__(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        vx, vy = 0.5 * (p[:, 1:] + p[:, :-1]), 0.5 * (q[1:] + q[:-1])
        b = np.zeros_like(p)
        b[:, :-1] -= vx
        b[:, 1:] += vx
        b[:-1] -= vy
        b[1:] += vy
        c = scipy.fft.dctn(b, norm="ortho", workers=self.workers)
        c /= self.eigenvalues
        c[0, 0] = 0
        return scipy.fft.idctn(c, norm="ortho", workers=self.workers)


def masked_system(p: np.ndarray, q: np.ndarray, mask: np.ndarray) -> tuple[sp.csr_matrix, np.ndarray]:
    """Normal equations of least squares over the edges inside a mask, the first pixel held at 0."""
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    right, down = mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:]
    a = np.concatenate([index[:, :-1][right], index[:-1][down]])
    b = np.concatenate([index[:, 1:][right], index[1:][down]])
    v = 0.5 * np.concatenate([(p[:, :-1] + p[:, 1:])[right], (q[:-1] + q[1:])[down]])
    edge, ones = np.arange(len(v)), np.ones(len(v))
    A = sp.csr_matrix((np.r_[ones, -ones], (np.r_[edge, edge], np.r_[b, a])), (len(v), int(mask.sum())))[:, 1:]
    return (A.T @ A).tocsr(), A.T @ v


def sparse_direct(p: np.ndarray, q: np.ndarray, mask: np.ndarray) -> np.ndarray:
    H, b = masked_system(p, q, mask)
    return spl.spsolve(H.tocsc(), b)


def sparse_cg(p: np.ndarray, q: np.ndarray, mask: np.ndarray) -> np.ndarray:
    H, b = masked_system(p, q, mask)
    return spl.cg(H, b, rtol=1e-8, maxiter=5000)[0]


def amg_cg(pyamg: Any, p: np.ndarray, q: np.ndarray, mask: np.ndarray) -> np.ndarray:
    H, b = masked_system(p, q, mask)
    return pyamg.ruge_stuben_solver(H).solve(b, tol=1e-8, accel="cg")


def grad2surf(module: Any, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Global least squares; the package writes to the slopes it is given."""
    h, w = p.shape
    return np.asarray(module.g2s(np.arange(float(w)), np.arange(float(h)), p.copy(), q.copy()))


def dbini(module: Any, normals: Any, mask: Any) -> Any:
    """Masked least squares: one step of bilateral integration, with k = 0 for no bilateral weights."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return module.bilateral_normal_integration(normals, mask, k=0, max_iter=1, cg_rtol=1e-6)


def spams_dictionary(spams: Any, X: np.ndarray, D: np.ndarray, passes: float, threads: int) -> np.ndarray:
    """Online learning from the dictionary D over all columns of X, so many times, five nonzeros each."""
    batches = max(1, round(passes * X.shape[1] / 512))
    settings = {"K": D.shape[1], "lambda1": 5, "mode": 3, "batchsize": 512, "numThreads": threads}
    return spams.trainDL(X, D=D, iter=batches, verbose=False, **settings)


def spams_error(spams: Any, X: np.ndarray, D: np.ndarray) -> float:
    """||X - D B||^2 / ||X||^2 with five nonzeros per column by orthogonal matching pursuit."""
    B = spams.omp(X, np.asfortranarray(D), L=5, eps=0.0, numThreads=1)
    return float(np.square(X - D @ B.toarray()).sum() / np.square(X).sum())
