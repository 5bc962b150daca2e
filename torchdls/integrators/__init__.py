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
    "SpectralPath",
    "integrate_scattered",
    "PartialIntegrability",
    "BSpline",
    "AlphaSurface",
    "Shapelets",
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
    "Exact",
    "Fields",
    "FrankotChellappa",
    "HarkerOLeary",
    "HornBrooks",
    "INTEGRATORS",
    "Implicit",
    "IntegrationResult",
    "Integrator",
    "LeastSquares",
    "LineIntegral",
    "Proximal",
    "Piecewise",
    "PiecewiseResult",
    "SlopeDLS",
    "SlopeDLSResult",
    "SpectralRegularization",
    "TikhonovRegularization",
    "Unroll",
    "dls_objective",
    "shrink_slow_waves",
]
