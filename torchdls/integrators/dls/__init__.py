"""DLS: integration regularised by a dictionary that is learned from the surface itself."""

from torchdls.integrators.dls.integrator import DLS, DLSResult
from torchdls.integrators.dls.objective import dls_objective

__all__ = ["DLS", "DLSResult", "dls_objective"]
