"""Files in and out: meshes, rigs, takes. Lengths become millimetres on the way in and the file's unit on the way out."""

from torchface.io.ict_facekit import IdentityModes, load_ict_facekit, load_identity_modes
from torchface.io.images import load_image, save_image
from torchface.io.rigs import load_obj_folder, load_rig

__all__ = [
    "IdentityModes",
    "load_ict_facekit",
    "load_identity_modes",
    "load_image",
    "load_obj_folder",
    "load_rig",
    "save_image",
]
