"""Choices by predicted risk: how far to follow an estimate, and which of several, without knowing the surface.

All of it rests on one fact: the cosine coefficients of the least-squares height on a rectangle are the true ones plus
independent normal errors of known variance (`torchdls.noise.height_noise`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_alike, check_field, check_whole, require
from torchdls._precision import full_precision
from torchdls.noise import height_noise, noise_level
from torchdls.operators import as_pixel_size, dct2, edge_slopes, idct2
from torchdls.operators.modes import Boundary, from_modes, half_periods, to_modes
from torchdls.operators.tables import table
from torchdls.solvers import solve

_RATIO = 1.5  # of the frequencies that bound a band
_SECTORS = 4  # directions into which a band is divided
_FEW = 8  # bands below this frequency (in half periods per side) are whole rings
_FINE = 3.0  # modes whose Laplacian eigenvalue exceeds this (of 8) are left alone: averaged slopes hardly see them


def discrepancy_guard(
    height: Tensor,
    reference: Tensor,
    noise: Tensor,
    pixel_size: tuple[float, float] = (1.0, 1.0),
    *,
    allowance: float = 1.0,
    boundary: Boundary = "neumann",
) -> Tensor:
    r"""Give back to a smoothed height what was taken from it beyond the noise, band by band.

        z + (1 - a_b) (z_ls - z)   in band b,   a_b = min(1, N_b / R_b)
        R_b = sum of |C_kl|^2 / S_kl over the band, C = dct2(z - z_ls);   N_b = sigma^2 (n_b + a sqrt(2 n_b))

    R_b is the energy that was removed, in units of the noise that least squares leaves in each of the n_b
    coefficients; N_b is the most that the noise itself can account for, with an `allowance` of a standard deviations.
    Where R_b exceeds it the difference is part surface, and a_b = N_b / R_b is then the best factor, in the sense of
    mean squares. Bands are rings of frequencies, divided into sectors of directions.

    Args:
        height: (N, 1, H, W) on a full rectangle.
        reference: (N, 1, H, W), the least-squares height of the same data, with equal trust in all slopes.
        noise: (N,) standard deviation of one gradient sample.
        pixel_size: (dx, dy).
        allowance: a.
        boundary: "neumann" or "periodic".

    Returns:
        (N, 1, H, W).
    """
    shape = (height.shape[-2], height.shape[-1])
    variance = height_noise(shape, height, pixel_size, boundary)
    difference = to_modes(height - reference, boundary)
    return reference + from_modes(within_noise(difference, variance, noise, allowance, boundary), boundary)


def within_noise(
    difference: Tensor, variance: Tensor, noise: Tensor, allowance: float = 0.0, boundary: Boundary = "neumann"
) -> Tensor:
    """The modes of a difference, every band of them scaled down to the energy that noise explains.

    Args:
        difference: (N, 1, H, W) modes.
        variance: (N, 1, H, W), or what broadcasts to it, of each mode for noise of standard deviation 1.
        noise: (N,) standard deviation.
        allowance: a in `discrepancy_guard`.
        boundary: "neumann" or "periodic".

    Returns:
        (N, 1, H, W) modes.
    """
    shape = (difference.shape[-2], difference.shape[-1])
    band = _bands(*shape, boundary, like=difference).long().flatten()
    n_bands = _most_bands(*shape)
    weight = torch.where(band.view(shape) > 0, 1 / torch.where(variance > 0, variance, 1), 0)
    removed = _band_sums((difference.square() * weight).flatten(1), band, n_bands)
    count = _band_sums(difference.new_ones(1, band.numel()), band, n_bands)[0]
    allowed = noise[:, None].square() * (count + allowance * (2 * count).sqrt())
    beyond = removed > allowed
    beyond[:, 0] = False
    share = torch.where(beyond, allowed / torch.where(beyond, removed, 1), 1)
    return difference * share[:, band].view_as(difference)


def band_means(energy: Tensor, boundary: Boundary = "neumann") -> Tensor:
    """(N, 1, H, W) means of the modes' energies over the bands of `discrepancy_guard`, at every mode of the band."""
    shape = (energy.shape[-2], energy.shape[-1])
    band = _bands(*shape, boundary, like=energy).long().flatten()
    n_bands = _most_bands(*shape)
    count = _band_sums(energy.new_ones(1, band.numel()), band, n_bands).clamp(min=1)
    return (_band_sums(energy.flatten(1), band, n_bands) / count)[:, band].view_as(energy)


def _band_sums(energy: Tensor, band: Tensor, n_bands: int) -> Tensor:
    """(N, n_bands) sums of (N, H W) over the bands."""
    return energy.new_zeros(energy.shape[0], n_bands).index_add(1, band, energy)


def _most_bands(h: int, w: int) -> int:
    """A bound of the number of bands: every mode has a radius below sqrt(2 h w)."""
    return (2 + math.floor(math.log(max(1.0, math.sqrt(2 * h * w))) / math.log(_RATIO))) * _SECTORS


@table
def _bands(h: int, w: int, boundary: Boundary) -> Tensor:
    """(H, W) number of the band of each mode; 0 for those that are left alone."""
    y, x = (half_periods(n, boundary) for n in (h, w))
    radius = (y[:, None].square() * (w / h) + x.square() * (h / w)).sqrt()
    ring = 1 + (radius.clamp(min=1).log() / math.log(_RATIO)).floor()
    sector = (torch.atan2(y[:, None] * w, x * h) * (2 * _SECTORS / math.pi)).floor().clamp(max=_SECTORS - 1)
    band = ring * _SECTORS + torch.where(radius >= _FEW, sector, 0)
    eigenvalue = 4 * ((y * (math.pi / (2 * h))).sin().square()[:, None] + (x * (math.pi / (2 * w))).sin().square())
    return torch.where((radius > 0) & (eigenvalue <= _FINE), band, 0)


def probe(gradient: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Random signs (N, 2, H, W), the same for every surface, and a step (N, 1, 1, 1) small against the noise.

    The signs come from a generator of their own with a fixed seed, so that a choice made with them is deterministic.
    """
    generator = torch.Generator(device="cpu").manual_seed(0)
    signs = torch.randint(0, 2, gradient.shape[1:], generator=generator, device="cpu") * 2 - 1
    step = 0.1 * noise.detach()[:, None, None, None]
    return signs.to(gradient).expand_as(gradient), torch.where(step > 0, step, 1)


def sure_guard(height: Tensor, reference: Tensor, change: Tensor, moved: Tensor, noise: Tensor) -> Tensor:
    r"""Blend a height with the least-squares one in every band, by Stein's unbiased risk estimate.

        z_ls + a_b (z - z_ls) in band b,   a_b = -sigma^2 div_b / ||z - z_ls||_b^2, clipped to [0, 1]
        div_b = <A^+ n, change - A^+ n>_b

    minimises the unbiased estimate of the squared error in the band. div_b is the divergence of z - z_ls with respect
    to the noise of z_ls, by one probe n.

    Args:
        height: (N, 1, H, W), z, on a full rectangle.
        reference: (N, 1, H, W), the least-squares height.
        change: (N, 1, H, W), the derivative of z along the probe n of the gradient.
        moved: (N, 1, H, W), that of the least-squares height: A^+ n.
        noise: (N,) standard deviation of one gradient sample.

    Returns:
        (N, 1, H, W).

    Source: Stein (1981); Ramani, Blu, Unser, "Monte-Carlo SURE", IEEE TIP 17(9), 2008.
    """
    shape = (height.shape[-2], height.shape[-1])
    band = _bands(*shape, "neumann", like=height).long().flatten()
    n_bands = _most_bands(*shape)
    difference, along, push = (dct2(x) for x in (height - reference, change - moved, moved))
    energy = _band_sums(difference.square().flatten(1), band, n_bands)
    divergence = _band_sums((along * push).flatten(1), band, n_bands)
    some = energy > 0
    share = (-noise[:, None].square() * divergence / torch.where(some, energy, 1)).clamp(0, 1)
    share = torch.where(some, share, 1).index_fill(1, torch.zeros(1, dtype=torch.int64, device=band.device), 1.0)
    return reference + idct2(difference * share[:, band].view_as(height))


class Selection(NamedTuple):
    """What `select` chose.

    Attributes:
        height: (N, 1, H, W), in the unit of the pixel size.
        choice: (N,) number of the candidate, -1 for least squares.
        risk: (M, N) predicted squared error over that of least squares, both in the chosen norm; below 1 is better.

    Example:
        >>> methods = torchdls.HarkerOLeary(), torchdls.SpectralRegularization(0.25)
        >>> noise = 0.5 * torch.randn(1, 2, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> chosen = torchdls.select(lambda g: torch.cat([f(x[None]) for f, x in zip(methods, g)]), noise, candidates=2)
        >>> int(chosen.choice), chosen.height.shape, chosen.risk.shape
        (1, torch.Size([1, 1, 32, 32]), torch.Size([2, 1]))
    """

    height: Tensor
    choice: Tensor
    risk: Tensor


@full_precision
def select(
    integrate: Callable[[Tensor], Tensor],
    gradient: Tensor,
    candidates: int,
    *,
    noise: Tensor | None = None,
    criterion: Literal["sure", "r2r"] = "sure",
    norm: float = 0.5,
    least_cut: float = 0.2,
    pixel_size: float | tuple[float, float] = 1.0,
) -> Selection:
    r"""Choose among candidates by their predicted risk, without the truth; least squares unless it is clearly beaten.

        "sure":  risk = ||z - z_ls||^2 - N + 2 sigma^2 div,    div = <A^+ n, dz/dn>
        "r2r":   risk = ||z(g + n'/2) - z_ls(g - 2 n')||^2 - 5 N,   n' fresh noise of the level of the data

    in the norm sum_kl S_kl^(-norm) |C_kl|^2 over the cosine coefficients of the heights, with S the variance that
    white noise leaves in them and N = sigma^2 sum S^(1 - norm) the risk of least squares. norm = 0 is the error of the
    height, which a few low frequencies decide; norm = 1 weighs all coefficients by their own noise, much as slopes do.

    Both are unbiased for normal noise (R2R: for data with a quarter more variance), and both scatter: a candidate
    is taken only if it cuts the risk of least squares by more than `least_cut`.

    Args:
        integrate: (M N, 2, H, W) -> (M N, 1, H, W), candidate after candidate, each for all N surfaces; for instance
            `lambda g: DLS(mu=factors.repeat_interleave(n) * sigma.repeat(m))(g)`. Called twice, or once for "r2r"
            and once more for the result.
        gradient: (N, 2, H, W), full rectangles with equal trust.
        candidates: M.
        noise: (N,) standard deviation of one gradient sample, None for `noise_level`.
        criterion: "sure" or "r2r".
        norm: 0, 1/2, 1 or any number between.
        least_cut: the predicted cut of the risk of least squares from which a candidate is taken.
        pixel_size: of the integrator.

    Returns:
        Selection(height, choice, risk). The random numbers have a fixed seed: two calls choose alike.

    Raises:
        TypeError: the gradient is not float32 or float64, or the noise of another dtype.
        ValueError: the criterion is unknown, or an argument does not fit.

    Source: Stein (1981); Ramani, Blu, Unser (2008); Pang et al., "Recorrupted-to-Recorrupted", CVPR 2021.

    Example:
        >>> surface = torchdls.SURFACES["peaks"](32)
        >>> noisy = surface.gradient + 0.5 * torch.randn(1, 2, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> def integrate(g):  # all of the surfaces by the first candidate, then all by the second
        ...     return torch.cat([torchdls.LineIntegral()(g[:1]), torchdls.SpectralRegularization(0.25)(g[1:])])
        >>> int(torchdls.select(integrate, noisy, candidates=2).choice)
        1
    """
    if criterion not in ("sure", "r2r"):
        raise ValueError(f"select: criterion={criterion!r} is unknown; choose from 'sure', 'r2r'")
    check_field("select", "gradient", gradient, 2)
    if noise is not None:
        check_alike("select", "noise", noise, gradient.dtype)
        require(noise.shape == gradient.shape[:1], f"select: noise {tuple(noise.shape)} given, (N,) is needed")
    check_whole("select", candidates=candidates)
    if gradient.ndim != 4 or candidates < 1:
        raise ValueError(f"select: gradient {tuple(gradient.shape)} and candidates={candidates} given; "
                         "(N, 2, H, W) and at least one candidate are needed")  # fmt: skip
    steps = as_pixel_size(pixel_size)
    sigma = noise_level(gradient, pixel_size=steps) if noise is None else noise

    def run(g: Tensor) -> Tensor:
        return integrate(g.repeat(candidates, 1, 1, 1)).unflatten(0, (candidates, -1))

    def least_squares(g: Tensor) -> Tensor:
        return solve(edge_slopes(g)[0], pixel_size=steps).height

    variance = height_noise((gradient.shape[-2], gradient.shape[-1]), gradient, steps)
    weight = torch.where(variance > 0, variance.clamp(min=1e-30).pow(-norm), 0)
    power = sigma.square()
    base = power * (variance * weight).sum()

    def energy(z: Tensor, other: Tensor) -> Tensor:
        return (weight * dct2(z) * dct2(other)).sum((-3, -2, -1))

    height, plain = run(gradient), least_squares(gradient)
    if criterion == "sure":
        n, step = probe(gradient, sigma)
        change = (run(gradient + step * n) - height) / step
        difference = height - plain
        risk = energy(difference, difference) - base + 2 * power * energy(change, least_squares(n))
    else:
        generator = torch.Generator(device="cpu").manual_seed(0x5EED)  # unlike any seed that made the data
        n = torch.randn(gradient.shape[1:], generator=generator, dtype=torch.float64, device="cpu").to(gradient)
        n = n * sigma[:, None, None, None]
        difference = run(gradient + 0.5 * n) - least_squares(gradient - 2 * n)
        risk = energy(difference, difference) - 5 * base
    risk = risk / torch.where(base > 0, base, 1)
    least, best = risk.min(0)
    taken = (least < 1 - least_cut) & (base > 0)
    chosen = height[best, torch.arange(len(best), device=best.device)]
    return Selection(
        torch.where(taken[:, None, None, None], chosen, plain), torch.where(taken, best, -1), risk.detach()
    )
