"""What several test files share: assertions, oracles in NumPy and SciPy, and small test fields."""

from tests.helpers.assertions import assert_adjoint, assert_gradients, assert_unchanged
from tests.helpers.fields import DISK, MASKS, RING_AND_ISLANDS, random_field, seeded, uniform_field
from tests.helpers.oracles import component_labels, normal_equations, soup_dil, sparse_solve

__all__ = [
    "DISK",
    "MASKS",
    "RING_AND_ISLANDS",
    "assert_adjoint",
    "assert_gradients",
    "assert_unchanged",
    "component_labels",
    "normal_equations",
    "random_field",
    "seeded",
    "soup_dil",
    "sparse_solve",
    "uniform_field",
]
