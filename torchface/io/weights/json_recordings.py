"""JSON recordings of weights: Audio2Face's export, ARKit's face anchors, and MediaPipe's blendshapes."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.documents import Value, read_json
from torchface.io.tables.frame_rates import FrameTimes, TimeSource, file_error, frame_times
from torchface.io.tables.numbered_csv import UNKNOWN_RATE
from torchface.io.weights.arkit_values import arkit_row
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.number_checks import check_rate
from torchface.shape_names import ARKIT
from torchface.take import Take, Track

_MAX_BYTES = 2**27
_MOST_SHAPES, _MOST_FRAMES = 1000, 2**20
_LARGEST = 1e4
_CATEGORIES = ("face_blendshapes", "faceBlendshapes", "blendshapes", "categories")
_TIMES = ("timestamp_ms", "timestampMs", "timestamp", "time")
_MATRICES = ("facial_transformation_matrixes", "facialTransformationMatrixes")
_NEUTRAL = "_neutral"  # MediaPipe's first category, which is no shape


def is_weight_json(path: str | Path) -> bool:
    """Whether a JSON file holds what :func:`load_weight_json` reads, by its keys."""
    document = read_json(path, max_bytes=_MAX_BYTES).found
    if isinstance(document, dict) and "weightMat" in document:
        return True
    frames = document.get("frames") if isinstance(document, dict) else document
    if (isinstance(document, dict) and frames is None) or _is_face(frames):
        frames = [document]
    if not isinstance(frames, list) or not frames:
        return False
    return _is_anchor(frames[0]) or any(map(_are_categories, frames))


def load_weight_json(path: str | Path, fps: float | None = None) -> Take:
    """Reads Audio2Face's export (``facsNames``, ``weightMat``, ``exportFps``), frames of ARKit's face anchors, or of
    MediaPipe's Face Landmarker.

    Frames are a list, or a table with the list ``frames``. Those of face anchors have ``timestamp`` in seconds,
    ``blendShapes`` with numbers by ARKit's names and, where the app wrote them, ``transform``, ``leftEyeTransform`` and
    ``rightEyeTransform``: 16 numbers by columns, or four columns of four. Those of MediaPipe are a result as it is
    printed in Python or JavaScript, or a face's categories alone (``category_name``, ``score``); of several faces the
    first counts, a frame without one is NaN, and without times there are 30 frames a second, with a ``UserWarning``.

    Args:
        path: the file.
        fps: frames a second of a file that has neither times nor a rate.

    Returns:
        weights (T,N,1), names as the file spells them, such as Audio2Face's 52 and 16 of the tongue; rotations in
        ``extras["columns"]``, radians, where there are transforms.
    """
    document = read_json(path, max_bytes=_MAX_BYTES)
    if isinstance(document.found, dict) and "weightMat" in document.found:
        return _audio2face(document, fps)
    frames = document["frames"] if isinstance(document.found, dict) else document
    if (isinstance(document.found, dict) and not frames) or _is_face(frames.found):
        frames = replace(document, found=[document.found])
    if isinstance(frames.found, list) and any(map(_are_categories, frames.found)):
        return _mediapipe(frames, fps)
    if not isinstance(frames.found, list) or not frames.found or frames.found == [{}]:
        raise document.error(
            "Audio2Face's facsNames and weightMat, or a list of frames with blendShapes, or with MediaPipe's categories"
        )
    return _face_anchors(frames, fps)


def _is_anchor(frame: object) -> bool:
    return isinstance(frame, dict) and "blendShapes" in frame


def _categories(frame: object) -> list[dict[str, Any]] | None:
    """The categories of the first face of MediaPipe's result, empty where it has none; None where it is no result."""
    while True:
        if isinstance(frame, dict):
            frame = next((frame[key] for key in _CATEGORIES if key in frame), None)
        elif _is_face(frame):
            return frame
        elif isinstance(frame, list):
            if not frame:
                return []
            frame = frame[0]
        else:
            return None


def _are_categories(frame: object) -> bool:
    return _categories(frame) is not None


def _is_face(found: object) -> TypeGuard[list[dict[str, Any]]]:
    """Whether these are one face's categories."""
    return isinstance(found, list) and bool(found) and isinstance(found[0], dict) and _score_name(found[0]) is not None


def _score_name(category: dict[str, Any]) -> str | None:
    """A category's name; None where it is none."""
    name = category.get("category_name") or category.get("categoryName")
    return name if isinstance(name, str) and "score" in category else None


def _mediapipe(frames: Value, fps: float | None) -> Take:
    rows = frames.rows(1, _MOST_FRAMES, f"1 to {_MOST_FRAMES} frames")
    weights = np.full((len(rows), len(ARKIT)), np.nan, np.float32)
    seen: set[int] = set()
    for i, row in enumerate(rows):
        categories = _categories(row.found)
        if categories is None:
            raise row.error("MediaPipe's categories, each with category_name and score")
        for category in replace(row, found=categories).rows():
            name = _score_name(category.found) if isinstance(category.found, dict) else None
            column = None if name is None else arkit_row(name)
            if column is None and name != _NEUTRAL:
                raise category.error("a category with one of ARKit's names and a score")
            if column is not None:
                weights[i, column] = category["score"].number("a score", _LARGEST)
                seen.add(column)
    if any(isinstance(row.found, dict) and any(map(row.found.get, _MATRICES)) for row in rows):
        warnings.warn(f"{frames.source}: the head's motion (facial transformation matrices) is not read", stacklevel=4)
    if not seen:
        empty = not any(_categories(row.found) for row in rows)
        found = f"no face in any of {len(rows)} frames" if empty else f"no category but {_NEUTRAL}"
        raise FileFormatError(f"{frames.source}: found {found}, expected MediaPipe's categories by ARKit's names")
    known = sorted(seen)
    key = next((key for key in _TIMES if isinstance(rows[0].found, dict) and key in rows[0].found), None)
    if key is None:
        if fps is None:
            warnings.warn(
                f"{frames.source}: found no timestamp in its frames; {UNKNOWN_RATE:g} a second are taken", stacklevel=4
            )
        timing = FrameTimes(fps or UNKNOWN_RATE, None)
    else:
        times = np.array([row[key].number("a time") for row in rows]) / (1000.0 if key.lower().endswith("ms") else 1.0)
        timing = frame_times(times, TimeSource(file_error(frames.source)))
    track = Track(tuple(ARKIT[column] for column in known), torch.from_numpy(weights[:, known])[..., None])
    return Take(timing.fps, weights=track, seconds=timing.seconds)


def _audio2face(document: Value, fps: float | None) -> Take:
    names = document["facsNames"].texts("the names of the shapes")
    if not 0 < len(names) <= _MOST_SHAPES or len(set(names)) < len(names) or not all(names):
        raise document["facsNames"].error(f"1 to {_MOST_SHAPES} names, each once")
    weights = document["weightMat"].tensor(None, len(names), expected=f"rows of {len(names)} numbers")
    if not len(weights):
        raise document["weightMat"].error("a frame at least")
    stated = document["exportFps"]
    rate = fps if fps is not None and not stated else stated.number("frames a second")
    check_rate(rate, f"{document.source}: exportFps", FileFormatError)
    return Take(rate, weights=Track(names, weights.float()[..., None]))


def _face_anchors(frames: Value, fps: float | None) -> Take:
    rows = frames.rows(1, _MOST_FRAMES, f"1 to {_MOST_FRAMES} frames")
    shapes = rows[0]["blendShapes"].table(expected="weights by ARKit's names")
    names = tuple(shapes)
    if not 0 < len(names) <= _MOST_SHAPES or not any(arkit_row(name) is not None for name in names):
        raise rows[0]["blendShapes"].error("some of ARKit's 52 shapes")
    weights = np.empty((len(rows), len(names)), np.float32)
    turned: list[Tensor] = []
    has_head = bool(rows[0]["transform"])
    for i, row in enumerate(rows):
        given = row["blendShapes"].table(expected="weights by ARKit's names")
        if given.keys() != shapes.keys():
            raise row["blendShapes"].error(f"the {len(names)} shapes of the first frame")
        weights[i] = [given[name].number("a weight", _LARGEST) for name in names]
        if has_head:
            head = _rotation(row["transform"])
            left, right = (_rotation(row[key]) for key in ("leftEyeTransform", "rightEyeTransform"))
            turned.append(torch.cat([_angles(head), *(_angles(eye) * _EYES for eye in (left, right))]))
    if fps is not None and not any(row["timestamp"] or row["time"] for row in rows):
        timing = FrameTimes(fps, None)
    else:
        times = np.array([(row["timestamp"] or row["time"]).number("seconds") for row in rows])
        timing = frame_times(times, TimeSource(file_error(frames.source), seconds=True))
    extras: dict[str, Any] = {}
    if turned:
        columns = torch.stack(turned)
        extras["columns"] = {name: columns[:, i].clone() for i, name in enumerate(ROTATIONS)}
    return Take(
        timing.fps, weights=Track(names, torch.from_numpy(weights)[..., None]), extras=extras, seconds=timing.seconds
    )


_EYES = torch.tensor([-1.0, 1.0, 0.0], dtype=torch.float64)  # their yaw is to the person's right, and they do not roll


def _rotation(transform: Value) -> Tensor:
    """The rotation (3,3) of a transform's 16 numbers by columns; none where there is no transform."""
    if not transform:
        return torch.eye(3, dtype=torch.float64)
    nested = isinstance(transform.found, list) and len(transform.found) == 4
    columns = transform.tensor(4, 4) if nested else transform.tensor(16, expected="16 numbers").reshape(4, 4)
    return columns[:3, :3].T


def _angles(rotation: Tensor) -> Tensor:
    """Yaw, pitch and roll (3,), radians, of a rotation about ARKit's axes: y up, z out of the face."""
    yaw = torch.atan2(rotation[0, 2], rotation[2, 2])
    return torch.stack([yaw, torch.asin((-rotation[1, 2]).clamp(-1, 1)), torch.atan2(rotation[1, 0], rotation[1, 1])])
