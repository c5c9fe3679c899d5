"""What ``torchface info`` says of a take's markers: their extent in millimetres, and the file's unit."""

from pathlib import Path

import torch

from torchface import Take, Track, save_take
from torchface.workflows.describe_file import describe


def test_the_extent_of_markers_is_in_millimetres_and_knows_no_outlier(tmp_path: Path) -> None:
    corners = torch.tensor([[10.0, 5.0, 2.0], [90.0, 125.0, 32.0], [50.0, 60.0, 12.0]])
    values = corners.expand(30, 3, 3).clone()
    values[4, 1] = 5000.0
    values[7:9, 0] = torch.nan
    save_take(Take(60.0, markers=Track(("a", "b", "c"), values)), tmp_path / "take.c3d")
    rows = dict(describe(tmp_path / "take.c3d", None, None))
    assert rows["extent, mm"] == "80.0 x 120.0 x 30.0, of each marker's median place"
    assert "unit mm" in rows["kept besides"]
