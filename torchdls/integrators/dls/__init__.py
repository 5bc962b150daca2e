"""DLS: integration regularised by a dictionary that is learned from the surface itself."""

from torchdls.integrators.dls.integrator import DLS, DLSResult
from torchdls.integrators.dls.objective import dls_objective
from torchdls.integrators.dls.options import Exact, Implicit, Proximal, Unroll

__all__ = ["DLS", "DLSResult", "Exact", "Implicit", "Proximal", "Unroll", "dls_objective"]
