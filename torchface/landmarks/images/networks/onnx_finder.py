"""Landmarks by anybody's ONNX graph of the agreed inputs and outputs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.landmarks.images.face_crop import CROP_MARGIN
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.crop_finder import CropFinder

if TYPE_CHECKING:
    import onnxruntime

_MAX_BYTES = 2**28
_SIZES = (16, 1024)
_MARGINS = (0.5, 4.0)
_OUTPUTS: dict[str, tuple[int, ...]] = {
    "landmarks": (COUNT, 2), "deviation": (COUNT,), "visibility": (COUNT,), "presence": ()
}  # fmt: skip
_EXPECTED = (
    f"expected an input image (B,3,S,S) float32 and outputs landmarks (B,{COUNT},2), deviation (B,{COUNT}), visibility "
    f"(B,{COUNT}) and presence (B), all float32"
)


def onnx_finder(path: str | Path) -> CropFinder:
    """A finder that runs an ONNX graph in ONNX Runtime, on one thread.

    The graph takes ``image`` (B,3,S,S) float32 in [0,1], red first: the face's box, enlarged by the number that the
    graph's metadata hold as ``crop`` (1.25 if none) and turned upright. It gives ``landmarks`` (B,68,2), their standard
    ``deviation`` (B,68), both in the crop's pixels, ``visibility`` (B,68) and ``presence`` (B,) in [0,1].

    Args:
        path: the file; weights lie in it.

    Raises:
        FileFormatError: it is no ONNX graph, or one of other inputs and outputs; the message says which it has.
    """
    path = Path(path)
    return graph_finder(read_file(path, _MAX_BYTES), path)


def graph_finder(content: bytes, path: Path) -> CropFinder:
    """The finder of a graph that was read or made already; see :func:`onnx_finder`.

    Args:
        content: of an ONNX file.
        path: what messages call it.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has an exception class a fault, and none above them
        raise FileFormatError(
            f"{path}: cannot be used as an ONNX graph ({_short(error)}); expected one that finds landmarks"
        ) from error
    size = _checked_size(session, path)
    finder = CropFinder(_Runner(session, path), size, _margin(session, path), path.name)
    trial = finder.network(torch.full((1, 3, size, size), 0.5))
    for output, (name, shape) in zip(trial, _OUTPUTS.items(), strict=True):
        if output.shape != (1, *shape):
            raise FileFormatError(f"{path}: found {name} {tuple(output.shape)} for one crop; {_EXPECTED}")
    return finder


class _Runner:
    """The graph as a function of crops."""

    def __init__(self, session: onnxruntime.InferenceSession, path: Path) -> None:
        self.session, self.path = session, path

    def __call__(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        try:
            outputs = self.session.run(list(_OUTPUTS), {"image": crops.float().contiguous().numpy()})
        except Exception as error:  # see above
            raise FileFormatError(f"{self.path}: the graph cannot be run ({_short(error)}); {_EXPECTED}") from error
        landmarks, deviation, visibility, presence = (torch.from_numpy(np.asarray(one)) for one in outputs)
        return landmarks, deviation, visibility, presence


def _checked_size(session: onnxruntime.InferenceSession, path: Path) -> int:
    """S, of a graph that declares what is expected."""
    inputs, outputs = session.get_inputs(), {one.name: one for one in session.get_outputs()}
    fits = (
        [one.name for one in inputs] == ["image"]
        and set(outputs) >= set(_OUTPUTS)
        and inputs[0].type == "tensor(float)"
        and _is_shape(inputs[0].shape, (3, None, None))
        and inputs[0].shape[2] == inputs[0].shape[3]
        and all(outputs[name].type == "tensor(float)" for name in _OUTPUTS)
        and all(_is_shape(outputs[name].shape, shape) for name, shape in _OUTPUTS.items())
    )
    if not fits:
        found = ", ".join(f"{one.name} {_told(one.shape)} {one.type}" for one in inputs[:4])
        given = ", ".join(f"{one.name} {_told(one.shape)} {one.type}" for one in list(outputs.values())[:6])
        raise FileFormatError(f"{path}: found inputs {found or 'none'}; outputs {given or 'none'}; {_EXPECTED}")
    size = inputs[0].shape[2]
    if not (isinstance(size, int) and _SIZES[0] <= size <= _SIZES[1]):
        raise FileFormatError(f"{path}: found crops of {size!r} pixels, expected a fixed {_SIZES[0]} to {_SIZES[1]}")
    return size


def _is_shape(found: list[int | str | None], expected: tuple[int | None, ...]) -> bool:
    """Whether declared dimensions are a batch and what is expected; a name stands for any number."""
    return len(found) == 1 + len(expected) and all(
        want is None or not isinstance(have, int) or have == want
        for have, want in zip(found, (None, *expected), strict=True)
    )


def _told(shape: list[int | str | None]) -> str:
    return "(" + ",".join("?" if one is None else str(one)[:12] for one in shape[:6]) + ")"


def _margin(session: onnxruntime.InferenceSession, path: Path) -> float:
    text = session.get_modelmeta().custom_metadata_map.get("crop", str(CROP_MARGIN))
    try:
        margin = float(text)
    except ValueError:
        margin = math.nan
    if not _MARGINS[0] <= margin <= _MARGINS[1]:
        raise FileFormatError(
            f"{path}: found the metadata crop {text[:40]!r}, expected a number from {_MARGINS[0]} to {_MARGINS[1]}"
        )
    return margin


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
