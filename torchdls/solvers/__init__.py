"""The linear solve (*) that every integrator is built around."""

from torchdls.solvers.cg import conjugate_gradients
from torchdls.solvers.components import connected_components, remove_free_constants
from torchdls.solvers.direct import integrate_direct, solve_direct
from torchdls.solvers.extension import harmonic_extension
from torchdls.solvers.poisson import ConvergenceWarning, SolveResult, direct_result, solve

__all__ = [
    "ConvergenceWarning",
    "SolveResult",
    "conjugate_gradients",
    "connected_components",
    "direct_result",
    "harmonic_extension",
    "integrate_direct",
    "remove_free_constants",
    "solve",
    "solve_direct",
]
