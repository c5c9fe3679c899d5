"""glTF 2.0 with morph targets, read from whoever wrote it and written for whoever reads it."""

from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.gltf_reading import read_gltf_mesh, read_gltf_rig
from torchface.io.gltf.gltf_writing import save_gltf_mesh, write_gltf_rig
from torchface.io.gltf.region_textures import load_region_maps
from torchface.io.gltf.wrinkle_maps import read_gltf_detail

__all__ = [
    "load_region_maps",
    "read_gltf_detail",
    "read_gltf_mesh",
    "read_gltf_rig",
    "read_gltf_weights",
    "save_gltf_mesh",
    "write_gltf_rig",
]
