"""Normals among outliers, all pixels together: images of a Lambertian surface span three dimensions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdls._precision import full_precision
from torchdls._tracing import is_concrete
from torchdls.photometric.least_squares import lit_samples
from torchdls.photometric.model import PhotometricResult, check, covariance, fit, result


@full_precision
def low_rank_normals(
    images: Tensor,
    lights: Tensor,
    *,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    shadow: float | None = 0.05,
    sparsity: float = 1.0,
    max_iter: int = 500,
    tol: float = 1e-4,
) -> PhotometricResult:
    r"""Normals by robust principal components: the images are a low-rank matrix with sparse errors.

        min ||A||_* + lam ||E||_1   subject to   I = A + E on the samples in use,   lam = sparsity / sqrt(pixels)

    over the K x (H W) matrix I of a surface. Samples in shadow are left out (their E is free), highlights go to E; then
    b solves least squares on A. By the alternating direction method of multipliers (the augmented Lagrangian of the
    paper with a fixed penalty), each surface until both |I - A - E| and the last change of A are at most `tol` of |I|.
    The derivative is that of the iterations run, in images and lights, the penalty held fixed: exact in the limit.

    Args:
        images: (N, K, H, W) or (K, H, W), one per light, K at least 3; to be robust, 10 or more.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read.
        lit: (N, K, H, W) bool, False where a sample must not be used.
        shadow: leave out samples of at most this part of the pixel's brightest, as `woodham` does; None for none.
        sparsity: factor on lam, positive; smaller calls more samples outliers. The model has no dense noise: at 17 dB
            and 60 lights normals err by 3.8 degrees with 1, by 2.7 with 1.5, where highlights cost half as much again.
        max_iter: limit of iterations.
        tol: relative misfit and change at which a surface stops.

    Returns:
        PhotometricResult(normals, albedo, confidence, covariance).

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or an option is out of range.

    Source: Wu, Ganesh, Shi, Matsushita, Wang, Ma, "Robust photometric stereo via low-rank matrix completion and
    recovery", ACCV 2010; Lin, Chen, Ma, "The augmented Lagrange multiplier method for exact recovery of corrupted
    low-rank matrices", 2010.

    Example:
        >>> normals = torchdls.gradient_to_normals(torchdls.SURFACES["peaks"](16).gradient)
        >>> lights = torchdls.ring_of_lights(12)
        >>> images = torchdls.render(normals, lights)
        >>> images[:, 0, 4:8, 4:8] += 1.0  # a highlight
        >>> methods = torchdls.woodham, torchdls.low_rank_normals
        >>> [round(float((method(images, lights).normals - normals).abs().max()), 1) for method in methods]
        [0.3, 0.1]
    """
    samples = check("low_rank_normals", images, lights, mask, lit)
    if not sparsity > 0 or not tol > 0 or not isinstance(max_iter, int) or max_iter < 1:
        raise ValueError(
            f"low_rank_normals: sparsity={sparsity!r} and tol={tol!r} must be positive, max_iter={max_iter!r} an "
            "integer of at least 1"
        )
    if shadow is not None:
        samples = samples._replace(lit=lit_samples("low_rank_normals", samples.images, samples.lit, shadow))
    known = torch.ones_like(samples.images, dtype=torch.bool) if samples.lit is None else samples.lit
    pixels = known.any(1).flatten(1).sum(1).clamp(min=known.shape[1])
    lam = sparsity / pixels.to(images.dtype).sqrt()
    low_rank = robust_pca(samples.images.flatten(2), known.flatten(2), lam, max_iter, tol).view_as(known)
    # A pixel that three samples do not determine stays unknown, whatever the other pixels say about it.
    _, some = covariance(samples.lights, known.to(images.dtype))
    b, _ = fit(torch.where(some, low_rank, 0), samples.lights)
    return result(b, samples)


def robust_pca(data: Tensor, known: Tensor, lam: Tensor, max_iter: int = 500, tol: float = 1e-4) -> Tensor:
    """The low-rank part A of data (N, K, M): min ||A||_* + lam ||E||_1 with A + E = data where `known`; lam (N,)."""
    data = torch.where(known, data, 0)
    lam, norm = lam[:, None, None], data.detach().flatten(1).norm(dim=1)
    mean = data.detach().abs().mean((1, 2), keepdim=True)
    step = 4 * torch.where(mean > 0, mean, 1)  # 1 / penalty, in units of the data; fixed, so that derivatives converge
    low_rank = error = dual = torch.zeros_like(data)
    active = torch.ones_like(norm, dtype=torch.bool)
    for _ in range(max_iter):
        old = low_rank, error, dual
        low_rank = shrink_singular_values(data - error + dual, step)
        rest = data - low_rank + dual
        level = torch.where(known, lam * step, 0)
        error = torch.where(rest.abs() > level, rest - rest.sign() * level, 0)
        dual = rest - error
        misfit, change = data - low_rank - error, low_rank - old[0]
        low_rank, error, dual = (
            torch.where(active[:, None, None], n, o) for n, o in zip((low_rank, error, dual), old, strict=True)
        )
        largest = torch.maximum(misfit.detach().flatten(1).norm(dim=1), change.detach().flatten(1).norm(dim=1))
        active = active & (largest > tol * norm)
        if is_concrete(active) and not bool(active.any()):
            break
    return low_rank


def shrink_singular_values(x: Tensor, level: Tensor) -> Tensor:
    """U max(S - level, 0) V^T of x = U S V^T, for few rows: (N, K, M), level (N, 1, 1), which gets no derivative."""
    factor, _, _ = _Shrinkage.apply(_gram(x), level.detach())
    return factor.to(x.dtype) @ x


def _gram(x: Tensor) -> Tensor:
    """X X^T in float64 where there is one: squaring halves the digits of small singular values."""
    wide = x if x.device.type == "mps" else x.double()
    return wide @ wide.mT


class _Shrinkage(torch.autograd.Function):
    r"""U g(S) U^T of a symmetric matrix U S U^T, with g(s) = max(0, 1 - level / sqrt(s)).

    Its derivative, by divided differences of g, is finite where eigenvalues meet; that of `eigh` is not.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(gram: Tensor, level: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        values, vectors = torch.linalg.eigh(gram)
        root = values.clamp(min=0).sqrt()
        level = level[..., 0].to(root)
        kept = root > level
        safe = torch.where(kept, root, 1)
        factor = torch.where(kept, 1 - level / safe, 0)
        slope = torch.where(kept, level / (2 * safe**3), 0)
        gap = values[..., :, None] - values[..., None, :]
        apart = gap.abs() > 1e-9 * values[..., -1:, None].abs()
        steps = factor[..., :, None] - factor[..., None, :]
        mean = (slope[..., :, None] + slope[..., None, :]) / 2
        return (
            (vectors * factor[..., None, :]) @ vectors.mT,
            vectors,
            torch.where(apart, steps / torch.where(apart, gap, 1), mean),
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor, Tensor]) -> None:
        _, vectors, divided = output
        ctx.mark_non_differentiable(vectors, divided)
        ctx.save_for_backward(vectors, divided)
        ctx.save_for_forward(vectors, divided)

    @staticmethod
    def _differential(ctx: Any, change: Tensor) -> Tensor:
        vectors, divided = ctx.saved_tensors
        change = (change + change.mT) / 2
        return vectors @ (divided * (vectors.mT @ change @ vectors)) @ vectors.mT

    @staticmethod
    @torch.autograd.function.once_differentiable
    @full_precision
    def backward(ctx: Any, change: Tensor, *_: Tensor) -> tuple[Tensor, None]:
        return _Shrinkage._differential(ctx, change), None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _: Tensor) -> tuple[Tensor, None, None]:
        return _Shrinkage._differential(ctx, change), None, None
