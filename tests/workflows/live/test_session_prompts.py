"""What a session says to whoever performs: the guided calibration, faces that are not seen, latency."""

import numpy as np
import pytest
import torch

from torchface.workflows.live.live_figures import LiveFigures, LiveReport
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.session_prompts import GuidedCalibration, LightWatch


def test_the_calibrations_clock_stands_while_no_face_is_seen() -> None:
    calibration: GuidedCalibration | None = GuidedCalibration(3.0)
    for _ in range(100):
        calibration = calibration.after(0.1, seen_at(float("nan")))
    assert calibration == GuidedCalibration(3.0)
    assert calibration.pose == 2
    assert GuidedCalibration(9.95).after(0.1, seen_at(1.0)) is None
    assert GuidedCalibration(9.95).result.startswith("Not calibrated: no pose was seen")


def seen_at(x: float) -> LiveFrame:
    """A face whose landmarks lie at one place; none at NaN."""
    return LiveFrame(torch.zeros(52), torch.eye(3), torch.tensor([[x, 20.0]]).expand(68, 2))


def test_darkness_is_said_where_no_face_is_seen() -> None:
    watch = LightWatch()
    bright, dark = np.full((48, 64, 3), 120, np.uint8), np.full((48, 64, 3), 9, np.uint8)
    for picture, x, words in ((bright, float("nan"), ""), (dark, float("nan"), "Too dark"), (dark, 11.0, "")):
        watch.look(picture, seen_at(x), 0.0)
        assert watch.words.startswith(words)
        assert bool(watch.words) == bool(words)


def test_latency_is_told_within_a_hundredth() -> None:
    figures = LiveFigures()
    for i in range(1, 1001):
        figures.add(i / 30, i / 30 + i / 1000, i % 2 == 0)
    assert figures.latency(0.5) == pytest.approx(500, rel=0.01)
    assert figures.latency(0.99) == pytest.approx(990, rel=0.01)
    assert (figures.frames, figures.found) == (1000, 500)
    assert figures.fps == pytest.approx(30)


def test_a_short_session_of_a_camera_has_the_cameras_rate() -> None:
    """Not frames by seconds: of three frames there are two intervals, and the last one's solve is none."""
    figures = LiveFigures()
    for i in range(3):
        figures.add(i / 30, i / 30 + 0.1, True)
    assert LiveReport(figures, 0).lines()[0] == "3 frames solved in 0.2 s, a face in 3; they came at 30.0 a second"


def test_a_session_without_a_face_is_warned_of() -> None:
    figures = LiveFigures()
    assert "warning" not in "".join(LiveReport(figures, 0).lines())
    figures.add(0.0, 0.1, False)
    assert LiveReport(figures, 0).lines()[-1].startswith("warning: no face was found")
