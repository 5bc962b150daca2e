"""From gradients to heights: every integrator is an outer loop around the solve (*)."""

from torchdls.integrators.base import Fields, Integrator
from torchdls.integrators.dls import DLS, DLSResult, dls_objective
from torchdls.integrators.least_squares import LeastSquares

INTEGRATORS: dict[str, type[Integrator]] = {
    "least_squares": LeastSquares,
    "dls": DLS,
}

__all__ = ["DLS", "INTEGRATORS", "DLSResult", "Fields", "Integrator", "LeastSquares", "dls_objective"]
