"""What a session says to whoever performs: the guided calibration, faces that are not seen, latency."""

import numpy as np
import pytest
import torch

from torchface.workflows.live.live_figures import LiveFigures
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.session_prompts import FaceWatch, GuidedCalibration


def test_the_calibrations_clock_stands_while_no_face_is_seen() -> None:
    calibration: GuidedCalibration | None = GuidedCalibration(3.0)
    for _ in range(100):
        assert calibration is not None
        calibration = calibration.after(0.1, seen_at(float("nan")))
    assert calibration == GuidedCalibration(3.0)
    assert calibration.pose == 2
    assert GuidedCalibration(9.95).after(0.1, seen_at(1.0)) is None
    assert GuidedCalibration(9.95).result.startswith("Not calibrated: no pose was seen")


def seen_at(x: float) -> LiveFrame:
    """A face whose landmarks lie at one place; none at NaN."""
    return LiveFrame(torch.zeros(52), torch.eye(3), torch.tensor([[x, 20.0]]).expand(68, 2))


def test_no_face_darkness_and_which_of_several_faces_are_said() -> None:
    counted: list[tuple[int, ...]] = []
    boxes = [[40.0, 10.0, 20.0, 20.0], [0.0, 10.0, 20.0, 20.0]]

    def find(picture: torch.Tensor) -> list[list[float]]:
        counted.append(tuple(picture.shape))
        return boxes

    def look(solved: LiveFrame, now: float) -> str:
        watch.look(bright, solved, now)
        if watch._looking is not None:
            watch._looking.join(5)
        watch.look(bright, solved, now)  # with what was found
        return watch.words

    watch = FaceWatch(find)
    bright, dark = np.full((48, 64, 3), 120, np.uint8), np.full((48, 64, 3), 9, np.uint8)
    nobody, left = seen_at(float("nan")), seen_at(11.0)
    watch.look(bright, nobody, 0.0)
    assert watch.words == "No face yet: sit before the camera and look into it"
    watch.look(dark, nobody, 0.1)
    assert watch.words.startswith("Too dark")
    assert look(left, 0.2) == "Your face is followed"
    assert look(left, 0.6) == "Two people: following the right one"  # as in a mirror
    watch.mirrored = False
    assert look(left, 0.7) == "Two people: following the left one"
    assert counted == [(3, 48, 64)] * 2  # not at every frame
    boxes.append([20.0, 30.0, 5.0, 5.0])  # once something looks like a third face
    look(left, 4.0)
    boxes.pop()
    assert look(left, 4.4) == look(left, 4.8) == "Two people: following the left one"
    assert look(nobody, 5.0) == "Your face is hidden: the last expression is held, then relaxes"
    boxes.pop()  # and the other is gone: said soon after this one is seen again
    assert [look(left, 5.0 + 0.4 * i) for i in (1, 2)][-1] == "Your face is followed"


def test_latency_is_told_within_a_hundredth() -> None:
    figures = LiveFigures()
    for i in range(1, 1001):
        figures.add(i / 30, i / 30 + i / 1000, i % 2 == 0)
    assert figures.latency(0.5) == pytest.approx(500, rel=0.01)
    assert figures.latency(0.99) == pytest.approx(990, rel=0.01)
    assert (figures.frames, figures.found) == (1000, 500)
