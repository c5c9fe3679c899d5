"""Landmarks of other programs' tables come back where they were, frame by frame."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.landmarks.landmark_tables import load_landmark_table
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.take import Take, Track

POINTS = (100 + 50 * torch.rand(4, 68, 2, generator=torch.Generator().manual_seed(0))).round(decimals=3)


def table(path: Path, header: list[str], rows: list[list[object]]) -> Path:
    path.write_text("\n".join(", ".join(str(cell) for cell in row) for row in [header, *rows]) + "\n")
    return path


def coordinates(points: Tensor) -> list[float]:
    return [round(float(value), 6) for value in points.T.flatten()]


def names(count: int, under: str = "_") -> list[str]:
    return [f"{axis}{under}{i}" for axis in "xy" for i in range(count)]


def test_our_own_comes_back_with_confidence_and_visibility(tmp_path: Path) -> None:
    confidence, visibility = torch.rand(4, 68), torch.rand(4, 68)
    columns = {f"confidence_{i}": confidence[:, i] for i in range(68)}
    columns |= {f"visibility_{i}": visibility[:, i] for i in range(68)} | {"presence": torch.tensor([1, 0.5, 0.9, 0])}
    points = POINTS.clone()
    points[2] = torch.nan
    track = Track(tuple(str(i) for i in range(68)), points, confidence)
    save_landmarks_csv(Take(25.0, landmarks=track, extras={"columns": columns}), tmp_path / "take.csv")
    found = load_landmark_table(tmp_path / "take.csv")
    torch.testing.assert_close(found.points, points, equal_nan=True)
    for one, other in ((found.confidence, confidence), (found.visibility, visibility)):
        torch.testing.assert_close(one[[0, 1, 3]], other[[0, 1, 3]])
        assert (one[2] == 0).all()
    assert found.presence.tolist() == [1, 0.5, 0, 0]
    assert found.fps == 25.0
    assert not found.shares


def test_openface_py_feat_and_mediapipe_are_read(tmp_path: Path) -> None:
    openface = table(
        tmp_path / "openface.csv",
        ["frame", "timestamp", "confidence", "success", "gaze_0_x", *names(68), *(f"X_{i}" for i in range(68))],
        [
            [t + 1, t / 30, 0.75, int(t != 1), -1, *coordinates(one), *[float(t)] * 68]
            for t, one in enumerate(POINTS)
            if t != 2
        ],
    )
    found = load_landmark_table(openface)
    assert found.points.isnan().all(2).all(1).tolist() == [False, True, True, False]  # unsuccessful, and left out
    torch.testing.assert_close(found.points[[0, 3]], POINTS[[0, 3]])
    assert found.confidence[:, 5].tolist() == [0.75, 0, 0, 0.75]
    assert found.fps == pytest.approx(30, rel=1e-3)
    feat = table(
        tmp_path / "feat.csv",
        ["", "FaceRectX", "FaceScore", *names(68), "emotion", "input", "frame", "approx_time"],
        [[t, 5.5, 0.99, *coordinates(one), "joy", "a film.mp4", t, f"00:0{t}"] for t, one in enumerate(POINTS)],
    )
    found = load_landmark_table(feat)
    torch.testing.assert_close(found.points, POINTS)
    assert found.confidence.unique().tolist() == [pytest.approx(0.99)]
    assert found.fps is None
    mesh = torch.rand(2, 478, 2, generator=torch.Generator().manual_seed(1))
    found = load_landmark_table(table(tmp_path / "mesh.csv", names(478, ""), [list(coordinates(one)) for one in mesh]))
    assert found.shares
    torch.testing.assert_close(found.pixels(640, 480), mesh * torch.tensor([640.0, 480.0]) - 0.5, atol=1e-3, rtol=0)


def test_other_tables_are_told(tmp_path: Path) -> None:
    good = coordinates(POINTS[0])
    cases: list[tuple[list[str], list[list[object]], str]] = [
        (names(5), [[*good[:10]]], "x and y of 5 points, expected .* of 68 landmarks, or of 468 or 478"),
        (["frame", "smile"], [[1, 2]], "the columns 'frame', 'smile', expected x_0"),
        ([*names(68), "x0"], [[*good, 1]], "the columns 'x_0', 'x0', expected one"),
        (["frame", *names(68)], [[0, *good], [0, *good]], "several rows of frame 0, expected one: keep those of one"),
        (["frame", *names(68)], [[3, *good], [2, *good]], "frame 2 after frame 3"),
        (["frame", *names(68)], [[1, *good], [9999999, *good]], "frame 9999999 in 2 rows"),
        (["confidence", *names(68)], [[7, *good]], "confidence from 7 to 7, expected 0 to 1"),
        (names(68), [["left", *good[1:]]], "column 'x_0': found ' ?left', expected a number"),
        (names(68), [], "a header and no rows"),
    ]
    for header, rows, message in cases:
        with pytest.raises(FileFormatError, match=message):
            load_landmark_table(table(tmp_path / "bad.csv", header, rows))


@pytest.mark.real
def test_openface_of_a_real_face(data: Path) -> None:
    found = load_landmark_table(data / "landmarks" / "openface_100_frames.csv")
    assert found.points.shape == (100, 68, 2)
    assert torch.isfinite(found.points).all()
    assert float(found.points[0, 0, 0]) == pytest.approx(277.276)
