"""Files in and out: meshes, rigs, takes; lengths become millimetres coming in and the file's unit going out."""

from torchface.io.gltf import ShapeMatch, save_animation, save_rig
from torchface.io.ict_facekit import IdentityModes, load_ict_facekit, load_identity_modes
from torchface.io.images import load_image, save_image
from torchface.io.meshes import load_mesh, save_mesh
from torchface.io.rigs import load_obj_folder, load_rig
from torchface.io.takes import load_take, save_take

__all__ = [
    "IdentityModes",
    "ShapeMatch",
    "load_ict_facekit",
    "load_identity_modes",
    "load_image",
    "load_mesh",
    "load_obj_folder",
    "load_rig",
    "load_take",
    "save_animation",
    "save_image",
    "save_mesh",
    "save_rig",
    "save_take",
]
