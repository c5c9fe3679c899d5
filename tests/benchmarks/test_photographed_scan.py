"""Claim: photographs of one expression give a head nearer to the scan photographed than their landmarks alone do.

The real scan with its texture, drawn at five angles, 400 pixels, landmarks found by the zoo's network, ICT-FaceKit's
identity modes, focal length not given. Errors are distances of the face's skin inside its outline (jaw, and over the
brows) to the scan's surface after the best similarity.
"""

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
import trimesh
from torch import Tensor

from torchface import Mesh
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_landmark_points, load_mesh
from torchface.io.rigs.ict_facekit import region
from torchface.landmarks import FaceReading
from torchface.modeling import FitSettings, fit_images
from torchface.modeling.photographs.skin_mask import FacePlaces
from torchface.registration.nonrigid.correspondence import exposed_vertices
from torchface.rendering.clay_shading import render
from torchface.workflows.fit.fit_landmarks import find_in_photographs
from torchface.workflows.fit.fit_readings import with_readings
from torchface.workflows.named_finders import part_finder
from torchface.workflows.named_priors import DEFAULT_PRIOR, load_priors
from train.morphable import ict_head_model

pytestmark = pytest.mark.real

SIZE, FIELD, YAWS = 400, 14.0, (-35.0, -20.0, 0.0, 20.0, 35.0)
SETS = ((2, 3), (1, 2, 3), (0, 2, 4), (0, 1, 2, 3, 4))


def upright(data: Path) -> tuple[Mesh, Tensor]:
    """The scan and its landmarks (68,3), turned to face +z, the origin between them."""
    scan = load_mesh(data / "scans" / "james" / "james.obj")
    given = load_landmark_points(data / "scans" / "james" / "james.ljson").ibug().double()
    right = torch.nn.functional.normalize(given[45] - given[36], dim=0)
    up = given[27] - given[8]
    up = torch.nn.functional.normalize(up - (up @ right) * right, dim=0)
    frame = torch.stack([right, up, torch.linalg.cross(right, up)]).T
    middle = given[27:].mean(0)
    return scan.with_vertices(((scan.vertices.double() - middle) @ frame).float()), (given - middle) @ frame


def face_error(head: Mesh, scan: trimesh.Trimesh, places: Tensor) -> Tensor:
    """Mean and median distance of a head's face to a scan with landmarks (68,3), millimetres."""
    marks = head.vertices[head.landmarks].double()[17:]
    face = head.regions["narrow_face"] & (FacePlaces.of(head).out < 1)
    face &= exposed_vertices(head.vertices, head.faces, 30.0)  # no nostrils, no insides of lids and lips
    shown = similarity_transform(marks[None], places[17:][None]).apply(head.vertices[face].double()[None])[0]
    for _ in range(10):
        near, _, _ = trimesh.proximity.closest_point(scan, shown.numpy())
        shown = similarity_transform(shown[None], torch.from_numpy(near)[None]).apply(shown[None])[0]
    distance = torch.from_numpy(trimesh.proximity.closest_point(scan, shown.numpy())[1])
    return torch.stack([distance.mean(), distance.median()])


def test_photographs_of_a_scan(data: Path, ict_folder: Path) -> None:
    torch.set_num_threads(1)
    whole = ict_head_model(ict_folder)
    face = region(whole.rig.neutral, "face")
    model, rig = whole.part(face), whole.rig.part(face)
    prior = load_priors(rig, DEFAULT_PRIOR, None).shapes
    mesh, places = upright(data)
    scan = trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False)
    cameras = [look_at(torch.zeros(3).double(), yaw, 3.0, 280.0, SIZE, SIZE, FIELD) for yaw in YAWS]
    images = [render(mesh, camera)[:3] for camera in cameras]
    found = [find_in_photographs([Path(f"{yaw:.0f}.png")], [one])[0] for yaw, one in zip(YAWS, images, strict=True)]
    parts = [part_finder()((255 * image).byte(), one.confident) for image, one in zip(images, found, strict=True)]

    def fitted(rows: Sequence[int], match_skin: bool) -> tuple[Tensor, float]:
        some = [found[row] for row in rows]
        settings = FitSettings(
            transfers=0, texture_size=0, expression_prior=prior, annotated=True,
            match_skin=match_skin, parts=[parts[row] for row in rows],
        )  # fmt: skip
        read = with_readings(settings, FaceReading.stacked([one.face for one in some]), some[0].places, rig)
        marks = torch.stack([one.confident for one in some])
        fit = fit_images(model, rig, marks, (SIZE, SIZE), [images[row] for row in rows], settings=read)
        return face_error(fit.mesh, scan, places), float(fit.cameras[0].intrinsics[0, 0])

    true = float(cameras[0].intrinsics[0, 0])
    mean = face_error(rig.neutral.with_vertices(model.shape.mean), scan, places)
    print(f"\nmean head {mean[0]:.2f} mm ({mean[1]:.2f} median); true focal length {true:.0f} pixels")
    print(f"{'photographs at':28s}{'landmarks: mm, median, focal':>32s}{'and skin':>32s}")
    for rows in SETS:
        angles = ", ".join(f"{YAWS[row]:.0f}" for row in rows)
        alone, both = fitted(rows, False), fitted(rows, True)
        cells = (f"{error[0]:12.2f}{error[1]:10.2f}{focal:10.0f}" for error, focal in (alone, both))
        print(f"{angles:28s}" + "".join(cells))
        if len(rows) > 2:
            assert both[0][0] < 0.85 * alone[0][0]
        assert abs(both[1] - true) < abs(alone[1] - true)
