"""Landmarks by anybody's ONNX graph of the agreed inputs and outputs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, TorchfaceError
from torchface.files.whole_files import read_file
from torchface.landmarks.images.face_crop import CROP_MARGIN
from torchface.landmarks.images.graph_session import graph_session
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.crop_finder import CropFinder
from torchface.landmarks.images.networks.landmark_network import NetworkLandmarks

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
    """
    path, content = Path(path), read_file(path, _MAX_BYTES)
    try:
        return _finder(graph_session(content), tuple(_OUTPUTS), path)
    except TorchfaceError:
        raise
    except Exception as error:  # ONNX Runtime has an exception class a fault, and none above them
        what = " ".join(str(error).split())[:160]
        raise FileFormatError(f"{path}: cannot be used as an ONNX graph ({what}); {_EXPECTED}") from error


def graph_finder(content: bytes, path: Path) -> CropFinder:
    """The finder of a graph of this library's own making, with all that it gives; see :func:`onnx_finder`."""
    session = graph_session(content)
    return _finder(session, tuple(one.name for one in session.get_outputs()), path)


def _finder(session: "onnxruntime.InferenceSession", names: tuple[str, ...], path: Path) -> CropFinder:
    """The finder of a graph that declares what is expected, and gives it for one crop."""
    size = _checked_size(session, path)
    margin = _margin(session.get_modelmeta().custom_metadata_map.get("crop"), path)
    finder = CropFinder(_Graph(session, names), size, margin, path.name)
    trial = finder.network(torch.full((1, 3, size, size), 0.5))
    for output, (name, shape) in zip(trial, _OUTPUTS.items(), strict=False):
        if output.shape != (1, *shape):
            raise FileFormatError(f"{path}: found {name} {tuple(output.shape)} for one crop; {_EXPECTED}")
    return finder


@dataclass(frozen=True, eq=False)
class _Graph:
    """Some outputs of a graph as a function of crops."""

    session: "onnxruntime.InferenceSession"
    names: tuple[str, ...]

    def __call__(self, crops: Tensor) -> NetworkLandmarks:
        outputs = self.session.run(list(self.names), {"image": crops.float().contiguous().numpy()})
        given = {name: torch.from_numpy(np.asarray(one)) for name, one in zip(self.names, outputs, strict=True)}
        least = NetworkLandmarks.of_68(*(given[name] for name in _OUTPUTS))
        return least._replace(**{name: given[name] for name in NetworkLandmarks._fields if name in given})


def _checked_size(session: "onnxruntime.InferenceSession", path: Path) -> int:
    """S, of a graph that declares what is expected."""
    inputs = [(one.name, one.shape, one.type) for one in session.get_inputs()]
    outputs = {one.name: (one.shape, one.type) for one in session.get_outputs()}
    fits = (
        [name for name, _, _ in inputs] == ["image"]
        and set(outputs) >= set(_OUTPUTS)
        and inputs[0][2] == "tensor(float)"
        and _is_shape(inputs[0][1], (3, None, None))
        and inputs[0][1][2] == inputs[0][1][3]
        and all(outputs[name][1] == "tensor(float)" for name in _OUTPUTS)
        and all(_is_shape(outputs[name][0], shape) for name, shape in _OUTPUTS.items())
    )
    if not fits:
        found = ", ".join(f"{name} {_told(shape)} {kind}" for name, shape, kind in inputs[:4])
        given = ", ".join(f"{name} {_told(shape)} {kind}" for name, (shape, kind) in list(outputs.items())[:6])
        raise FileFormatError(f"{path}: found inputs {found or 'none'}; outputs {given or 'none'}; {_EXPECTED}")
    size = inputs[0][1][2]
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


def _margin(crop: str | None, path: Path) -> float:
    text = str(CROP_MARGIN) if crop is None else crop
    try:
        margin = float(text)
    except ValueError:
        margin = math.nan
    if not _MARGINS[0] <= margin <= _MARGINS[1]:
        raise FileFormatError(
            f"{path}: found the metadata crop {text[:40]!r}, expected a number from {_MARGINS[0]} to {_MARGINS[1]}"
        )
    return margin
