"""Camera calibrations as TOML."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import tomli_w
import torch

from torchface.errors import FileFormatError, TorchfaceError
from torchface.files.whole_files import read_file, write_file
from torchface.geometry.cameras.calibration import CameraCalibration

_FORMAT = "torchface.camera/1"
_LARGEST_FILE = 2**16
_LARGEST_SIDE = 2**16
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


def save_calibration(calibration: CameraCalibration, path: str | Path) -> None:
    """Writes a calibration; the file appears only when it is complete.

    Raises:
        FileFormatError: the folder is missing or cannot be written to.
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
    }
    if calibration.error is not None:
        document["error"] = calibration.error
    write_file(path, tomli_w.dumps(document).encode())


def load_calibration(path: str | Path) -> CameraCalibration:
    """Reads what :func:`save_calibration` wrote; all lengths are pixels, their centres at integers.

    Raises:
        FileFormatError: the file is missing, too large, no TOML, or a field is missing, of another kind, or absurd.
    """
    try:
        document = tomllib.loads(read_file(path, _LARGEST_FILE).decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise FileFormatError(f"{path}: not TOML ({error})") from error
    if document.get("format") != _FORMAT:
        raise FileFormatError(f'{path}: found no format = "{_FORMAT}", expected it')
    width, height = _side(document.get("width"), "width", path), _side(document.get("height"), "height", path)
    focal, center = _pair(document.get("focal"), "focal", path), _pair(document.get("center"), "center", path)
    skew = _number(document.get("skew", 0.0), "skew", path)
    table = document.get("distortion", {})
    if not isinstance(table, dict) or not set(table) <= set(_COEFFICIENTS):
        raise FileFormatError(f"{path}: found no table of {', '.join(_COEFFICIENTS)} under 'distortion', expected one")
    distortion = [_number(table.get(name, 0.0), name, path) for name in _COEFFICIENTS]
    measured = None if "error" not in document else _number(document["error"], "error", path)
    intrinsics = torch.tensor([[focal[0], skew, center[0]], [0, focal[1], center[1]], [0, 0, 1]], dtype=torch.float64)
    try:
        return CameraCalibration(intrinsics, torch.tensor(distortion, dtype=torch.float64), width, height, measured)
    except TorchfaceError as wrong:
        raise FileFormatError(f"{path}: {wrong}") from wrong


def _side(value: object, name: str, path: str | Path) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _LARGEST_SIDE:
        raise FileFormatError(f"{path}: found {name} = {value!r}, expected 1 to {_LARGEST_SIDE} pixels")
    return value


def _pair(value: object, name: str, path: str | Path) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise FileFormatError(f"{path}: found {name} = {value!r}, expected two numbers, pixels")
    return _number(value[0], name, path), _number(value[1], name, path)


def _number(value: object, name: str, path: str | Path) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9 or math.isnan(value):
        raise FileFormatError(f"{path}: found {name} = {value!r}, expected a finite number")
    return float(value)
