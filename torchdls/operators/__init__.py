"""Linear maps with their exact adjoints: gradients, patches, cosine transforms."""

from torchdls.operators.cosine import dct2, idct2, neumann_eigenvalues
from torchdls.operators.gradient import GradientOperator, as_pixel_size, edge_slopes, slope_divergence
from torchdls.operators.patches import Patches
from torchdls.operators.sine import dirichlet_eigenvalues, dst2

__all__ = [
    "GradientOperator",
    "Patches",
    "as_pixel_size",
    "dct2",
    "dirichlet_eigenvalues",
    "dst2",
    "edge_slopes",
    "idct2",
    "neumann_eigenvalues",
    "slope_divergence",
]
