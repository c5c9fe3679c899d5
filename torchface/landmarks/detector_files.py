"""A detector on disk: ``model.toml`` for what it is, ``state.safetensors`` for what it has learned."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchface.errors import FileFormatError, MissingExtraError, TorchfaceError
from torchface.files import read_file, write_file
from torchface.landmarks.uv import UVLandmarkDetector

KIND = "uv_landmarks"
_LARGEST_STATE = 64 * 2**20
_LARGEST_TEXT = 2**20


def save_detector(
    detector: UVLandmarkDetector, folder: str | Path, notes: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Writes a detector into a folder; each file appears only when it is complete.

    Args:
        detector: what to save.
        folder: made where it is missing.
        notes: further tables of ``model.toml``, such as settings and measured errors.

    Raises:
        FileFormatError: the folder cannot be written to.
        MissingExtraError: safetensors or tomli-w are not installed.
    """
    try:
        import tomli_w
        from safetensors.torch import save
    except ImportError as error:
        raise MissingExtraError(f"saving a model needs {error.name}: pip install safetensors tomli-w") from error
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder}: cannot be made ({error.strerror})") from error
    state = {name: tensor.contiguous() for name, tensor in detector.state_dict().items()}
    write_file(folder / "state.safetensors", save(state))
    document = {"kind": KIND, "config": _without_none(detector.config), **(notes or {})}
    write_file(folder / "model.toml", tomli_w.dumps(document).encode())


def load_detector(folder: str | Path) -> UVLandmarkDetector:
    """Reads what :func:`save_detector` wrote.

    Raises:
        FileFormatError: a file is missing, too large, of another kind, or does not fit the other.
        MissingExtraError: safetensors is not installed.
    """
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load
    except ImportError as error:
        raise MissingExtraError(f"loading a model needs {error.name}: pip install safetensors") from error
    folder = Path(folder)
    path = folder / "model.toml"
    try:
        document = tomllib.loads(read_file(path, _LARGEST_TEXT).decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise FileFormatError(f"{path}: not TOML ({error})") from error
    config = document.get("config")
    if document.get("kind") != KIND or not isinstance(config, dict):
        raise FileFormatError(f"{path}: found kind {document.get('kind')!r}, expected {KIND!r} with a config")
    state_path = folder / "state.safetensors"
    data = read_file(state_path, _LARGEST_STATE)
    try:
        state = load(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{state_path}: no readable state ({error})") from error
    # The config says how much memory the module takes: no more than the state that is already here.
    if _claimed(config) > len(data):
        raise FileFormatError(f"{path}: the config claims more than the {len(data)} bytes of {state_path}")
    try:
        detector = UVLandmarkDetector(**config)
        detector.load_state_dict(state)
    except (TypeError, ValueError, KeyError, RuntimeError, AttributeError, TorchfaceError) as error:
        raise FileFormatError(f"{path}: config and state do not fit ({error})") from error
    if not all(bool(torch.isfinite(tensor).all()) for tensor in state.values()):
        raise FileFormatError(f"{state_path}: found NaN or infinity, expected finite numbers")
    return detector


def _claimed(config: dict[str, Any]) -> float:
    """Bytes of the filters and the frame that a config asks for."""
    settings = config.get("settings")
    hog = settings.get("hog") if isinstance(settings, dict) else None
    frame = config.get("frame") or {}
    names = config.get("names")
    try:
        side = hog["window"] / hog["cell"] if isinstance(hog, dict) else 4
        count = len(names) if isinstance(names, list) else 0
        filters = 4.0 * count * config["images"] * (hog["bins"] if isinstance(hog, dict) else 9) * side**2
        return filters + 8.0 * 6 * frame.get("points", 0) + 24.0 * frame.get("count", 0)
    except (KeyError, TypeError, ZeroDivisionError, AttributeError):
        return float("inf")


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    """TOML has no null: what is absent is None."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in table.items()
        if value is not None
    }
