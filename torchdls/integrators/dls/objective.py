"""The cost of DLS, for any height, dictionary and codes."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._checks import check_fit, check_together
from torchdls._precision import full_precision
from torchdls.integrators.classic.least_squares import LeastSquares
from torchdls.integrators.data_term import Quadratic
from torchdls.integrators.dls.problem import patch_cost
from torchdls.operators import Patches


@full_precision
def dls_objective(
    height: Tensor,
    gradient: Tensor,
    dictionary: Tensor,
    codes: Tensor,
    lam: float | Tensor,
    mu: float | Tensor,
    *,
    patches: Patches | None = None,
    mask: Tensor | None = None,
    weight: Tensor | None = None,
) -> Tensor:
    r"""The cost that DLS minimises, per surface.

        1/2 \sum_e w_e ((A z)_e - v_e)^2 + lam ( \sum_j ||M_j (P_j z - D b_j)||^2 + mu^2 ||B||_0 )

    with M_j the valid pixels of patch j (all of them without a mask).

    Args:
        height: (N, 1, H, W), in pixels.
        gradient: (N, 2, H, W).
        dictionary: (N or 1, n, K).
        codes: (N, K, L).
        lam: a number or (N,).
        mu: a number or (N,).
        patches: the patches; `Patches(8, 2)` by default. Where they wrap, the surface repeats.
        mask: (N, 1, H, W) bool.
        weight: (N, 1 or 2, H, W).

    Returns:
        (N,).

    Raises:
        ValueError: shapes do not fit.
        TypeError: they are not tensors of one dtype, float32 or float64.

    Example:
        >>> height, gradient = torch.zeros(1, 1, 16, 16), torch.zeros(1, 2, 16, 16)
        >>> patches = torchdls.Patches(8, 8)
        >>> codes = torch.ones(1, 64, 4)  # 256 codes that nothing asks for
        >>> torchdls.dls_objective(height, gradient, torch.eye(64)[None], codes, lam=0.5, mu=0.0, patches=patches)
        tensor([128.])
    """
    patches = Patches() if patches is None else patches
    check_together("dls_objective", gradient=gradient, height=height, dictionary=dictionary, codes=codes)
    fields = LeastSquares(boundary="periodic" if patches.wrap else "neumann")._check_fields(gradient, mask, weight)
    check_fit("dls_objective", "height", height, fields.gradient, "gradient", channels=(1,))
    if codes.ndim != 3 or dictionary.ndim != 3:
        shapes = f"dictionary {tuple(dictionary.shape)} and codes {tuple(codes.shape)}"
        raise ValueError(f"dls_objective: {shapes} given, (N or 1, n, K) and (N, K, L) are needed")
    valid = None if fields.mask is None else patches.extract(fields.mask.to(height.dtype)) > 0
    mu = torch.as_tensor(mu, dtype=height.dtype, device=height.device).expand(height.shape[0])
    cut = patches.extract(height)
    K = codes.shape[1]
    if codes.shape != (len(cut), K, cut.shape[-1]) or dictionary.shape not in {
        (n, cut.shape[1], K) for n in (1, len(cut))
    }:
        shapes = f"dictionary {tuple(dictionary.shape)}, codes {tuple(codes.shape)} and patches {tuple(cut.shape)}"
        raise ValueError(f"dls_objective: {shapes} do not fit; (N or 1, n, K), (N, K, L) and (N, n, L) are needed")
    R = cut - dictionary @ codes
    return Quadratic.of(fields).cost(height) + lam * patch_cost(R, codes, mu, valid)
