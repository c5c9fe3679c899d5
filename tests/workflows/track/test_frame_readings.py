"""A table of landmarks is solved without a video; one that cannot be the video's is told."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import load_rig, load_take, save_rig
from torchface.cli import main
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.io import load_animation
from torchface.io.landmarks.landmark_tables import load_landmark_table
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.io.video import write_video
from torchface.synthetic.head.performer import performer
from torchface.take import Take, Track
from torchface.workflows.named_finders import load_finder
from torchface.workflows.track.frame_readings import given_reading
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_video import track_video

COUNT, WIDTH, HEIGHT = 6, 320, 240


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Tensor]:
    """A rig's file, a table of its landmarks as it opens the jaw, and how far."""
    folder = tmp_path_factory.mktemp("take")
    rig = performer()
    save_rig(rig, folder / "rig.glb")
    weights = torch.zeros(COUNT, len(rig.names))
    weights[:, rig.names.index("jawOpen")] = torch.linspace(0, 0.8, COUNT)
    camera = look_at(rig.vertices[rig.neutral.landmarks].double().mean(0), 0.0, 0.0, 600.0, WIDTH, HEIGHT)
    focal = assumed_calibration(WIDTH, HEIGHT).intrinsics
    rotation, moved = camera.rotation, camera.translation
    points = rig(weights)[:, rig.neutral.landmarks].double() @ rotation.T + moved
    pixels = points[..., :2] / points[..., 2:] * focal.diagonal()[:2] + focal[:2, 2]
    names = tuple(str(i) for i in range(68))
    save_landmarks_csv(Take(25.0, landmarks=Track(names, pixels.float())), folder / "take.csv")
    return folder / "rig.glb", folder / "take.csv", weights[:, rig.names.index("jawOpen")]


def test_a_table_is_solved_without_a_video(take: tuple[Path, Path, Tensor], tmp_path: Path) -> None:
    rig, table, jaw = take
    settings = TrackSettings(landmarks=table, size=(WIDTH, HEIGHT))
    tracked = track_video(None, rig, tmp_path / "out", settings)
    found = tracked.solution.weights[:, load_rig(rig).names.index("jawOpen")]
    assert float((found - jaw).abs().max()) < 0.18
    assert tracked.video.fps == 25.0
    assert set(tracked.products) == {"weights", "confidence", "live link", "landmarks", "animation"}  # no overlay
    again = load_landmark_table(tmp_path / "out" / "landmarks.csv")
    torch.testing.assert_close(again.points, load_landmark_table(table).points)
    assert (again.presence == 1).all()
    few = track_video(None, rig, tmp_path / "few", replace(settings, reduce=0.2))
    assert next(line for line in few.lines() if "of 6 keys" in line).startswith("weights.csv: ")
    keys = load_take(tmp_path / "few" / "weights.csv")
    assert len(keys) == len(load_animation(tmp_path / "few" / "animation.glb")) < COUNT
    assert len(load_take(tmp_path / "few" / "confidence.csv")) == COUNT


@pytest.mark.parametrize(
    ("shown", "confidence", "message"),
    [(5, "1", "at most 4 that are trusted in any of 6 frames"), (68, "0", "at most 0 that are trusted")],
)
def test_a_table_without_enough_landmarks_is_refused_by_its_name(
    take: tuple[Path, Path, Tensor], tmp_path: Path, shown: int, confidence: str, message: str
) -> None:
    """Of a frame's landmarks too few are there, or none is trusted."""
    header, *rows = (line.split(",") for line in take[1].read_text().splitlines())
    for row in rows:
        for i, name in enumerate(header):
            number = name[2:]
            if name[:2] in ("x_", "y_") and number.isdigit() and int(number) >= shown:
                row[i] = ""
        row[header.index("confidence")] = confidence
    table = tmp_path / "few.csv"
    table.write_text("\n".join(",".join(row) for row in [header, *rows]))
    settings = TrackSettings(landmarks=table, size=(WIDTH, HEIGHT))
    with pytest.raises(ValueRangeError, match=rf"few.csv: landmarks: found {message}.* expected at least 6 in some"):
        track_video(None, take[0], tmp_path / "out", settings)


def test_a_wild_landmark_is_left_out_and_named(take: tuple[Path, Path, Tensor], tmp_path: Path) -> None:
    """20,000 pixels in one frame of one landmark change no other frame, and no other landmark's weights."""
    rig, table, _ = take
    header, *rows = (line.split(",") for line in table.read_text().splitlines())
    rows[3][[name.strip() for name in header].index("x_33")] = "20000"
    (tmp_path / "wild.csv").write_text("\n".join(",".join(row) for row in [header, *rows]))
    settings = TrackSettings(landmarks=table, size=(WIDTH, HEIGHT))
    clean = track_video(None, rig, tmp_path / "clean", settings)
    wild = track_video(None, rig, tmp_path / "out", replace(settings, landmarks=tmp_path / "wild.csv"))
    assert float((wild.solution.weights - clean.solution.weights).abs().max()) < 0.02
    assert "1 landmarks in 1 frames lie where no face has them" in "\n".join(wild.lines())
    assert "landmark 33 of frame 3" in "\n".join(wild.lines())
    assert not clean.outlier_lines()
    assert abs(wild.jitter - clean.jitter) < 0.1
    confidence = load_landmark_table(tmp_path / "out" / "landmarks.csv").confidence
    assert (confidence == 0).nonzero().tolist() == [[3, 33]]


def test_tables_that_do_not_fit_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.glb").touch()
    table = tmp_path / "take.csv"
    points = 100 + 100 * torch.rand(COUNT, 68, 2, generator=torch.Generator().manual_seed(0))
    header = ",".join(f"{axis}_{i}" for axis in "xy" for i in range(68))
    table.write_text("\n".join([header, *(",".join(map(str, one.T.flatten().tolist())) for one in points)]))
    wall = torch.full((3, HEIGHT, WIDTH), 99, dtype=torch.uint8)
    film = write_video([wall], tmp_path / "wall.avi", 25.0)
    with pytest.raises(ValueRangeError, match=rf"take.csv: found landmarks of {COUNT} frames, expected the 4 of wall"):
        given_reading(table, replace(film, count=4))
    with pytest.raises(ValueRangeError, match=r"in the 100 x 80 pixels of wall.avi: .* of another size"):
        given_reading(table, replace(film, count=COUNT, width=100, height=80))
    with pytest.raises(NameMismatchError, match="a table of landmarks, expected what finds them"):
        load_finder(table)
    for words, message in (
        (["--landmarks", str(table)], "found no times, expected --fps RATE"),
        (["--landmarks", str(table), "--fps", "30"], "found no video, expected --size WIDTHxHEIGHT"),
        (["--landmarks", str(table), "--size", "wide"], "--size: found 'wide', expected WIDTHxHEIGHT"),
        (["--landmarks", str(table), "--size", "9x9", "--fps", "0.1"], "0.1 frames a second, expected 1 to 1000"),
        ([str(tmp_path / "wall.avi"), "--fps", "30"], "found --fps or --size beside a video"),
        ([], "found no VIDEO, expected one"),
    ):
        with pytest.raises(SystemExit):
            main(["track", *words, "--rig", str(tmp_path / "rig.glb"), "--out", str(tmp_path / "out")])
        assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out" / "weights.csv").exists()
