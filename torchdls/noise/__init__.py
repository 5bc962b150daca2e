"""Noise: its level in a gradient field, what it leaves in heights, and noise to try methods on."""

from torchdls.noise.averaging import averaging_error
from torchdls.noise.level import edge_noise_if_told, noise_if_told, noise_level
from torchdls.noise.samples import add_noise, noise_sigma
from torchdls.noise.spectrum import cosine_noise, height_noise, height_noise_part, slope_covariance

__all__ = [
    "add_noise",
    "averaging_error",
    "cosine_noise",
    "edge_noise_if_told",
    "height_noise",
    "height_noise_part",
    "noise_if_told",
    "noise_level",
    "noise_sigma",
    "slope_covariance",
]
