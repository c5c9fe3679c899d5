"""Landmark CSV in OpenFace's layout: a real file, round trips, broken files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from mutation import check_reader
from take_strategies import check_refused, same

from torchface import Take, Track, load_take, save_take
from torchface.io.landmarks.openface_csv import load_landmarks_csv, save_landmarks_csv

_GOOD = """frame, timestamp, confidence, success, x_0, x_1, y_0, y_1, X_0, AU01_r
1, 0, 0.9, 1, 10, 11, 20, 21, 5, 0.5
2, 0.033, 0.8, 1, 12, 13, 22, 23, 6, 0.25
3, 0.067, 0.1, 0, 0, 0, 0, 0, 7, 0
4, 0.1, 0.9, 1, 14, 15, 24, 25, 8, 0
"""


@pytest.mark.real
def test_a_real_file_agrees_with_numpy_and_comes_back(data: Path, tmp_path: Path) -> None:
    path = data / "landmarks" / "openface_100_frames.csv"
    table = np.genfromtxt(path, delimiter=",", skip_header=1, dtype=np.float64)
    header = [name.strip() for name in path.read_text().splitlines()[0].split(",")]
    take = load_take(path)
    assert take.landmarks.names == tuple(map(str, range(68)))
    x, y = header.index("x_0"), header.index("y_0")
    expected = np.stack([table[:, x : x + 68], table[:, y : y + 68]], -1).astype(np.float32)
    np.testing.assert_array_equal(take.landmarks.values.numpy(), expected)
    np.testing.assert_array_equal(take.extras["columns"]["pose_Tz"].numpy(), table[:, header.index("pose_Tz")])
    save_take(take, tmp_path / "take.csv")
    again = load_take(tmp_path / "take.csv")
    assert same(again.landmarks.values, take.landmarks.values)
    assert same(again.landmarks.confidence, take.landmarks.confidence)
    assert again.fps == take.fps
    assert list(again.extras["columns"]) == list(take.extras["columns"])
    assert all(same(column, take.extras["columns"][name]) for name, column in again.extras["columns"].items())


def test_a_lost_face_is_nan_and_times_to_the_millisecond_tell_the_rate(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(_GOOD)
    take = load_landmarks_csv(tmp_path / "take.csv")
    assert take.fps == 30
    assert take.landmarks.values[0].tolist() == [[10, 20], [11, 21]]
    assert take.landmarks.values.isnan().all((1, 2)).tolist() == [False, False, True, False]
    assert take.extras["columns"]["X_0"].tolist() == [5, 6, 7, 8]
    torch.testing.assert_close(take.landmarks.confidence[:, 1], torch.tensor([0.9, 0.8, 0.1, 0.9]))


def test_landmarks_with_gaps_and_any_names_come_back(tmp_path: Path) -> None:
    values = torch.randn(6, 3, 2, generator=torch.Generator().manual_seed(0)) * 100
    values[2, 1] = values[4] = torch.nan
    take = Take(60000 / 1001, landmarks=Track(("nose", "x_y", "Ø"), values))
    save_landmarks_csv(take, tmp_path / "take.csv")
    back = load_landmarks_csv(tmp_path / "take.csv")
    assert back.landmarks.names == ("nose", "x_y", "Ø")
    assert same(back.landmarks.values, values)
    assert back.fps == take.fps


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" y_1", " q_1", r"found no column 'y_1', expected it in the header"),
        (" x_1", " q_1", r"found the columns 'y_1', expected x_ and y_"),
        ("frame,", "image,", r"found no column 'frame'"),
        (" 13,", " thirteen,", r"row 3, column 'x_1': found ' thirteen', expected a number"),
        ("\n2,", "\n1,", r"found frame 1 after frame 1"),
    ],
)
def test_a_broken_file_is_refused_by_name(old: str, new: str, message: str, tmp_path: Path) -> None:
    check_refused(load_landmarks_csv, tmp_path / "broken.csv", _GOOD, (old, new), message)


def test_a_mutated_landmark_csv_is_read_or_refused(tmp_path: Path) -> None:
    (tmp_path / "good.csv").write_text(_GOOD)
    check_reader(load_landmarks_csv, [tmp_path / "good.csv"], ".csv")
