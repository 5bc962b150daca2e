"""The conventions that users meet: the one table, without PyTorch, so that the command line can name them at once.

Canonical component k is sign * source[index], (index, sign) = table[name][k]: frames are signed permutations. The first
of each table is the canonical one.
"""

from __future__ import annotations

Axes = tuple[tuple[int, int], ...]

NORMAL_CONVENTIONS: dict[str, Axes] = {
    "opengl": ((0, 1), (1, 1), (2, 1)),  # x right, y up, z to the viewer (also glTF, Blender, DiLiGenT)
    "directx": ((0, 1), (1, -1), (2, 1)),  # x right, y down, z to the viewer (green channel inverted)
    "opencv": ((0, 1), (1, -1), (2, -1)),  # x right, y down, z forward, normals to the camera (n3 < 0)
    "kornia": ((0, -1), (1, 1), (2, 1)),  # the same frame, normals away from the camera (n3 > 0)
    "matlab": ((1, 1), (0, -1), (2, 1)),  # x down the rows, y along the columns, z to the viewer
}

GRADIENT_CONVENTIONS: dict[str, Axes] = {
    "image": ((0, 1), (1, 1)),  # height: to the right, down
    "cartesian": ((0, 1), (1, -1)),  # height: to the right, up
    "depth": ((0, -1), (1, -1)),  # depth (distance, grows away): to the right, down
    "matlab": ((1, 1), (0, 1)),  # height: down the rows, along the columns
}

AUTO = "auto"  # asks for the most integrable reading of a normal map
