"""Files: normal maps, gradients, masks and cameras in; heights and meshes out."""

from torchdls.io.fields import Field, load_camera, load_field, load_mask
from torchdls.io.heights import OUTPUT_SUFFIXES, HeightMap, load_height, save_height
from torchdls.io.meshes import save_mesh
from torchdls.io.photographs import NORMAL_SUFFIXES, Photographs, load_photographs, save_normals

__all__ = [
    "NORMAL_SUFFIXES",
    "OUTPUT_SUFFIXES",
    "Field",
    "HeightMap",
    "Photographs",
    "load_camera",
    "load_field",
    "load_height",
    "load_mask",
    "load_photographs",
    "save_height",
    "save_mesh",
    "save_normals",
]
