"""A detector on disk, in the format of all learned models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchface.files.models import ModelRecord, read_model, write_model
from torchface.landmarks.scans.uv_detector import UVLandmarkDetector

KIND = "uv_landmarks"


def save_detector(
    detector: UVLandmarkDetector, folder: str | Path, notes: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Writes a detector into a folder; each file appears only when it is complete.

    Args:
        detector: what to save.
        folder: made where it is missing.
        notes: ``settings`` of the training and measured ``errors``.

    Raises:
        FileFormatError: the folder cannot be written to.
        ValueRangeError: an error is NaN or infinite.

    Example:
        >>> from torchface import zoo
        >>> save_detector(zoo.get_model("uv_landmarks"), "detector")
        >>> load_detector("detector").names[0]
        'nose'
    """
    notes = notes or {}
    record = ModelRecord(KIND, "", "", metrics=dict(notes.get("errors", {})), settings=dict(notes.get("settings", {})))
    write_model(detector, folder, record)


def load_detector(folder: str | Path) -> UVLandmarkDetector:
    """Reads a detector that :func:`save_detector` or ``torchface.zoo.save_model`` wrote.

    Raises:
        FileFormatError: a file is missing, damaged, of another kind, or does not fit the other.

    Example:
        >>> from torchface import zoo
        >>> load_detector(zoo.find("uv_landmarks")).names[0]
        'nose'
    """
    return read_model(folder, {KIND: UVLandmarkDetector})
