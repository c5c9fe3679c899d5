"""OpenFace's intensities of action units are weights from 0 to 1."""

from pathlib import Path

import pytest
import torch

from torchface import load_take

_AUS = "frame, face_id, timestamp, confidence, success, AU01_r, AU12_r, AU12_c, AU28_c\n"


def test_intensities_are_a_fifth_and_frames_without_a_face_are_missing(tmp_path: Path) -> None:
    rows = [
        "1, 0, 0.000, 0.9, 1, 0.00, 5.00, 1, 1",
        "2, 0, 0.040, 0.9, 1, 2.50, 1.00, 1, 0",
        "3, 0, 0.080, 0, 0, 1, 1, 1, 0",
    ]
    (tmp_path / "units.csv").write_text(_AUS + "\n".join(rows) + "\n")
    take = load_take(tmp_path / "units.csv")
    assert take.weights.names == ("AU01_r", "AU12_r")
    assert take.fps == 25
    expected = torch.tensor([[0.0, 1.0], [0.5, 0.2], [torch.nan, torch.nan]])
    torch.testing.assert_close(take.weights.values[..., 0], expected, equal_nan=True)


def test_a_plain_table_of_action_units_to_five_is_taken_for_intensities(tmp_path: Path) -> None:
    (tmp_path / "five.csv").write_text("frame,time,AU01,AU12\n0,0.0,0,4\n1,0.04,1,2\n")
    with pytest.warns(UserWarning, match="action units up to 4, expected 0 to 1; they are taken for intensities"):
        take = load_take(tmp_path / "five.csv")
    assert take.weights.values[:, 1, 0].tolist() == pytest.approx([0.8, 0.4])
    (tmp_path / "one.csv").write_text("frame,time,AU01,AU12\n0,0.0,0,0.8\n1,0.04,1,0.4\n")
    assert load_take(tmp_path / "one.csv").weights.values[:, 1, 0].tolist() == pytest.approx([0.8, 0.4])


@pytest.mark.parametrize("most", [1.0000001, 1.02, 1.4])
def test_weights_of_action_units_that_overshoot_one_stay(most: float, tmp_path: Path) -> None:
    (tmp_path / "over.csv").write_text(f"frame,time,AU01,AU12\n0,0.0,0,0.5\n1,0.04,1,{most}\n")
    assert load_take(tmp_path / "over.csv").weights.values[:, 1, 0].tolist() == pytest.approx([0.5, most])


def test_names_of_intensities_are_intensities_from_one_on(tmp_path: Path) -> None:
    (tmp_path / "quiet.csv").write_text("frame,time,AU01_r,AU12_r\n0,0.0,0,0.5\n1,0.04,1,1.4\n")
    with pytest.warns(UserWarning, match="action units up to 1.4, expected 0 to 1; they are taken for intensities"):
        take = load_take(tmp_path / "quiet.csv")
    assert take.weights.values[:, 1, 0].tolist() == pytest.approx([0.1, 0.28])
