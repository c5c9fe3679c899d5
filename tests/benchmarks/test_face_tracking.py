"""Faces and landmarks in real pictures: what is found, how far it is off, how much it trembles, what it costs.

``make bench`` prints the figures.
"""

import time
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.io.images.image_files import load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.io.video import open_video
from torchface.landmarks import LandmarkTracker, LandmarkTrees, find_faces, find_landmarks, landmark_jitter
from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.landmarks.images.ibug_68 import box_around
from torchface.landmarks.images.tracking.video_landmarks import track_landmarks
from torchface.landmarks.images.trees.landmark_consensus import ConsensusSettings
from torchface.landmarks.images.trees.tree_finder import TreeFinder


@pytest.fixture(scope="module")
def trees() -> LandmarkTrees:
    model = zoo.get_model("face_landmarks")
    assert isinstance(model, LandmarkTrees)
    return model


def photographs(data: Path) -> list[tuple[Path, list[Tensor], str]]:
    """Photographs, landmarks (68,2) of faces in them, and whose these are: a person's, or dlib's predictor's.

    The latter are a reference, not the truth.
    """
    folder = data / "images" / "dlib_faces"
    faces: dict[str, list[Tensor]] = {}
    for one in load_dlib_faces(folder / "training_with_face_landmarks.xml"):
        faces.setdefault(one.image, []).append(one.points.float())
    kinds = (data / "images" / kind for kind in ("people", "ibug"))
    portraits = sorted(path for kind in kinds for path in kind.iterdir() if path.suffix != ".pts")
    return [
        *((folder / name, marks, "dlib's") for name, marks in faces.items()),
        *((path, [load_landmark_points(path.with_suffix(".pts")).ibug().float()], "by hand") for path in portraits),
    ]


@pytest.mark.real
def test_photographed_faces(trees: LandmarkTrees, data: Path) -> None:
    found, total = 0, 0
    wrong = {"dlib's": 0, "by hand": 0}
    off: dict[str, list[float]] = {whose: [] for whose in wrong}
    for path, marks, whose in photographs(data):
        picture = (load_image(path) * 255).round().to(torch.uint8)
        faces = find_faces(picture)
        shared = overlaps(torch.stack([box_around(one[None])[0] for one in marks]), faces.boxes)
        total += len(marks)
        wrong[whose] += int((shared.amax(0) < 0.3).sum())
        for one, row in zip(marks, shared, strict=True):
            if len(row) and float(row.max()) > 0.3:
                found += 1
                seen = find_landmarks(picture, trees, int(row.argmax()))
                off[whose].append(float((seen.landmarks - one).norm(dim=1).mean() / (one[36] - one[45]).norm()))
    errors = {whose: torch.tensor(shares) for whose, shares in off.items()}
    print(f"\n{found} of {total} faces found; landmarks off by, of the distance of the eyes' outer corners")
    for whose, shares in errors.items():
        print(
            f"  {len(shares):2} faces, landmarks {whose:8}: {shares.mean():.1%} mean, {shares.median():.1%} median; "
            f"{wrong[whose]} boxes where there is no face"
        )
    assert found >= 20
    assert wrong["dlib's"] == 0
    assert wrong["by hand"] <= 1  # a collar
    assert errors["dlib's"].median() < 0.08
    assert errors["by hand"].mean() < 0.065


@pytest.mark.real
def test_a_filmed_face(trees: LandmarkTrees, data: Path) -> None:
    frames = list(open_video(data / "video" / "single_face.mp4").frames())
    jitter = {}
    print("\nstarts  frames tracked  jitter, pixels  without the jaw  ms of processor time a frame")
    for starts in (2, 4, 8, 16, 32):
        begun = time.process_time()
        track = track_landmarks(frames, LandmarkTracker(TreeFinder(trees, ConsensusSettings(starts=starts))))
        spent = 1000 * (time.process_time() - begun) / len(frames)
        seen = int(torch.isfinite(track.values).flatten(1).all(1).sum())
        jitter[starts] = float(landmark_jitter(track.values))
        inner = float(landmark_jitter(track.values[:, 17:]))
        print(f"{starts:6}  {seen:7} of {len(frames)}  {jitter[starts]:14.2f}  {inner:15.2f}  {spent:28.1f}")
        assert seen == len(frames)
    assert jitter[16] < 0.6 * jitter[2]


@pytest.mark.real
def test_a_video_without_a_face(trees: LandmarkTrees, data: Path) -> None:
    track = track_landmarks(data / "video" / "no_face.mp4", LandmarkTracker(trees))
    seen = int(torch.isfinite(track.values).flatten(1).all(1).sum())
    print(f"\n{seen} of {len(track)} frames show a face where there is none")
    assert seen == 0
