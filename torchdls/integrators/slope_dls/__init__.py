"""SlopeDLS: patches of the slopes, coded at several scales."""

from torchdls.integrators.slope_dls.integrator import SlopeDLS, SlopeDLSResult

__all__ = ["SlopeDLS", "SlopeDLSResult"]
