"""A Face Landmarker bundle in this process: squares and points, and on a real face what MediaPipe itself gives."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from planted.mediapipe_tracker import MediaPipeTracker
from torchface.io.video import open_video
from torchface.landmarks.images.face_landmarker.landmarker_bundle import LandmarkerBundle
from torchface.landmarks.images.face_landmarker.mediapipe_finder import (
    BLENDSHAPES,
    FaceLandmarker,
    FaceSquare,
    MediaPipeFinder,
    MeshFace,
    lid_openness,
    measured_expression,
)
from torchface.landmarks.images.face_mesh_478 import BLENDSHAPE_POINTS, MESH_POINTS, landmarks_of_mesh
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.shape_names import ARKIT
from torchface.workflows.named_finders import load_finder

TASK = "face_landmarker.task"


def stand_in(presence: float = 3.0) -> LandmarkerBundle:
    """Networks that see every point a quarter right of the crop's middle, and the weight k % in the k-th shape."""
    seen = np.tile(np.float32([192.3, 128.3, 0]), MESH_POINTS).reshape(1, 1, 1, -1)
    return LandmarkerBundle(
        landmarks=lambda crop: (seen, np.full((1, 1, 1, 1), presence, np.float32)),
        blendshapes=lambda points: (np.arange(52, dtype=np.float32) / 100,),
        boxes=lambda picture: (np.zeros((1, 896, 16), np.float32), np.full((1, 896, 1), -9.0, np.float32)),
    )


def test_names_and_points_are_the_networks() -> None:
    assert len(BLENDSHAPES) == 52
    assert (BLENDSHAPES[1], BLENDSHAPES[9], BLENDSHAPES[25], BLENDSHAPES[51]) == (
        "browDownLeft", "eyeBlinkLeft", "jawOpen", "noseSneerRight",
    )  # fmt: skip
    assert len(set(BLENDSHAPE_POINTS)) == len(BLENDSHAPE_POINTS) == 146
    assert sorted(BLENDSHAPE_POINTS) == list(BLENDSHAPE_POINTS)


def test_points_of_a_turned_square_come_back_in_pixels() -> None:
    square = FaceSquare(torch.tensor([50.0, 40.0]), 32.0, math.pi / 2)
    face = FaceLandmarker(stand_in()).look(torch.zeros(80, 100, dtype=torch.uint8), square)
    # A quarter of the square, which is turned clockwise, right of its middle is below it in the picture.
    torch.testing.assert_close(face.points, torch.tensor([50.0, 48.0]).expand(MESH_POINTS, 2), atol=0.1, rtol=0)
    assert face.presence == pytest.approx(1 / (1 + math.exp(-3)))


def test_the_square_of_a_mesh_turns_with_it() -> None:
    generator = torch.Generator().manual_seed(0)
    points = 40 * torch.rand(MESH_POINTS, 2, generator=generator)
    points[[33, 263]] = torch.tensor([[10.0, 15.0], [30.0, 15.0]])
    upright = MeshFace(points, 1.0).square
    assert upright.side == pytest.approx(1.5 * float((points.amax(0) - points.amin(0)).amax()), rel=1e-5)
    turn = torch.tensor([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]])
    turned = MeshFace(points @ turn.T, 1.0).square
    assert turned.tilt == pytest.approx(0.7, abs=1e-5)
    assert turned.side == pytest.approx(upright.side, rel=1e-5)
    torch.testing.assert_close(turned.middle, turn @ upright.middle, atol=1e-3, rtol=0)


def test_weights_go_by_name() -> None:
    weights = FaceLandmarker(stand_in()).blendshapes(torch.zeros(MESH_POINTS, 2))
    assert weights[ARKIT.index("jawOpen")] == 0.25
    assert weights.isnan().nonzero().flatten().tolist() == [ARKIT.index("tongueOut")]


def test_what_the_network_takes_off_is_given_back() -> None:
    weights = torch.full((2, len(ARKIT)), 0.04)
    weights[1, ARKIT.index("mouthSmileRight")] += 0.718  # the slope of a full smile
    found, spread = measured_expression(weights)
    torch.testing.assert_close(found[:, ARKIT.index("mouthSmileRight")], torch.tensor([0.0, 1.0]))
    assert spread[ARKIT.index("mouthSmileLeft")] == spread[ARKIT.index("mouthSmileRight")] == 0.23
    for name in ("mouthLeft", "jawOpen", "browInnerUp"):  # names without sides, or that are a side
        assert spread[ARKIT.index(name)] < 1
    for name in ("noseSneerLeft", "cheekPuff", "tongueOut"):
        assert spread[ARKIT.index(name)] == torch.inf
        assert found[:, ARKIT.index(name)].isnan().all()


def test_no_face_is_an_answer() -> None:
    image, box = torch.zeros(80, 100, dtype=torch.uint8), torch.tensor([20.0, 10.0, 40.0, 40.0])
    assert float(MediaPipeFinder(stand_in(-9.0))(image, box).presence) < 1e-3
    assert MediaPipeTracker(stand_in()).mesh(image) is None


def test_openness_of_lids() -> None:
    landmarks = torch.zeros(68, 2)
    landmarks[36:42] = torch.tensor([[0.0, 0], [3, -2], [6, -2], [9, 0], [6, 1], [3, 1]])
    landmarks[42:48] = 2 * landmarks[36:42]
    torch.testing.assert_close(lid_openness(landmarks), torch.tensor([1 / 3, 1 / 3]))


@pytest.mark.real
def test_a_real_face_is_read_as_mediapipe_reads_it(data: Path) -> None:
    """The stored points are those of the older networks of MediaPipe 0.10.14."""
    pytest.importorskip("ai_edge_litert")
    task = data / "peers" / TASK
    finder = load_finder(task).finder
    reference = torch.from_numpy(np.load(data / "landmarks" / "mediapipe_68.npz")["single_face"])
    tracker = MediaPipeTracker(task)
    for number, frame in enumerate(open_video(data / "video" / "single_face.mp4").color_frames()):
        if number == 6:
            break
        face = tracker.mesh(frame)
        eyes = (reference[number, 36] - reference[number, 45]).norm()
        for landmarks in (landmarks_of_mesh(face.points), found(finder, frame, reference[number])):
            assert (landmarks - reference[number]).norm(dim=1).mean() < 0.016 * eyes
    own, _ = turned_box(reference[5])
    reading = finder(frame, own)
    assert (reading.closed < 0.1).all()
    for eye, corners in enumerate(((36, 39), (42, 45))):  # the right eye comes first
        middle = reading.landmarks[list(corners)].mean(0)
        assert (reading.iris[eye] - middle).norm() < 0.1 * eyes


def found(finder: MediaPipeFinder, frame: torch.Tensor, landmarks: torch.Tensor) -> torch.Tensor:
    box, tilt = turned_box(landmarks)
    return finder(frame, box, float(tilt)).landmarks
