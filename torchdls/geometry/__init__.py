"""Normals, gradients, conventions and cameras: what comes in from other tools, and goes back to them."""

from torchdls.geometry.cameras import depth_to_points, height_to_points, log_depth_to_depth
from torchdls.geometry.coder import CodedNormals, denoise_normals, normal_noise
from torchdls.geometry.conventions import (
    GRADIENT_CONVENTIONS,
    NORMAL_CONVENTIONS,
    convert_gradient,
    convert_normals,
)
from torchdls.geometry.noise import SlopeNoise, slope_noise
from torchdls.geometry.normals import (
    ConventionGuess,
    GradientField,
    GradientToNormals,
    NormalsToGradient,
    gradient_to_normals,
    guess_convention,
    normals_to_gradient,
)

__all__ = [
    "GRADIENT_CONVENTIONS",
    "NORMAL_CONVENTIONS",
    "CodedNormals",
    "ConventionGuess",
    "GradientField",
    "GradientToNormals",
    "NormalsToGradient",
    "SlopeNoise",
    "convert_gradient",
    "convert_normals",
    "denoise_normals",
    "depth_to_points",
    "gradient_to_normals",
    "guess_convention",
    "height_to_points",
    "log_depth_to_depth",
    "normal_noise",
    "normals_to_gradient",
    "slope_noise",
]
