"""Denoising of a height map by a dictionary that is learned from it."""

from __future__ import annotations

import math

from torch import Tensor

from torchdls._checks import check_field, require
from torchdls._precision import full_precision
from torchdls.dictionary.initial import dct_dictionary
from torchdls.dictionary.learners import KSVD
from torchdls.operators import Patches


@full_precision
def denoise_height(
    height: Tensor,
    sigma: float,
    *,
    patch_size: int = 8,
    n_atoms: int | None = None,
    n_passes: int = 10,
    lam: float = 1.0,
    gain: float = 1.15,
) -> Tensor:
    r"""Take white noise out of a height map by sparse coding of its patches.

        min ||b_j||_0   with   ||P_j y - m_j - D b_j||^2 <= n (gain sigma)^2,     over B and D by K-SVD
        z = (lam y + sum_j P_j^T (D b_j + m_j)) / (lam + sum_j P_j^T P_j)

    over all overlapping patches of n pixels, with m_j their means; D starts from cosines. This is what DLS is for a
    height that was measured itself (A = I): for depth maps and range images. For slopes it is the wrong end: their
    noise, once integrated, is not white; use `SlopeDLS` or `DLS`. The time of a pass is that of coding all patches: use
    it on fields of a few hundred pixels a side. Differentiable with the supports of the codes taken as fixed.

    Args:
        height: (N, 1, H, W) or (1, H, W), at least a patch in size.
        sigma: standard deviation of the noise, in the unit of the height.
        patch_size: side of a patch.
        n_atoms: K; None for four times the pixels of a patch.
        n_passes: passes of K-SVD; 0 leaves the cosines as they are.
        lam: trust in the measured height, in numbers of patches (30 / sigma in the source, for grey levels up to 255).
        gain: factor of the target; at 1 nearly half of the patches of pure noise are coded.

    Returns:
        The denoised height, of the shape of `height`.

    Raises:
        TypeError: the height is not float32 or float64.
        ValueError: the height is smaller than a patch, or an option is out of its range.

    Source: Elad, Aharon, "Image denoising via sparse and redundant representations over learned dictionaries", IEEE
    TIP 15(12), 2006. Patches less their means are ours: heights have no origin.

    Example:
        >>> surface = torchdls.SURFACES["tent"](32)
        >>> noise = torch.randn(surface.height.shape, generator=torch.Generator().manual_seed(0))
        >>> denoised = torchdls.denoise_height(surface.height + 0.5 * noise, sigma=0.5, n_passes=2)
        >>> bool(torchdls.rmse(denoised, surface.height) < 0.25)
        True
    """
    name = "denoise_height"
    check_field(name, "height", height, 1)
    require(0 < sigma < math.inf, f"{name}: sigma={sigma!r} given, a positive number is needed")
    passes = isinstance(n_passes, int) and n_passes >= 0
    require(passes, f"{name}: n_passes={n_passes!r} given, an integer of at least 0 is needed")
    require(0 <= lam < math.inf, f"{name}: lam={lam!r} given, a number of at least 0 is needed")
    require(0 < gain < math.inf, f"{name}: gain={gain!r} given, a positive number is needed")
    y, patches = (height if height.ndim == 4 else height[None]), Patches(patch_size, 1)
    count = 4 * patches.n_pixels if n_atoms is None else n_atoms
    atoms = dct_dictionary(patch_size, count + 1, dtype=y.dtype, device=y.device)[:, 1:]  # the means are taken out
    P = patches.extract(y) / sigma
    mean = P.mean(1, keepdim=True)
    learner = KSVD(tol=patches.n_pixels * gain**2)
    R, D = P - mean, atoms.expand(len(y), -1, -1)
    B = y.new_zeros(len(y), D.shape[-1], P.shape[-1])
    for _ in range(n_passes):
        R, D, B = learner(R, D, B, 0.0)
    _, D, B = learner(R, D, B, 0.0, learn=False)
    coverage = patches.coverage(y.shape, dtype=y.dtype, device=y.device)
    z = (lam * y + patches.adjoint((D @ B + mean) * sigma, y.shape)) / (lam + coverage)
    return z if height.ndim == 4 else z[0]
