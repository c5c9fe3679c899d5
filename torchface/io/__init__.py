"""Files in and out: meshes, rigs, takes; lengths become millimetres coming in and the file's unit going out."""

from torchface.io.camera_files import load_calibration, load_cameras, save_calibration, save_cameras
from torchface.io.gltf.wrinkle_textures import load_region_maps
from torchface.io.head_models.head_model_file import HeadJoints, HeadModelFile, SurfacePlaces
from torchface.io.head_models.head_model_files import load_head_model_file
from torchface.io.images.image_files import load_image, save_image, save_image16, save_normal_map
from torchface.io.landmarks.landmark_points import load_landmark_points, save_pts
from torchface.io.landmarks.picks import (
    Correspondences,
    LandmarkVertices,
    load_correspondences,
    load_landmarks,
    save_correspondences,
    save_landmarks,
)
from torchface.io.mesh_files import load_mesh, save_mesh
from torchface.io.meshes.mesh_sequence import MeshSequence, MeshSequenceWriter
from torchface.io.protocols.weight_sender import FrameSender, WeightSender, open_sender
from torchface.io.rig_files import load_animation, load_detail_maps, load_rig, save_animation, save_rig
from torchface.io.rigs.ict_facekit import IdentityModes, load_ict_facekit, load_identity_modes
from torchface.io.rigs.rig_folder import load_obj_folder
from torchface.io.scenes.weight_keys import ShapeMatch
from torchface.io.take_files import load_take, save_take
from torchface.io.weights.live_link_csv import save_live_link

__all__ = [
    "Correspondences",
    "FrameSender",
    "HeadJoints",
    "HeadModelFile",
    "IdentityModes",
    "LandmarkVertices",
    "MeshSequence",
    "MeshSequenceWriter",
    "ShapeMatch",
    "SurfacePlaces",
    "WeightSender",
    "load_animation",
    "load_calibration",
    "load_cameras",
    "load_correspondences",
    "load_detail_maps",
    "load_head_model_file",
    "load_ict_facekit",
    "load_identity_modes",
    "load_image",
    "load_landmark_points",
    "load_landmarks",
    "load_mesh",
    "load_obj_folder",
    "load_region_maps",
    "load_rig",
    "load_take",
    "open_sender",
    "save_animation",
    "save_calibration",
    "save_cameras",
    "save_correspondences",
    "save_image",
    "save_image16",
    "save_landmarks",
    "save_live_link",
    "save_mesh",
    "save_normal_map",
    "save_pts",
    "save_rig",
    "save_take",
]
