"""A video of variable frame rate is tracked at its frames' own times, which the written files keep."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from video_samples import encode

from torchface import load_rig, load_take, save_rig
from torchface.errors import FileFormatError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.io.video import open_video
from torchface.synthetic.head.performer import performer
from torchface.take import Take, Track
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_video import track_video

WIDTH, HEIGHT = 160, 120
TIMES = np.concatenate([np.arange(10) / 30, 10 / 30 + np.arange(8) / 12])


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path, Tensor]:
    """A video that slows from 30 frames a second to 12, its landmarks, a rig's file, and how far its jaw opens."""
    folder = tmp_path_factory.mktemp("uneven")
    rig = performer()
    save_rig(rig, folder / "rig.glb")
    weights = torch.zeros(len(TIMES), len(rig.names))
    weights[:, rig.names.index("jawOpen")] = 0.8 * torch.from_numpy(TIMES).float()
    camera = look_at(rig.vertices[rig.neutral.landmarks].double().mean(0), 0.0, 0.0, 600.0, WIDTH, HEIGHT)
    K = assumed_calibration(WIDTH, HEIGHT).intrinsics
    points = rig(weights)[:, rig.neutral.landmarks].double() @ camera.rotation.T + camera.translation
    pixels = points[..., :2] / points[..., 2:] * K.diagonal()[:2] + K[:2, 2]
    save_landmarks_csv(Take(25.0, landmarks=Track(tuple(map(str, range(68))), pixels.float())), folder / "marks.csv")
    film = encode(folder / "film.mp4", "libx264", len(TIMES), (WIDTH, HEIGHT), times=list(TIMES))
    return film, folder / "marks.csv", folder / "rig.glb", weights[:, rig.names.index("jawOpen")]


@pytest.mark.parametrize("dynamics", [None, "dynamics_prior"])
def test_weights_are_written_at_the_frames_own_times(
    filmed: tuple[Path, Path, Path, Tensor], dynamics: str | None, tmp_path: Path
) -> None:
    film, marks, rig, jaw = filmed
    settings = TrackSettings(landmarks=marks, dynamics=dynamics, overlay="none")
    with pytest.warns(UserWarning, match=r"film.mp4: found a variable frame rate: .* solved at the frames' own times"):
        tracked = track_video(film, rig, tmp_path, settings)
    assert tracked.video.fps == pytest.approx(17 / TIMES[-1], rel=1e-3)
    assert any(line.startswith("variable frame rate: frames last") for line in tracked.lines())
    for name, column in (("weights.csv", "time"), ("confidence.csv", "time"), ("landmarks.csv", "timestamp")):
        with (tmp_path / name).open() as file:
            rows = list(csv.DictReader(file))
        np.testing.assert_allclose([float(row[column]) for row in rows], TIMES, atol=1e-4)
    read_back = read_gltf_weights(tmp_path / "animation.glb")
    np.testing.assert_allclose(read_back.seconds.numpy(), TIMES, atol=1e-4)
    with (tmp_path / "live_link.csv").open() as file:
        codes = [row["Timecode"] for row in csv.DictReader(file)]
    read = [float(code[6:8]) + float(code[9:]) / 60 for code in codes]  # frames of uneven takes are sixtieths
    np.testing.assert_allclose(read, TIMES, atol=1e-4)
    np.testing.assert_allclose(load_take(tmp_path / "live_link.csv").times.numpy(), TIMES, atol=1e-4)
    found = tracked.solution.weights[:, load_rig(rig).names.index("jawOpen")]
    # Offsets and prior keep a part of an opening in so short a take; its course in time is the jaw's.
    assert float(torch.corrcoef(torch.stack([found, jaw]))[0, 1]) > 0.97


def test_other_readers_still_refuse_it(filmed: tuple[Path, Path, Path, Tensor]) -> None:
    video = open_video(filmed[0])
    with pytest.raises(FileFormatError, match="variable frame rate"):
        next(video.frames())
    assert len(list(replace(video, even=False).frames())) == len(TIMES)
    times, varies = video.uneven_seconds()
    np.testing.assert_allclose(times.numpy(), TIMES, atol=1e-4)
    assert "ms as a rule" in varies
