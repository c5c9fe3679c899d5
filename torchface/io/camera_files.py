"""Calibrations of a camera, and of several that are fixed to each other, as TOML."""

from collections.abc import Sequence
from pathlib import Path

import torch

from torchface.errors import FileFormatError, TorchfaceError
from torchface.files.documents import Value, read_toml, write_toml
from torchface.geometry.cameras.calibration import CameraCalibration, PlacedCamera

_FORMAT, _CAMERAS = "torchface.camera/1", "torchface.cameras/1"
_MAX_BYTES = 2**16
_MAX_SIDE = 2**16  # pixels
_MAX_CAMERAS = 16
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
_FIELDS = ("format", "width", "height", "focal", "skew", "center", "distortion", "error", "guessed")
_PLACE = ("name", "offset", "rotation", "translation")


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
    write_toml(path, {"format": _FORMAT, **_fields(calibration)})


def save_cameras(cameras: Sequence[PlacedCamera], path: str | Path) -> None:
    """Writes cameras that are fixed to each other, the first one first; the file appears only when it is complete.

    Example:
        >>> one = CameraCalibration(torch.eye(3).double(), torch.zeros(5).double(), 640, 480, error=0.2)
        >>> right = PlacedCamera(one, torch.eye(3).double(), torch.tensor([-60.0, 0, 0]).double(), "right", 0.04)
        >>> save_cameras([PlacedCamera(one, torch.eye(3), torch.zeros(3), "left"), right], "rig.toml")
        >>> load_cameras("rig.toml")[1].translation.tolist()
        [-60.0, 0.0, 0.0]
    """
    rows = [
        {
            "name": camera.name,
            **({} if camera.offset is None else {"offset": camera.offset}),
            "rotation": camera.rotation.tolist(),
            "translation": camera.translation.tolist(),
            **_fields(camera.calibration),
        }
        for camera in cameras
    ]
    write_toml(path, {"format": _CAMERAS, "cameras": rows})


def load_cameras(path: str | Path) -> tuple[PlacedCamera, ...]:
    """Reads what :func:`save_cameras` wrote; the first camera is where poses are measured from.

    Raises:
        FileFormatError: as of :func:`load_calibration`; or the first camera is turned or moved against itself.

    Example:
        >>> one = CameraCalibration(torch.eye(3).double(), torch.zeros(5).double(), 640, 480)
        >>> save_cameras([PlacedCamera(one, torch.eye(3), torch.zeros(3), name) for name in ("a", "b")], "rig.toml")
        >>> [camera.name for camera in load_cameras("rig.toml")]
        ['a', 'b']
    """
    cameras = []
    for row in read_toml(path, _CAMERAS, _MAX_BYTES)["cameras"].rows(2, _MAX_CAMERAS, f"2 to {_MAX_CAMERAS} cameras"):
        place = row["rotation"].tensor(3, 3), row["translation"].tensor(3, expected="three numbers, millimetres")
        name, offset = row["name"].text(), row["offset"].number() if row["offset"] else None
        try:
            cameras.append(PlacedCamera(_calibration(row, path), *place, name, offset))
        except TorchfaceError as wrong:
            raise FileFormatError(f"{path}: {wrong}") from wrong
    first = cameras[0]
    if not torch.equal(first.rotation, torch.eye(3).double()) or bool(first.translation.any()):
        raise FileFormatError(f"{path}: found a first camera turned or moved, expected one at which the others are put")
    return tuple(cameras)


def _fields(calibration: CameraCalibration) -> dict[str, object]:
    K = calibration.intrinsics.tolist()
    return {
        "width": calibration.width,
        "height": calibration.height,
        "focal": [K[0][0], K[1][1]],
        "skew": K[0][1],
        "center": [K[0][2], K[1][2]],
        "distortion": dict(zip(_COEFFICIENTS, calibration.distortion.tolist(), strict=True)),
        "error": calibration.error,
        "guessed": calibration.guessed or None,
    }


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
    return _calibration(read_toml(path, _FORMAT, _MAX_BYTES), path)


def _calibration(document: Value, path: str | Path) -> CameraCalibration:
    width, height = (document[side].whole(1, _MAX_SIDE, f"1 to {_MAX_SIDE} pixels") for side in ("width", "height"))
    focal, center = (document[name].tensor(2, expected="two numbers, pixels").tolist() for name in ("focal", "center"))
    skew, error = document["skew"].number() if document["skew"] else 0.0, document["error"]
    table = document["distortion"].table(*_COEFFICIENTS) if document["distortion"] else {}
    distortion = [table[name].number() if name in table else 0.0 for name in _COEFFICIENTS]
    measured, guessed = error.number() if error else None, document["guessed"]
    if not isinstance(guessed.found, bool | None):
        raise guessed.error("true or false")
    document.table(*_FIELDS, *_PLACE)  # a model of another lens, or a name that is misspelt, would count for nothing
    intrinsics = torch.tensor([[focal[0], skew, center[0]], [0, focal[1], center[1]], [0, 0, 1]], dtype=torch.float64)
    try:
        return CameraCalibration(
            intrinsics, torch.tensor(distortion, dtype=torch.float64), width, height, measured, bool(guessed.found)
        )
    except TorchfaceError as wrong:
        raise FileFormatError(f"{path}: {wrong}") from wrong
