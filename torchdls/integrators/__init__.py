"""From gradients to heights: every integrator is an outer loop around the solve (*)."""

from torchdls._registry import INTEGRATORS
from torchdls.integrators.base import Fields, IntegrationResult, Integrator
from torchdls.integrators.classic import (
    AlphaSurface,
    BSpline,
    FrankotChellappa,
    HarkerOLeary,
    HornBrooks,
    LeastSquares,
    LineIntegral,
    PartialIntegrability,
    Shapelets,
    SpectralPath,
    SpectralRegularization,
    TikhonovRegularization,
    integrate_scattered,
)
from torchdls.integrators.dls import DLS, DLSResult, Exact, Implicit, Proximal, Unroll, dls_objective
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
from torchdls.integrators.slope_dls import SlopeDLS, SlopeDLSResult, shrink_slow_waves

__all__ = [
    "DLS",
    "INTEGRATORS",
    "L1",
    "AlphaSurface",
    "AnisotropicDiffusion",
    "BSpline",
    "Bilateral",
    "DLSResult",
    "Exact",
    "Fields",
    "FrankotChellappa",
    "HarkerOLeary",
    "HornBrooks",
    "Huber",
    "Implicit",
    "IntegrationResult",
    "Integrator",
    "LeastSquares",
    "LineIntegral",
    "MEstimator",
    "MumfordShah",
    "PartialIntegrability",
    "Piecewise",
    "PiecewiseResult",
    "Proximal",
    "RobustResult",
    "Shapelets",
    "SlopeDLS",
    "SlopeDLSResult",
    "SpectralPath",
    "SpectralRegularization",
    "TikhonovRegularization",
    "TotalVariation",
    "Unroll",
    "WeightedLeastSquares",
    "dls_objective",
    "integrate_scattered",
    "shrink_slow_waves",
]
