"""Takes in and out, by the file's suffix and header, in the usual units."""

import math
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.whole_files import check_ending, read_file
from torchface.io.landmarks.openface_csv import is_landmark_header, load_landmarks_csv, save_landmarks_csv
from torchface.io.markers.c3d import load_c3d, save_c3d
from torchface.io.markers.marker_csv import is_marker_header, load_markers_csv, save_markers_csv
from torchface.io.markers.trc import load_trc, save_trc
from torchface.io.protocols.live_link_recordings import load_live_link_packets
from torchface.io.tables.csv_table import MAX_TABLE_BYTES, TableReader, quoted
from torchface.io.tables.numbered_csv import is_numbered
from torchface.io.weights.action_unit_csv import LARGEST_INTENSITY, is_action_unit_header, load_action_units
from torchface.io.weights.face_cap_text import is_face_cap, load_face_cap
from torchface.io.weights.ifacialmocap_text import is_ifacialmocap, load_ifacialmocap
from torchface.io.weights.json_recordings import load_weight_json
from torchface.io.weights.live_link_csv import are_live_link_shapes, is_live_link, load_live_link, save_live_link
from torchface.io.weights.weight_csv import ROTATIONS, load_weights_csv, save_weights_csv
from torchface.number_checks import checked_path, checked_type
from torchface.shape_names import is_action_unit
from torchface.take import Take, Track

MARKER_ENDINGS = (".c3d", ".trc")
TAKE_ENDINGS = (*MARKER_ENDINGS, ".csv")
RECORDING_ENDINGS = (".txt", ".json", ".gesichter")
"""Of weights as phones and other programs record them, which are read alone."""

LARGEST_WEIGHT = 5.0  # nobody drives a shape so far; where a tenth of the frames do, weights are in percent
LARGEST_ANGLE = math.pi  # no rotation in radians is larger; where it is in a tenth of the frames, it is in degrees

_SHARE, _MOST_PERCENT, _MOST_DEGREES = 0.1, 200.0, 360.0
_LARGEST_OVERSHOOT = 1.5  # of an action unit from 0 to 1; one that is larger is an intensity


def load_take(path: str | Path, unit: str | None = None, fps: float | None = None) -> Take:
    r"""Reads a performance; the kind of a ``.csv`` follows from its header.

    ==================================== =====================================================
    ``.c3d``                             markers, :func:`torchface.io.markers.c3d.load_c3d`
    ``.trc``                             markers, :func:`torchface.io.markers.trc.load_trc`
    ``Timecode,BlendshapeCount,...``     weights, :func:`torchface.io.weights.live_link_csv.load_live_link`
    ``frame,time,<label>_x,...``         markers, :func:`torchface.io.markers.marker_csv.load_markers_csv`
    ``frame,time,<shape>,...``           weights, :func:`torchface.io.weights.weight_csv.load_weights_csv`
    ``frame,timestamp,...,x_0,...``      landmarks, :func:`torchface.io.landmarks.openface_csv.load_landmarks_csv`
    ``frame,timestamp,...,AU01_r,...``   intensities of action units as weights, 0 to 1 in place of 0 to 5
    ``.txt``                             weights of Face Cap (``k,...``) or iFacialMocap (``jawOpen-12|...``)
    ``.json``                            weights of Audio2Face, frames of ARKit's face anchors or of MediaPipe
    ``.gesichter``                       weights of Live Link Face's packets as they were sent
    ==================================== =====================================================

    A frame in which no marker was seen loads as NaN; :func:`torchface.take.empty_frames` finds it. Weights in percent,
    action units from 0 to 5 and rotations in degrees are converted, with a ``UserWarning``.

    Args:
        path: the file.
        unit: of its markers, ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``; else what the file says (CSV: millimetres).
        fps: frames a second of a ``.json`` that has neither times nor a rate.

    Raises:
        FileFormatError: the file is none of these, or is damaged.
        ValueRangeError: ``unit`` is unknown.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("take.csv").write_text("frame,time,jawOpen,mouthPucker\n0,0.0,0.25,0\n1,0.04,0.5,0\n")
        >>> take = load_take("take.csv")
        >>> take.fps, take.weights.names, take.weights.values[1].flatten().tolist()
        (25.0, ('jawOpen', 'mouthPucker'), [0.5, 0.0])
    """
    checked_path("path", path)
    check_ending(path, *TAKE_ENDINGS, *RECORDING_ENDINGS, hint="; torchface.io.load_animation reads .glb, .gltf, USD")
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        return load_c3d(path, unit)
    if suffix == ".trc":
        return load_trc(path, unit)
    if suffix == ".json":
        return in_usual_units(load_weight_json(path, fps), path)
    if suffix == ".gesichter":
        return load_live_link_packets(path)
    if suffix == ".txt":
        return in_usual_units(_load_text(path), path)
    header = TableReader(path).header
    if is_live_link(header):
        return in_usual_units(load_live_link(path), path)
    if is_marker_header(header):
        return load_markers_csv(path, unit)
    if is_numbered(header):
        return in_usual_units(load_weights_csv(path), path)
    if is_landmark_header(header):
        return load_landmarks_csv(path)
    if is_action_unit_header(header):
        return load_action_units(path)
    raise FileFormatError(
        f"{path}: found the columns {quoted(header)}; expected Timecode,BlendshapeCount,... or frame,time,... "
        "or OpenFace's frame,timestamp,... with x_0,... or AU01_r,..."
    )


def _load_text(path: Path) -> Take:
    first = read_file(path, MAX_TABLE_BYTES).lstrip().split(b"\n", 1)[0].decode(errors="replace")
    if is_face_cap(first):
        return load_face_cap(path)
    if is_ifacialmocap(first):
        return load_ifacialmocap(path)
    raise FileFormatError(
        f"{path}: found the line {first!r:.60}; expected Face Cap's info,... or bs,... or iFacialMocap's jawOpen-12|..."
    )


def save_take(take: Take, path: str | Path) -> None:
    """Writes a performance in the format that ``path`` ends in.

    ``.c3d`` and ``.trc`` hold the markers, a ``.csv`` the weights of a take that has some, else its markers or its
    landmarks; whatever else the take holds is left out. Weights whose names are ARKit's 52, in whatever order and case,
    become a Live Link Face file, from which they come back in its order and spelling (``EyeBlinkLeft``;
    ``torchface.shape_names.mapping`` leads back); others a plain table that keeps their names
    (:func:`torchface.io.weights.live_link_csv.save_live_link` maps them to ARKit's instead). A ``.csv`` of one frame
    holds no rate, and comes back at 60 a second.

    Args:
        take: markers in millimetres, landmarks in pixels, or weights.
        path: the file; it appears only when it is complete.

    Raises:
        FileFormatError: the ending is none of ``.c3d``, ``.trc``, ``.csv``.
        ValueRangeError: the take holds nothing for this format, markers and landmarks for one ``.csv``, or infinite
            numbers.
        NameMismatchError: a name of a plain table would not come back as it is.

    Example:
        >>> from torchface.take import Track
        >>> markers = Track(("chin", "nose"), torch.tensor([[[0.0, -60.0, 90.0], [0.0, 0.0, 110.0]]] * 2))
        >>> save_take(Take(120.0, markers=markers), "take.trc")
        >>> load_take("take.trc").markers.names
        ('chin', 'nose')
    """
    checked_type("take", take, Take)
    checked_path("path", path)
    check_ending(path, *TAKE_ENDINGS)
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        return save_c3d(take, path)
    if suffix == ".trc":
        return save_trc(take, path)
    if take.weights is not None:
        return save_live_link(take, path) if are_live_link_shapes(take.weights.names) else save_weights_csv(take, path)
    present = [name for name in ("markers", "landmarks") if getattr(take, name) is not None]
    if len(present) != 1:
        raise ValueRangeError(
            f"{path}: found a take of {' and '.join(present) or 'no track'}, expected one of them for a .csv; "
            "save_markers_csv and save_landmarks_csv each write theirs"
        )
    return save_markers_csv(take, path) if take.markers is not None else save_landmarks_csv(take, path)


def in_usual_units(take: Take, path: Path) -> Take:
    """The take with weights from 0 to 1 and rotations in radians; what is converted, a ``UserWarning`` says."""
    if take.weights is not None and all(map(is_action_unit, take.weights.names)):
        most = float(take.weights.values.nan_to_num(0.0).max()) if take.weights.values.numel() else 0.0
        # A name in _r is OpenFace's of an intensity; others may be weights that go a little beyond 1.
        usual = 1.0 if any(name.endswith("_r") for name in take.weights.names) else _LARGEST_OVERSHOOT
        if usual < most <= LARGEST_INTENSITY:
            _warn(path, f"action units up to {most:.4g}", "0 to 1", "intensities from 0 to 5")
            scaled = take.weights.values / LARGEST_INTENSITY
            return replace(take, weights=Track(take.weights.names, scaled, take.weights.confidence))
    if take.weights is not None and (most := _largest(take.weights.values.flatten(1), LARGEST_WEIGHT, _MOST_PERCENT)):
        _warn(path, f"weights up to {most:.4g}", "0 to 1", "percent")
        weights = Track(take.weights.names, take.weights.values / 100, take.weights.confidence)
        take = replace(take, weights=weights)
    columns = take.extras.get("columns", {})
    angles = {name: column for name, column in columns.items() if name in ROTATIONS and isinstance(column, Tensor)}
    if angles and (most := _largest(torch.stack(list(angles.values()), 1), LARGEST_ANGLE, _MOST_DEGREES)):
        _warn(path, f"head and eye rotations up to {most:.4g}", "radians", "degrees")
        columns = columns | {name: column * (math.pi / 180) for name, column in angles.items()}
        take = replace(take, extras=take.extras | {"columns": columns})
    return take


def _largest(values: Tensor, usual: float, most: float) -> float:
    """The largest of values (T,C), where many frames are beyond the usual and none beyond the unit's; else 0."""
    largest = values.abs().nan_to_num(0.0).amax(1) if values.numel() else values.new_zeros(1)
    beyond = float((largest > usual).double().mean())
    return float(largest.max()) if beyond >= _SHARE and float(largest.max()) <= most else 0.0


def _warn(path: Path, found: str, expected: str, taken: str) -> None:
    warnings.warn(f"{path}: found {found}, expected {expected}; they are taken for {taken}", stacklevel=4)
