"""SlopeDLS: patches of the slopes, coded at several scales."""

from torchdls.integrators.slope_dls.integrator import SlopeDLS, SlopeDLSResult
from torchdls.integrators.slope_dls.waves import shrink_slow_waves

__all__ = ["SlopeDLS", "SlopeDLSResult", "shrink_slow_waves"]
