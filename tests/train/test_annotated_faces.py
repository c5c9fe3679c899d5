"""Annotated photographs of a folder, whatever kind of picture they are."""

from pathlib import Path

import pytest
import torch

from torchface.errors import FileFormatError
from torchface.io.landmarks.landmark_points import save_pts
from train.annotated_faces import annotated_landmarks


@pytest.mark.parametrize("ending", ["ppm", "pgm", "png"])
def test_a_photograph_stands_beside_its_landmarks(tmp_path: Path, ending: str) -> None:
    points = torch.arange(136).view(68, 2).double()
    save_pts(points, tmp_path / "face.pts")
    with pytest.raises(FileFormatError, match=r"face\.pts: found no image of the same name.*\.ppm"):
        annotated_landmarks(tmp_path)
    (tmp_path / f"face.{ending}").touch()
    ((picture, found),) = annotated_landmarks(tmp_path)
    assert picture == tmp_path / f"face.{ending}"
    torch.testing.assert_close(found, points)
