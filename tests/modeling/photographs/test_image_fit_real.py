"""A real photograph: the head found looks where the face looks, its mouth is as closed as the photograph's."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from torchface.attachment import Attachment
from torchface.io.images.image_files import load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.io.rigs.ict_facekit import load_identity_modes
from torchface.modeling import FitSettings, HeadModel, MorphableModel, fit_images
from torchface.rig import BlendshapeRig


def people(rig: BlendshapeRig, ict_folder: Path) -> HeadModel:
    """Real people's shapes on the rig's neutral."""
    modes = load_identity_modes(ict_folder, part="face").deltas
    sizes = modes.flatten(1).norm(dim=1)
    return HeadModel.on(rig.neutral, MorphableModel(rig.vertices, modes / sizes[:, None, None], sizes))


@pytest.mark.real
def test_a_real_portrait(
    data: Path, ict_folder: Path, real_capture: tuple[BlendshapeRig, Attachment, list[torch.Tensor]]
) -> None:
    rig = real_capture[0]
    model = people(rig, ict_folder)
    path = data / "images" / "ibug" / "image_0010.png"
    image = load_image(path)
    marks = load_landmark_points(path.with_suffix(".pts")).ibug()
    fit = fit_images(model, rig, marks[None], (image.shape[2], image.shape[1]), settings=FitSettings(transfers=0))
    eyes = float((marks[36] - marks[45]).norm())
    assert float(fit.errors[0]) < 0.07 * eyes
    assert float(fit.residuals[0, 17:].norm(dim=-1).mean()) < 0.04 * eyes
    yaw = math.degrees(math.atan2(-float(fit.cameras[0].rotation[2, 0]), -float(fit.cameras[0].rotation[2, 2])))
    assert 15 < yaw < 45  # the face is turned toward the viewer's left
    assert float(fit.coefficients.abs().max()) < 2.5
    upper, lower = rig.neutral.landmarks[61:64], rig.neutral.landmarks[[67, 66, 65]]
    assert float((fit.posed.vertices[upper] - fit.posed.vertices[lower]).norm(dim=-1).mean()) < 2.0


@pytest.mark.real
def test_smiles_of_turned_heads_are_as_strong_on_both_sides(
    data: Path, ict_folder: Path, real_capture: tuple[BlendshapeRig, Attachment, list[torch.Tensor]]
) -> None:
    """Taken alone, 68 landmarks of a head turned by 36 degrees gave 0.63 and 0.24 to the halves of one smile."""
    rig = real_capture[0]
    model = people(rig, ict_folder)
    left, right = rig.index(["mouthSmile_L", "mouthSmile_R"])
    folder, apart = data / "images" / "dlib_faces", []
    for face in load_dlib_faces(folder / "training_with_face_landmarks.xml"):
        image = load_image(folder / face.image)
        fit = fit_images(
            model, rig, face.points[None], (image.shape[2], image.shape[1]), settings=FitSettings(transfers=0)
        )
        apart.append(float((fit.weights[left] - fit.weights[right]).abs()))
    assert max(apart) < 0.1
    assert sum(apart) / len(apart) < 0.06
