"""Files: normal maps, gradients, masks and cameras in; heights and meshes out."""

from torchdls.io.fields import Field, load_camera, load_field, load_mask
from torchdls.io.heights import OUTPUT_SUFFIXES, HeightMap, load_height, save_height
from torchdls.io.meshes import save_mesh

__all__ = [
    "Field",
    "HeightMap",
    "OUTPUT_SUFFIXES",
    "load_camera",
    "load_field",
    "load_height",
    "load_mask",
    "save_height",
    "save_mesh",
]
