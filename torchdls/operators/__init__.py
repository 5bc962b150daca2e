"""Linear maps with their exact adjoints: gradients, patches, cosine transforms."""

from torchdls.operators.cosine import dct2, idct2, neumann_eigenvalues
from torchdls.operators.edges import edge_ends, edge_slopes, extend_edges, present_edges, slope_divergence
from torchdls.operators.gradient import GradientOperator, as_pixel_size
from torchdls.operators.patches import Patches
from torchdls.operators.sine import dirichlet_eigenvalues, dst2

__all__ = [
    "GradientOperator",
    "Patches",
    "as_pixel_size",
    "dct2",
    "dirichlet_eigenvalues",
    "dst2",
    "edge_ends",
    "edge_slopes",
    "extend_edges",
    "idct2",
    "neumann_eigenvalues",
    "present_edges",
    "slope_divergence",
]
