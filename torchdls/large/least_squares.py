r"""Least squares, exact, in three passes over a file.

The least-squares height of a full rectangle is diagonal in the cosine basis, and the transform is separable:

    z = (C_H^T ((C_H (A^T v C_W^T)) / e)) C_W,      e[k, l] = 4 sin^2(pi k / 2H) / dy^2 + 4 sin^2(pi l / 2W) / dx^2

so bands of rows give A^T v C_W^T (a band needs one row of its neighbours), strips of columns are transformed, divided
and transformed back, and bands of rows once more give the height. Nothing is approximated: the tiles leave no trace.
"""

from __future__ import annotations

from collections.abc import Iterator

from torchdls._files import Array
from torchdls.large.transform import Passes, columns_back, columns_forward, integrated, rows_back, rows_forward


def least_squares(passes: Passes) -> Iterator[tuple[slice, Array]]:
    """Bands of the height."""
    between = passes.scratch("spectrum")
    for rows in passes.bands():
        between[rows] = rows_forward(passes.divergence(rows, passes.step))
    for columns in passes.strips():
        spectrum = columns_forward(between[:, columns])
        between[:, columns] = columns_back(integrated(spectrum, columns, passes.size, passes.step))
    for rows in passes.bands():
        yield rows, rows_back(between[rows])
