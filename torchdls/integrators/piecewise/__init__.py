"""Piecewise integration: jumps from evidence in the normals."""

from torchdls.integrators.piecewise.integrator import Piecewise, PiecewiseResult

__all__ = ["Piecewise", "PiecewiseResult"]
