"""Classic integrators: one solve or one transform each."""

from torchdls.integrators.classic.alpha_surface import AlphaSurface
from torchdls.integrators.classic.b_spline import BSpline
from torchdls.integrators.classic.fourier import FrankotChellappa
from torchdls.integrators.classic.gaussian_kernels import GaussianKernels
from torchdls.integrators.classic.global_least_squares import (
    HarkerOLeary,
    SpectralRegularization,
    TikhonovRegularization,
)
from torchdls.integrators.classic.horn_brooks import HornBrooks
from torchdls.integrators.classic.least_squares import LeastSquares
from torchdls.integrators.classic.line_integral import LineIntegral
from torchdls.integrators.classic.partial_integrability import PartialIntegrability
from torchdls.integrators.classic.scattered import integrate_scattered
from torchdls.integrators.classic.shapelets import Shapelets
from torchdls.integrators.classic.spectral_path import SpectralPath
from torchdls.integrators.classic.weighted_global import WeightedHarkerOLeary

__all__ = [
    "AlphaSurface",
    "BSpline",
    "FrankotChellappa",
    "GaussianKernels",
    "HarkerOLeary",
    "HornBrooks",
    "LeastSquares",
    "LineIntegral",
    "PartialIntegrability",
    "Shapelets",
    "SpectralPath",
    "SpectralRegularization",
    "TikhonovRegularization",
    "WeightedHarkerOLeary",
    "integrate_scattered",
]
