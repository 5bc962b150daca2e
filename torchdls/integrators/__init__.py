"""From gradients to heights: every integrator is an outer loop around the solve (*)."""

from torchdls._registry import INTEGRATORS
from torchdls.integrators.base import Fields, Integrator
from torchdls.integrators.dls import DLS, DLSResult, dls_objective
from torchdls.integrators.least_squares import LeastSquares
from torchdls.integrators.sylvester import HarkerOLeary, SpectralRegularization, TikhonovRegularization

__all__ = [
    "DLS",
    "DLSResult",
    "Fields",
    "HarkerOLeary",
    "INTEGRATORS",
    "Integrator",
    "LeastSquares",
    "SpectralRegularization",
    "TikhonovRegularization",
    "dls_objective",
]
