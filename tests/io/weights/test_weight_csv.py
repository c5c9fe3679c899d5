"""Weights CSV: round trips, broken files."""

from pathlib import Path

import pytest
import torch
from hypothesis import assume, given, settings
from mutation import check_reader
from take_strategies import check_refused, round_trip, same, weight_takes

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.weights.weight_csv import load_weights_csv, save_weights_csv
from torchface.take import Take, Track

_GOOD = "frame,time,jawOpen,smile_L\n10,1.0,0.25,\n11,1.1,1,-0.5\n13,1.3,0,1e-3\n"


@given(weight_takes())
@settings(max_examples=25)
def test_a_take_comes_back_to_the_bit(take: Take) -> None:
    header = ("frame", "time", *take.weights.names)
    assume(len(set(header)) == len(header) and not is_marker_header(header))
    assert round_trip(save_weights_csv, load_weights_csv, take).fps == take.fps


def test_numbers_rate_and_gaps_are_read(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(_GOOD)
    take = load_weights_csv(tmp_path / "take.csv")
    expected = torch.tensor([[0.25, torch.nan], [1, -0.5], [0, 1e-3]])[..., None]
    assert same(take.weights.values, expected)
    assert take.fps == 10
    assert take.extras["frame_numbers"].tolist() == [10, 11, 13]
    torch.testing.assert_close(take.seconds, torch.tensor([1.0, 1.1, 1.3], dtype=torch.float64))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("jawOpen,smile_L", "jawOpen,jawOpen", r"found more than one column 'jawOpen'"),
        (",jawOpen,smile_L", "", r"found 2 columns, expected frame,time,<shape>"),
        ("jawOpen", " ", r"found a column without a name"),
        ("0.25", "a quarter", r"row 2, column 'jawOpen': found 'a quarter', expected a number"),
        (",1,-0.5", ",1", r"row 3: found 3 cells, expected 4"),
        ("time", "hour", r"expected it to begin with frame,time"),
    ],
)
def test_a_broken_file_is_refused_by_name(old: str, new: str, message: str, tmp_path: Path) -> None:
    check_refused(load_weights_csv, tmp_path / "broken.csv", _GOOD, (old, new), r".*" + message)


def test_names_that_would_be_read_as_something_else_are_refused(tmp_path: Path) -> None:
    for names in (("a_x", "a_y", "a_z"), ("time",)):
        with pytest.raises(NameMismatchError, match=r"take\.csv: found shapes named like other columns"):
            save_weights_csv(Take(60.0, weights=Track(names, torch.zeros(2, len(names), 1))), tmp_path / "take.csv")
    with pytest.raises(ValueRangeError, match="without weights"):
        save_weights_csv(Take(60.0), tmp_path / "take.csv")


def test_a_mutated_weights_csv_is_read_or_refused(tmp_path: Path) -> None:
    (tmp_path / "good.csv").write_text(_GOOD)
    check_reader(load_weights_csv, [tmp_path / "good.csv"], ".csv")
