"""A make-up artist's markers: named, symmetric, on the face alone, and they see what the face does."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.capture.markers import observability
from torchface.errors import ValueRangeError
from torchface.io import load_rig
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages.makeup_layout import landmarks_by_shape, makeup_layout
from torchface.synthetic.stages.marker_stage import place_markers

EYES_AND_BROWS = ("forehead", "brow", "lids", "infraorbital")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False)


def without_landmarks(rig: BlendshapeRig) -> BlendshapeRig:
    return BlendshapeRig(replace(rig.neutral, annotations=None), rig.deltas, rig.names)


def test_markers_are_symmetric_apart_and_on_the_face(rig: BlendshapeRig) -> None:
    layout = makeup_layout(rig)
    attachment, count = layout.attachment, len(layout.regions)
    labels = attachment.labels
    assert 60 <= count <= 100
    assert len(set(labels)) == count
    points = attachment.on(rig.neutral.faces, rig.vertices)
    mirrored = points[layout.mirror] * torch.tensor([-1.0, 1, 1])
    assert float((points - mirrored).norm(dim=1).max()) < 3
    apart = torch.cdist(points, points) + 100 * torch.eye(count)
    assert float(apart.min()) > 4
    # A landmark's site is the landmark.
    inner = points[labels.index("browInnerL")]
    assert float((inner - rig.vertices[rig.neutral.landmarks[22]]).norm()) < 2
    corners = rig.neutral.faces[attachment.triangles]
    for region in ("ear_left", "ear_right", "neck", "cranium", "mouth_interior", "eyeball_left", "eyeball_right"):
        assert not rig.neutral.annotations.regions[region][corners].all(1).any(), region
    counts = layout.counts()
    assert sum(counts[region] for region in EYES_AND_BROWS) > 0.35 * count
    # Above the lower lip's edge sit most, where it was every second one.
    below = points[:, 1] < float(rig.vertices[rig.neutral.landmarks[57], 1])
    assert float(below.float().mean()) < 0.25


def test_it_sees_lids_better_than_markers_spread_by_motion(rig: BlendshapeRig) -> None:
    def moved(shape: str, attachment) -> float:
        points = attachment.on(rig.neutral.faces, rig.deltas[rig.names.index(shape)])
        return float(points.norm(dim=-1).square().sum().sqrt())

    ours, spread = makeup_layout(rig).attachment, place_markers(rig, 100)
    for shape in ("eyeBlinkLeft", "eyeSquintLeft", "eyeWideRight", "browInnerUp", "noseSneerLeft"):
        assert moved(shape, ours) > 1.1 * moved(shape, spread), shape


def test_without_landmarks_shapes_say_where_the_face_is(rig: BlendshapeRig) -> None:
    head = performer(draw_identities(1, torch.Generator().manual_seed(1))[0])
    faces, vertices = head.neutral.faces, head.vertices
    true = makeup_layout(head).attachment.on(faces, vertices)
    found = makeup_layout(without_landmarks(head)).attachment.on(faces, vertices)
    assert float((found - true).norm(dim=1).mean()) < 4
    nameless = BlendshapeRig(rig.neutral, rig.deltas, [f"shape{i}" for i in range(len(rig.names))])
    with pytest.raises(ValueRangeError, match=r"no 68 landmarks and 0 shapes with ARKit's names.*torchface pick"):
        makeup_layout(without_landmarks(nameless))


@pytest.mark.real
def test_on_a_real_rig_only_gaze_stays_unseen(ict_folder: Path) -> None:
    rig = load_rig(ict_folder, part="face")
    faces, vertices = rig.neutral.faces, rig.vertices
    a, b, c = vertices[faces[makeup_layout(rig).attachment.triangles]].unbind(1)
    assert bool((torch.linalg.cross(b - a, c - a)[:, 2] > 0).all())  # none on the inside of a lid
    seen = observability(MarkerSolver(rig, makeup_layout(rig).attachment))
    assert not seen.unseen
    assert all(name.startswith("eyeLook") for name in seen.ambiguous)
    assert len(seen.ambiguous) < len(observability(MarkerSolver(rig, place_markers(rig, 100))).ambiguous)
    off = landmarks_by_shape(rig) - rig.vertices[rig.neutral.landmarks].double()
    assert float(off[17:].norm(dim=1).mean()) < 8
