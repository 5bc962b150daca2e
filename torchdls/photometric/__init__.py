"""Photometric stereo: normals, albedo and confidence from images under known lights, and images to try it on."""

from torchdls.photometric.least_squares import woodham
from torchdls.photometric.low_rank import low_rank_normals
from torchdls.photometric.model import PhotometricResult
from torchdls.photometric.render import cast_shadows, render, ring_of_lights
from torchdls.photometric.sparse import sparse_normals

__all__ = [
    "PhotometricResult",
    "cast_shadows",
    "low_rank_normals",
    "render",
    "ring_of_lights",
    "sparse_normals",
    "woodham",
]
