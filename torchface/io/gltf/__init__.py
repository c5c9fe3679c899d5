"""glTF 2.0 with morph targets, read from whoever wrote it and written for whoever reads it."""

from torchface.io.gltf.gltf_reading import read_gltf_mesh, read_gltf_rig
from torchface.io.gltf.gltf_writing import ShapeMatch, save_animation, save_gltf_mesh, write_gltf_rig
from torchface.io.gltf.wrinkle_maps import load_detail_maps

__all__ = [
    "ShapeMatch",
    "load_detail_maps",
    "read_gltf_mesh",
    "read_gltf_rig",
    "save_animation",
    "save_gltf_mesh",
    "write_gltf_rig",
]
