"""From gradients to heights: every integrator is an outer loop around the solve (*)."""

from torchdls._registry import INTEGRATORS
from torchdls.integrators.base import Fields, Integrator
from torchdls.integrators.dls import DLS, DLSResult
from torchdls.integrators.dls_objective import dls_objective
from torchdls.integrators.fourier import FrankotChellappa
from torchdls.integrators.horn_brooks import HornBrooks
from torchdls.integrators.least_squares import LeastSquares
from torchdls.integrators.line_integral import LineIntegral
from torchdls.integrators.robust import (
    L1,
    AnisotropicDiffusion,
    Huber,
    MEstimator,
    MumfordShah,
    RobustResult,
    TotalVariation,
    WeightedLeastSquares,
)
from torchdls.integrators.slope_dls import SlopeDLS, SlopeDLSResult
from torchdls.integrators.sylvester import HarkerOLeary, SpectralRegularization, TikhonovRegularization

__all__ = [
    "AnisotropicDiffusion",
    "Huber",
    "L1",
    "MEstimator",
    "MumfordShah",
    "RobustResult",
    "TotalVariation",
    "WeightedLeastSquares",
    "DLS",
    "DLSResult",
    "Fields",
    "FrankotChellappa",
    "HarkerOLeary",
    "HornBrooks",
    "INTEGRATORS",
    "Integrator",
    "LeastSquares",
    "LineIntegral",
    "SlopeDLS",
    "SlopeDLSResult",
    "SpectralRegularization",
    "TikhonovRegularization",
    "dls_objective",
]
