"""Calibrations come back from their files; broken files are refused by name."""

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import FileFormatError
from torchface.geometry.cameras.calibration import CameraCalibration, assumed_calibration
from torchface.io import load_calibration, save_calibration


def camera() -> CameraCalibration:
    K = torch.tensor([[912.3456789012345, 0.25, 651.5], [0, 905.1, 349.25], [0, 0, 1]], dtype=torch.float64)
    return CameraCalibration(K, torch.tensor([-0.28, 0.09, 1e-7, -0.0007, -0.01]).double(), 1280, 720, 0.173)


@pytest.mark.parametrize("kept", [camera(), assumed_calibration(640, 480), replace(camera(), guessed=True)])
def test_there_and_back(kept: CameraCalibration, tmp_path: Path) -> None:
    save_calibration(kept, tmp_path / "camera.toml")
    found = load_calibration(tmp_path / "camera.toml")
    assert torch.equal(found.intrinsics, kept.intrinsics)
    assert torch.equal(found.distortion, kept.distortion)
    assert (found.width, found.height, found.error) == (kept.width, kept.height, kept.error)
    assert (found.guessed, "guessed" in (tmp_path / "camera.toml").read_text()) == (kept.guessed,) * 2
    assert [path.name for path in tmp_path.iterdir()] == ["camera.toml"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("width = 1280", "width = 0", "width = 0, expected 1 to 65536"),
        ("width = 1280", "width = 1280.5", "width = 1280.5"),
        ("width = 1280", "width = true", "width = True"),
        ("width = 1280", "height2 = 1", "width = None"),
        ("skew = 0.25", "skew = nan", "skew = nan, expected a finite number"),
        ("0.173", "-1.0", "expected pixels from 0"),
        ("0.173", "inf", "error = inf"),
        ("912.3456789012345", "-912.0", "positive focal lengths"),
        ("912.3456789012345", '"long"', r"focal = \['long', "),
        ("651.5,", "651.5, 3.0,", "center = .*expected two numbers"),
        ("k3 =", "k4 =", "distortion.k4 = .*expected only k1, k2, p1, p2, k3"),
        ("skew =", 'model = "fisheye"\nskew =', "model = 'fisheye', expected only format, width, height, focal"),
        ("skew =", "guessed = 1\nskew =", "guessed = 1, expected true or false"),
        ("[distortion]", "[distorsion]", "distorsion = .*expected only"),
        ("torchface.camera/1", "torchface.camera/2", "found format 'torchface.camera/2'"),
        ("[distortion]", "[distortion", "not TOML"),
    ],
)
def test_broken_files_are_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    save_calibration(camera(), path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(FileFormatError, match=message):
        load_calibration(path)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        load_calibration(tmp_path / "absent.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * (2**16 + 1))
    with pytest.raises(FileFormatError, match="at most 65536"):
        load_calibration(tmp_path / "large.toml")
    (tmp_path / "deep.toml").write_text("format = " + "[" * 30000)
    with pytest.raises(FileFormatError, match="not TOML"):
        load_calibration(tmp_path / "deep.toml")


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=4))
def test_damaged_files_are_an_error_or_a_calibration(
    tmp_path_factory: pytest.TempPathFactory, damage: list[tuple[int, int]]
) -> None:
    path = tmp_path_factory.mktemp("cameras") / "camera.toml"
    save_calibration(camera(), path)
    whole = bytearray(path.read_bytes())
    for place, value in damage:
        whole[place % len(whole)] = value
    path.write_bytes(bytes(whole))
    with contextlib.suppress(FileFormatError):
        found = load_calibration(path)
        assert torch.isfinite(found.intrinsics).all()
        assert torch.isfinite(found.distortion).all()
