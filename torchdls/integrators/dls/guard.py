"""DLS that does no harm: how far a height is followed away from least squares, told from the noise that it removed.

What a method takes away from the least-squares height should be noise: of the right amount in every mode, and a good
part of it. With D = z - z_ls, C = dct2(D), 0 outside the mask, and S the variance of the modes of the least-squares
height for noise of standard deviation 1,

    r_p(z) = sum |C|^2 S^-p / (sigma^2 sum S^(1-p))     the share of the noise that was removed; p = 0 counts the error
                                                        of the height, p = 1 every mode alike

With z' the height after bands of modes have given back what exceeds their noise, and q the share of the patches'
coefficients that are kept, four figures tell:

    r_1/4(z')                 near 0 it found hardly any of the noise, as on texture
    r_3/4(z') / r_1/4(z')     large where fine modes went and slow ones stayed: detail rather than noise
    r_1/4(z) / r_1/4(z')      large where bands had to give back much: what they keep was taken as blindly
    q                         large where patches are not sparse, as where there is hardly any noise: what they lose is
                              as much detail as noise

S is known exactly on full rectangles with equal weights and no anchors (`torchdls.noise.height_noise`); elsewhere least
squares integrates samples of the noise, and their energies say by how much S differs from it in every band of modes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._tracing import is_concrete
from torchdls.integrators.fields import Fields, has_even_trust
from torchdls.noise import averaging_error, height_noise
from torchdls.operators import edge_slopes
from torchdls.operators.edges import mean_trust, wrapped_edge_slopes
from torchdls.operators.modes import from_modes, to_modes
from torchdls.selection import band_means, within_noise
from torchdls.solvers import solve
from torchdls.solvers.periodic import solve_periodic

# On sixteen surfaces of 96 and 200 pixels a side, from 1 to 60 dB; checked on other draws and sizes, and with masks
# and weights (benchmarks/quality/gains.py, conditions.py). A figure in which all modes count alike (p = 1) would
# mislead: of a jump, a few modes are removed many times over, the more so the larger the field, where nearly all that
# was removed is noise.
_FOUND = (0.18, 0.28)  # the first figure: from not followed to wholly
_FINE, _GIVEN_BACK, _KEPT = (1.85, 2.2), (1.15, 1.35), (8 / 64, 12 / 64)  # the others: from wholly to not at all
_SAMPLES, _TOL = 4, 1e-3  # of the noise, and of the solves that integrate them


def guard(height: Tensor, reference: Tensor, codes: Tensor, fields: Fields, noise: Tensor) -> tuple[Tensor, Tensor]:
    """The height of DLS as far as its data bear it out, surface by surface.

    Args:
        height: (N, 1, H, W), of DLS.
        reference: (N, 1, H, W), of least squares for the same fields.
        codes: (N, K, L), of patches with K coefficients each.
        fields: what all were found from.
        noise: (N,) standard deviation of one gradient sample, of mean weight; where it is NaN nothing is changed, where
            it is 0 the result is the reference.

    Returns:
        (N, 1, H, W), differentiable: z_ls + r (z' - z_ls) on full rectangles with equal weights and no anchors, else
        z_ls + r (z - z_ls), so that anchors are met; and (N,) r, from 0 to 1, which is held fixed.
    """
    sigma = torch.where(noise.isnan(), 0, noise)
    exact = has_even_trust(fields)
    variance = relative_variance(fields, exact)
    difference = to_modes(height - reference, fields.boundary)
    within = within_noise(difference, variance, sigma, boundary=fields.boundary)
    share = followed(difference.detach(), within.detach(), variance, codes.detach(), sigma.detach())
    share = torch.where(noise.isnan(), 1, share)
    given_back = reference + from_modes(within, fields.boundary)
    target = torch.where(exact & ~noise.isnan()[:, None, None, None], given_back, height)
    return reference + share[:, None, None, None] * (target - reference), share


def followed(difference: Tensor, within: Tensor, variance: Tensor, codes: Tensor, noise: Tensor) -> Tensor:
    """(N,) how far to follow a difference, from the figures above.

    Args:
        difference: (N, 1, H, W) cosine modes of z - z_ls.
        within: (N, 1, H, W) those of z' - z_ls.
        variance: (N, 1, H, W), or what broadcasts to it, S.
        codes: (N, K, L).
        noise: (N,).
    """
    some = variance > 0
    S = torch.where(some, variance, 1)

    def removed(modes: Tensor, p: float) -> Tensor:
        weight = torch.where(some, S.pow(-p), 0)
        energy = (weight * modes.square()).sum((-3, -2, -1))
        return _over(energy, noise.square() * (weight * S).sum((-3, -2, -1) if S.ndim == 4 else None))

    kept = codes != 0
    live = kept.any(1).sum(1).clamp(min=1)
    found = removed(within, 0.25)
    share = _ramp(found, *_FOUND) * (1 - _ramp(_over(removed(within, 0.75), found), *_FINE))
    share = share * (1 - _ramp(_over(removed(difference, 0.25), found), *_GIVEN_BACK))
    return share * (1 - _ramp(kept.sum((1, 2)) / (live * codes.shape[1]), *_KEPT))


@torch.no_grad()
def relative_variance(fields: Fields, exact: Tensor) -> Tensor:
    """S: the variance of every cosine mode of the least-squares height, for noise of standard deviation 1.

    Args:
        fields: of an integrator.
        exact: (N, 1, 1, 1) bool, surfaces on full rectangles with equal weights and no anchors.

    Returns:
        (H, W), or (N, 1, H, W) where it is not exact for all.
    """
    like = fields.gradient
    S = height_noise((like.shape[-2], like.shape[-1]), like, fields.steps, fields.boundary)
    if is_concrete(exact) and bool(exact.all()):
        return S
    energy = sum(to_modes(z, fields.boundary).square() for z in _noise_heights(fields)) / _SAMPLES
    ratio = band_means(energy / torch.where(S > 0, S, 1), fields.boundary)
    return torch.where(exact, S, S * ratio)


def _noise_heights(fields: Fields) -> list[Tensor]:
    """Least-squares heights of samples of the noise, the same for every surface; anchors are met without it."""
    gradient, mask, weight, anchor, r, steps, on_edges, boundary = fields
    error = scale = None
    if weight is not None:
        error = None if on_edges else averaging_error(gradient, mask, weight, steps)
        some = weight > 0
        scale = torch.where(some, (mean_trust(weight) / torch.where(some, weight, 1)).sqrt(), 0)
    rest = None if anchor is None else torch.zeros_like(anchor)
    generator = torch.Generator(device="cpu").manual_seed(0)
    heights = []
    for _ in range(_SAMPLES):
        n = torch.randn(gradient.shape[1:], generator=generator, dtype=torch.float64, device="cpu")
        n = n.to(gradient).expand_as(gradient)
        if boundary == "periodic":
            heights.append(solve_periodic(wrapped_edge_slopes(n), rest, r, steps))
            continue
        n = n if scale is None else n * scale
        n = n if mask is None or on_edges else torch.where(mask, n, 0)
        v, w = (n, weight) if on_edges else edge_slopes(n, mask, weight, error=error)
        heights.append(solve(v, w, rest, r, tol=_TOL, pixel_size=steps).height)
    return heights


def _over(energy: Tensor, expected: Tensor) -> Tensor:
    """Their ratio; infinite without noise, so that least squares remains."""
    some = (expected > 0) & expected.isfinite()
    return torch.where(some, energy / torch.where(some, expected, 1), torch.inf)


def _ramp(x: Tensor, low: float, high: float) -> Tensor:
    """0 up to `low`, 1 from `high` on, linear between."""
    return ((x - low) / (high - low)).clamp(0, 1)
