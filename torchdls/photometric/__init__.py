"""Photometric stereo: normals, albedo and confidence from images under known lights, and images to try it on."""

from torchdls._registry import PHOTOMETRIC
from torchdls.photometric.bivariate import bivariate_normals
from torchdls.photometric.dictionary import dlnv_normals, dlpi_normals
from torchdls.photometric.least_squares import woodham
from torchdls.photometric.lights import lights_from_ball
from torchdls.photometric.low_rank import low_rank_normals
from torchdls.photometric.model import PhotometricResult
from torchdls.photometric.refine import RefineResult, refine
from torchdls.photometric.render import cast_shadows, render, ring_of_lights
from torchdls.photometric.sparse import sparse_normals

__all__ = [
    "PHOTOMETRIC",
    "PhotometricResult",
    "RefineResult",
    "bivariate_normals",
    "cast_shadows",
    "dlnv_normals",
    "dlpi_normals",
    "lights_from_ball",
    "low_rank_normals",
    "refine",
    "render",
    "ring_of_lights",
    "sparse_normals",
    "woodham",
]
