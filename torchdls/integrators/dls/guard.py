r"""DLS that does no harm: how far a height is followed away from least squares, told from the noise that it removed.

What a method takes away from the least-squares height should be noise: of the right amount in every mode, and a good
part of it. With D = z - z_ls, where the noise of the least-squares height is known exactly (full rectangles, equal
weights, no anchors; C = dct2(D), S as in `torchdls.noise.height_noise`):

    r_p(z) = sum |C|^2 S^-p / (sigma^2 sum S^(1-p))     the share of the noise that was removed; p = 0 counts the error
                                                        of the height, p = 1 every mode alike

With z' the height after bands of modes have given back what exceeds their noise, three figures tell:

    r_1/4(z')                 near 0 it found hardly any of the noise, as on texture
    r_3/4(z') / r_1/4(z')     large where fine modes went and slow ones stayed: detail rather than noise
    r_1/4(z) / r_1/4(z')      large where bands had to give back much: what they keep was taken as blindly
    r_1(z)                    above 1 it took more than there was

Elsewhere the energy of the slopes on the edges is all that is known without the shape of the noise:

    e   = sum_e w_e (A D)_e^2 / (sigma^2 n f),   n pixels, f = mean L S the share of the noise that slopes A z carry
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchdls._tracing import is_concrete
from torchdls.integrators.data_term import edges_of
from torchdls.integrators.fields import Fields, has_even_trust
from torchdls.noise import height_noise
from torchdls.operators import GradientOperator, dct2
from torchdls.operators.cosine import neumann_eigenvalues
from torchdls.operators.edges import mean_trust
from torchdls.selection import discrepancy_guard

# On sixteen surfaces of 96, 200 and 320 pixels a side, from 1 to 30 dB; checked on other draws and sizes
# (benchmarks/quality/gains.py). A figure in which all modes count alike (p = 1) would mislead: of a jump, a few modes
# are removed many times over, the more so the larger the field, where nearly all that was removed is noise.
_FOUND = (0.18, 0.28)  # the first figure: from not followed to wholly
_FINE, _GIVEN_BACK = (1.85, 2.2), (1.15, 1.35)  # the others: from wholly followed to not at all
_SLOPES = (0.45, 0.55, 0.7, 0.85)  # e: from not at all to wholly, and back


def guard(height: Tensor, reference: Tensor, fields: Fields, noise: Tensor) -> tuple[Tensor, Tensor]:
    """The height of DLS as far as its data bear it out, surface by surface.

    Args:
        height: (N, 1, H, W), of DLS.
        reference: (N, 1, H, W), of least squares for the same fields.
        fields: what both were found from.
        noise: (N,) standard deviation of one gradient sample, of mean weight; where it is NaN nothing is changed, where
            it is 0 the result is the reference.

    Returns:
        (N, 1, H, W), differentiable, and (N,) how far each surface is followed, from 0 to 1, which is held fixed.
    """
    sigma = torch.where(noise.isnan(), 0, noise)
    exact = has_even_trust(fields)
    known = is_concrete(exact)
    if known and bool(exact.all()):
        safe = guard_by_modes(height, reference, sigma, fields.steps)
    elif known and not bool(exact.any()):
        safe = guard_by_slopes(height, reference, sigma, fields)
    else:
        modes = guard_by_modes(height, reference, sigma, fields.steps)
        slopes = guard_by_slopes(height, reference, sigma, fields)
        safe = torch.where(exact, modes[0], slopes[0]), torch.where(exact.flatten(), modes[1], slopes[1])
    z, share = safe
    return torch.where(noise.isnan()[:, None, None, None], height, z), torch.where(noise.isnan(), 1, share)


def guard_by_modes(
    height: Tensor, reference: Tensor, noise: Tensor, pixel_size: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """On full rectangles with equal trust: bands of modes give back what exceeds the noise, then the figures decide.

    Args:
        height: (N, 1, H, W).
        reference: (N, 1, H, W), the least-squares height.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).

    Returns:
        (N, 1, H, W): z_ls + r (z' - z_ls), z' the height after `discrepancy_guard` with allowance 0, and r (N,).
    """
    shape = (height.shape[-2], height.shape[-1])
    within = discrepancy_guard(height, reference, noise, pixel_size, allowance=0.0)
    variance = height_noise(shape, height, pixel_size)
    some = variance > 0
    variance = torch.where(some, variance, 1)
    power = noise.detach().square()

    def removed(z: Tensor, norm: float) -> Tensor:
        weight = torch.where(some, variance.pow(-norm), 0)
        energy = (weight * dct2((z - reference).detach()).square()).sum((-3, -2, -1))
        return _over(energy, power * (weight * variance).sum())

    found = removed(within, 0.25)
    share = _ramp(found, *_FOUND) * (1 - _ramp(_over(removed(within, 0.75), found), *_FINE))
    share = share * (1 - _ramp(_over(removed(height, 0.25), found), *_GIVEN_BACK))
    return reference + share[:, None, None, None] * (within - reference), share


def guard_by_slopes(height: Tensor, reference: Tensor, noise: Tensor, fields: Fields) -> tuple[Tensor, Tensor]:
    """With masks, weights or anchors: the energy of the slopes that were taken away decides alone.

    Args:
        height: (N, 1, H, W).
        reference: (N, 1, H, W), the least-squares height.
        noise: (N,) standard deviation of one gradient sample of mean weight.
        fields: what both were found from.

    Returns:
        (N, 1, H, W): z_ls + r (z - z_ls), and r (N,).
    """
    shape = (height.shape[-2], height.shape[-1])
    slopes = GradientOperator("forward", fields.steps)((height - reference).detach()).square()
    _, w = edges_of(fields)
    if w is not None:
        unit = 1 if fields.weight is None else mean_trust(fields.weight)
        slopes = slopes * (w / unit).detach()
    inside = torch.ones_like(height) if fields.mask is None else fields.mask.to(height).expand_as(height)
    variance = height_noise(shape, height, fields.steps)
    carried = (neumann_eigenvalues(shape, height, fields.steps) * variance).mean()
    expected = noise.detach().square() * carried * inside.sum((-3, -2, -1))
    found = _over(slopes.sum((-3, -2, -1)), expected)
    share = _ramp(found, *_SLOPES[:2]) * (1 - _ramp(found, *_SLOPES[2:]))
    return reference + share[:, None, None, None] * (height - reference), share


def _over(energy: Tensor, expected: Tensor) -> Tensor:
    """Their ratio; infinite without noise, so that least squares remains."""
    some = (expected > 0) & expected.isfinite()
    return torch.where(some, energy / torch.where(some, expected, 1), torch.inf)


def _ramp(x: Tensor, low: float, high: float) -> Tensor:
    """0 up to `low`, 1 from `high` on, linear between."""
    return ((x - low) / (high - low)).clamp(0, 1)
