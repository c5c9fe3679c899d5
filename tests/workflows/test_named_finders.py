"""Detector of faces in ONNX Runtime: it finds what PyTorch's finds."""

import torch

from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.workflows.named_finders import graph_detector
from train.rendered_people.face_picture import draw_pictures
from train.rendered_people.head_kind import performer_kind


def test_the_detectors_graph_finds_the_same_faces() -> None:
    (one,) = draw_pictures((performer_kind(),), (1.0,), 0, 1, seed=2)
    face = one.rgba[:3] if one.rgba.shape[0] == 4 else one.rgba.permute(2, 0, 1)[:3]
    picture = torch.full((3, 2 * face.shape[1], 3 * face.shape[2]), 90, dtype=torch.uint8)
    picture[:, 40 : 40 + face.shape[1], 150 : 150 + face.shape[2]] = face
    found, expected = graph_detector()(picture), shipped_detector()(picture)
    assert len(expected) == 1
    torch.testing.assert_close(found.boxes, expected.boxes, atol=0.5, rtol=0)
    torch.testing.assert_close(found.tilts, expected.tilts, atol=0.01, rtol=0)
    torch.testing.assert_close(found.scores, expected.scores, atol=0.01, rtol=0)
