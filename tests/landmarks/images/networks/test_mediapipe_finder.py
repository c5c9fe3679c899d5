"""MediaPipe is asked through a pipe; whatever goes wrong on its side ends in a message."""

from __future__ import annotations

import io
import struct
import sys
import types
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchface.errors import MissingExtraError, ShapeError
from torchface.landmarks.images.face_mesh_478 import landmarks_of_mesh
from torchface.landmarks.images.networks import mediapipe_finder, mediapipe_process
from torchface.landmarks.images.networks.mediapipe_finder import PYTHON, MediaPipeError, MediaPipeFinder

BOX = torch.tensor([20.0, 10.0, 40.0, 40.0])
IMAGE = torch.zeros(60, 80, dtype=torch.uint8)


def stand_in(path: Path, answer: str) -> Path:
    """A Python that runs no script, but answers each crop of 224 pixels by what ``answer`` writes."""
    path.write_text(
        f"#!{sys.executable}\nimport sys, struct\nout = sys.stdout.buffer\n"
        "out.write(struct.pack('<I', 0)); out.flush()\n"
        "while len(sys.stdin.buffer.read(8 + 3 * 224 * 224)) > 8:\n"
        f"    {answer}\n    out.flush()\n"
    )
    path.chmod(0o755)
    return path


def test_points_of_the_mesh_come_back_in_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = "out.write(struct.pack('<I956f', 478, *([0.5, 0.25] * 478)))"
    monkeypatch.setenv(PYTHON, str(stand_in(tmp_path / "python", answer)))
    finder = MediaPipeFinder()
    for _ in range(2):
        found = finder(IMAGE, BOX)
    # The crop is 1.8 boxes a side, so that a quarter of it is 18 pixels.
    torch.testing.assert_close(found.landmarks, torch.tensor([40.0, 12.0]).expand(68, 2), atol=1e-3, rtol=0)
    assert found.presence == 1
    process = finder._process
    finder.close()
    assert not process.alive
    with pytest.raises(MediaPipeError, match="was closed"):
        finder(IMAGE, BOX)


def test_no_face_is_an_answer(tmp_path: Path) -> None:
    found = MediaPipeFinder(stand_in(tmp_path / "python", "out.write(struct.pack('<I', 0))"))(IMAGE, BOX)
    assert found.presence == 0
    assert torch.isfinite(found.landmarks).all()


def test_what_goes_wrong_there_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mediapipe_finder, "_ANSWER_SECONDS", 0.3)
    for answer, message in (
        ("out.write(struct.pack('<I', 5))", "gave 5 points, expected 478"),
        ("sys.exit('the model is broken')", "has ended: the model is broken"),
        ("import time; time.sleep(60)", "gave no answer in 0.3 seconds"),
        ("out.write(struct.pack('<I', 478)); out.flush(); sys.exit()", "in the midst of an answer"),
    ):
        finder = MediaPipeFinder(stand_in(tmp_path / "python", answer))
        with pytest.raises(MediaPipeError, match=message):
            finder(IMAGE, BOX)
        finder.close()
    with pytest.raises(MissingExtraError, match=r"No module named 'mediapipe'; install it .*mediapipe==0.10.14"):
        MediaPipeFinder(sys.executable)  # the wheel is never in the environment of the tests
    monkeypatch.delenv(PYTHON, raising=False)
    with pytest.raises(MissingExtraError, match="found no Python that has it"):
        MediaPipeFinder()
    with pytest.raises(MissingExtraError, match="nowhere: found no such file"):
        MediaPipeFinder(tmp_path / "nowhere")


def test_the_process_answers_crop_by_crop(monkeypatch: pytest.MonkeyPatch) -> None:
    class FaceMesh:
        """Sees a face in bright crops; all its points lie at the share of the red that the crop begins with."""

        def __init__(self, **options: object) -> None:
            assert options == {"static_image_mode": True, "max_num_faces": 1, "refine_landmarks": True}

        def process(self, pixels: np.ndarray) -> SimpleNamespace:
            if pixels.mean() < 10:
                return SimpleNamespace(multi_face_landmarks=None)
            point = SimpleNamespace(x=pixels[0, 0, 0] / 256, y=pixels.shape[0] / 8)
            return SimpleNamespace(multi_face_landmarks=[SimpleNamespace(landmark=[point] * 478)])

    module = types.ModuleType("mediapipe")
    module.solutions = SimpleNamespace(face_mesh=SimpleNamespace(FaceMesh=FaceMesh))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "mediapipe", module)
    crops = [np.full((4, 2, 3), value, np.uint8) for value in (64, 0)]
    asked = b"".join(struct.pack("<II", 4, 2) + crop.tobytes() for crop in crops)
    answers = io.BytesIO()
    mediapipe_process.serve(io.BytesIO(asked + b"\x01\x00"), answers)
    said = answers.getvalue()
    assert struct.unpack_from("<II", said) == (0, 478)
    assert struct.unpack_from("<ff", said, 8 + 8 * 477) == (0.25, 0.5)
    assert said[8 + 8 * 478 :] == struct.pack("<I", 0)
    with pytest.raises(ValueError, match="expected at most 4096"):
        mediapipe_process.serve(io.BytesIO(struct.pack("<II", 5000, 2)), io.BytesIO())


def test_landmarks_are_picked_from_the_mesh() -> None:
    mesh = torch.arange(478.0)[:, None].expand(478, 2)
    found = landmarks_of_mesh(mesh)
    assert found[[36, 45, 48, 54, 30], 0].tolist() == [33, 263, 61, 291, 4]
    assert found[27, 0] == (6 + 168) / 2
    torch.testing.assert_close(landmarks_of_mesh(mesh[:468]), found)
    with pytest.raises(ShapeError, match=r"expected \(\.\.\.,478,D\)"):
        landmarks_of_mesh(torch.zeros(4, 68, 2))
