"""The rig beside the picture: where the camera sees it, tinted where landmarks are suspect, absent without a face."""

from dataclasses import replace
from pathlib import Path

import torch

from torchface.capture.own_rig import VideoSolution
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.io.video import VideoFile
from torchface.landmarks import FaceReading
from torchface.synthetic import performer
from torchface.viz.figures.landmark_dots import with_dots
from torchface.workflows.track.overlay_video import camera_at, head_window, side_by_side_drawer
from torchface.workflows.track.track_inputs import TrackInputs, TrackSettings
from torchface.workflows.track.track_models import TrackModels
from torchface.workflows.track.track_result import Tracked


def test_the_rig_stands_where_the_camera_sees_it_and_shows_what_is_suspect() -> None:
    rig, calibration = performer(), assumed_calibration(320, 240)
    marks = rig.vertices[rig.neutral.landmarks].double()
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    move = torch.tensor([40.0, 10.0, 900.0]).double() - rotation @ marks.mean(0)
    solution = VideoSolution(
        weights=torch.zeros(2, len(rig.names)),
        rotation=rotation.repeat(2, 1, 1),
        translation=move.repeat(2, 1),
        errors=torch.zeros(2),
        solved=torch.ones(2) > 0,
        confidence=torch.ones(2, len(rig.names)),
    )
    rays = (marks @ rotation.T + move) @ calibration.intrinsics.double().T
    landmarks = (rays[:, :2] / rays[:, 2:]).float().repeat(2, 1, 1)
    film = VideoFile(Path("film.avi"), 30.0, 320, 240, 2)
    reading = FaceReading(landmarks, torch.zeros(2, 68), torch.ones(2, 68), torch.ones(2))
    inputs = TrackInputs(TrackSettings(), film, rig, calibration, TrackModels(None))
    tracked = Tracked(inputs, reading, landmarks, solution)
    picture = torch.full((3, 240, 320), 120, dtype=torch.uint8)
    window, at = head_window(tracked), camera_at(tracked, 0)
    seen = replace(window, rotation=at.rotation, translation=at.translation)
    x, y = seen.project(marks[30]).round().long().tolist()
    assert 0 < x < window.width
    assert 0 < y < window.height
    clay = side_by_side_drawer(tracked)(0, picture).int()
    assert clay.shape == (3, window.height, 2 * window.width)
    assert (clay[:, y, window.width + x] > 90).all()  # the tip of the nose, lit
    assert clay[1, y, x] - clay[0, y, x] > 60  # the landmark found there, green
    doubted = replace(tracked, reading=replace(reading, deviation=torch.full((2, 68), 1e3)))
    tinted = side_by_side_drawer(doubted)(0, picture).int()[:, y, window.width + x]
    assert tinted[0] - tinted[2] > 60
    assert doubted.suspect_spans() == [(0, 1, "low confidence")]
    gone = landmarks.clone()
    gone[0] = torch.nan
    lost = replace(tracked, reading=replace(reading, landmarks=gone))
    assert (side_by_side_drawer(lost)(0, picture)[:, y, window.width + x] < 50).all()
    assert lost.suspect_spans() == [(0, 0, "no face")]


def test_dots_leave_the_frame_as_it_is() -> None:
    frame = torch.zeros(40, 50, 3, dtype=torch.uint8).permute(2, 0, 1)  # as decoders give it
    drawn = with_dots(frame, torch.tensor([[10.0, 10.0]]), torch.tensor([[30.0, 20.0]]))
    assert not frame.any()
    assert drawn[:, 10, 10].tolist() == [60, 230, 60]
    assert drawn[:, 20, 30].tolist() == [250, 70, 60]
