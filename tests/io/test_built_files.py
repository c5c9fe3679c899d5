"""Readers take files whose parts disagree as they take good ones: a value, or an error of ours."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from built_files import check_built

from torchface import Attachment, load_mesh, load_rig, load_take
from torchface.capture.action_units import load_shape_table
from torchface.capture.retargeting import load_shape_rules
from torchface.files.models import read_record
from torchface.io import load_calibration, load_correspondences, load_landmark_points, load_landmarks
from torchface.io.action_labels import load_action_labels
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.detail_textures import read_gltf_detail
from torchface.io.gltf.gltf_reading import read_gltf_rig
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.landmarks import load_annotations

CASES = int(os.environ.get("TORCHFACE_FUZZ_CASES", "12"))


def load_attachment(path: Path) -> Attachment:
    return Attachment.load(path)


READERS: list[tuple[Callable[[Path], object], str, str]] = [
    (load_mesh, "built_meshes", "obj_files"),
    (load_mesh, "built_meshes", "ply_files"),
    (load_mesh, "built_meshes", "stl_files"),
    (load_mesh, "built_meshes", "off_files"),
    (load_mesh, "built_meshes", "gltf_files"),
    (read_gltf_rig, "built_meshes", "gltf_files"),
    (read_gltf_weights, "built_meshes", "gltf_files"),
    (read_gltf_detail, "built_meshes", "gltf_files"),
    (load_rig, "built_meshes", "rig_folders"),
    (load_take, "built_takes", "c3d_files"),
    (load_take, "built_takes", "trc_files"),
    (load_take, "built_takes", "csv_files"),
    (load_dlib_faces, "built_documents", "dlib_files"),
    (load_landmark_points, "built_documents", "pts_files"),
    (load_landmark_points, "built_documents", "ljson_files"),
    (load_landmarks, "built_documents", "landmark_files"),
    (load_correspondences, "built_documents", "correspondence_files"),
    (load_attachment, "built_documents", "attachment_files"),
    (load_annotations, "built_documents", "annotation_files"),
    (load_calibration, "built_documents", "camera_files"),
    (load_shape_rules, "built_documents", "shape_rule_files"),
    (load_shape_table, "built_documents", "shape_table_files"),
    (read_record, "built_documents", "model_files"),
    (load_action_labels, "built_documents", "action_label_files"),
]


@pytest.mark.parametrize(("reader", "module", "strategy"), READERS)
def test_a_built_file_is_read_or_refused(reader: Callable[[Path], object], module: str, strategy: str) -> None:
    check_built(reader, module, strategy, CASES)
