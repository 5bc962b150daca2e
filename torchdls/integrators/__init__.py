"""From gradients to heights: every integrator is an outer loop around the solve (*)."""

from torchdls._registry import INTEGRATORS
from torchdls.integrators.base import Fields, IntegrationResult, Integrator
from torchdls.integrators.classic import (
    FrankotChellappa,
    HarkerOLeary,
    HornBrooks,
    LeastSquares,
    LineIntegral,
    SpectralRegularization,
    TikhonovRegularization,
)
from torchdls.integrators.dls import DLS, DLSResult, dls_objective
from torchdls.integrators.piecewise import Piecewise, PiecewiseResult
from torchdls.integrators.robust import (
    L1,
    AnisotropicDiffusion,
    Bilateral,
    Huber,
    MEstimator,
    MumfordShah,
    RobustResult,
    TotalVariation,
    WeightedLeastSquares,
)
from torchdls.integrators.slope_dls import SlopeDLS, SlopeDLSResult

__all__ = [
    "AnisotropicDiffusion",
    "Bilateral",
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
    "IntegrationResult",
    "Integrator",
    "LeastSquares",
    "LineIntegral",
    "Piecewise",
    "PiecewiseResult",
    "SlopeDLS",
    "SlopeDLSResult",
    "SpectralRegularization",
    "TikhonovRegularization",
    "dls_objective",
]
