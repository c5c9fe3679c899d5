"""Camera calibrations as TOML."""

from __future__ import annotations

from pathlib import Path

import torch

from torchface.errors import FileFormatError, TorchfaceError
from torchface.files.documents import read_toml, write_toml
from torchface.geometry.cameras.calibration import CameraCalibration

_FORMAT = "torchface.camera/1"
_MAX_BYTES = 2**16
_MAX_SIDE = 2**16  # pixels
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


def save_calibration(calibration: CameraCalibration, path: str | Path) -> None:
    """Writes a calibration; the file appears only when it is complete.

    Raises:
        FileFormatError: the folder is missing or cannot be written to.

    Example:
        >>> K = torch.tensor([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]])
        >>> save_calibration(CameraCalibration(K, torch.zeros(5), 640, 480, error=0.2), "camera.toml")
        >>> load_calibration("camera.toml").error
        0.2
    """
    K = calibration.intrinsics.tolist()
    document: dict[str, object] = {
        "format": _FORMAT,
        "width": calibration.width,
        "height": calibration.height,
        "focal": [K[0][0], K[1][1]],
        "skew": K[0][1],
        "center": [K[0][2], K[1][2]],
        "distortion": dict(zip(_COEFFICIENTS, calibration.distortion.tolist(), strict=True)),
        "error": calibration.error,
    }
    write_toml(path, document)


def load_calibration(path: str | Path) -> CameraCalibration:
    """Reads what :func:`save_calibration` wrote; all lengths are pixels, their centres at integers.

    Raises:
        FileFormatError: the file is missing, too large, no TOML, or a field is missing, of another kind, or absurd.

    Example:
        >>> K = torch.tensor([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]], dtype=torch.float64)
        >>> save_calibration(CameraCalibration(K, torch.zeros(5, dtype=torch.float64), 640, 480), "camera.toml")
        >>> load_calibration("camera.toml").intrinsics[0].tolist()
        [900.0, 0.0, 319.5]
    """
    document = read_toml(path, _FORMAT, _MAX_BYTES)
    width, height = (document[side].whole(1, _MAX_SIDE, f"1 to {_MAX_SIDE} pixels") for side in ("width", "height"))
    focal, center = (document[name].tensor(2, expected="two numbers, pixels").tolist() for name in ("focal", "center"))
    skew, error = document["skew"].number() if document["skew"] else 0.0, document["error"]
    table = document["distortion"].table(*_COEFFICIENTS) if document["distortion"] else {}
    distortion = [table[name].number() if name in table else 0.0 for name in _COEFFICIENTS]
    measured = error.number() if error else None
    intrinsics = torch.tensor([[focal[0], skew, center[0]], [0, focal[1], center[1]], [0, 0, 1]], dtype=torch.float64)
    try:
        return CameraCalibration(intrinsics, torch.tensor(distortion, dtype=torch.float64), width, height, measured)
    except TorchfaceError as wrong:
        raise FileFormatError(f"{path}: {wrong}") from wrong
