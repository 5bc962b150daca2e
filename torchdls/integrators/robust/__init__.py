"""Robust integrators: what a few wrong slopes or a jump of the surface do not spoil."""

from torchdls.integrators.robust.anisotropic_diffusion import AnisotropicDiffusion
from torchdls.integrators.robust.base import Robust, RobustResult
from torchdls.integrators.robust.bilateral import Bilateral
from torchdls.integrators.robust.convex import L1, Huber, TotalVariation
from torchdls.integrators.robust.edge_preserving import EdgePreserving
from torchdls.integrators.robust.m_estimator import MEstimator
from torchdls.integrators.robust.mumford_shah import MumfordShah
from torchdls.integrators.robust.weighted import WeightedLeastSquares

__all__ = [
    "L1",
    "AnisotropicDiffusion",
    "Bilateral",
    "EdgePreserving",
    "Huber",
    "MEstimator",
    "MumfordShah",
    "Robust",
    "RobustResult",
    "TotalVariation",
    "WeightedLeastSquares",
]
