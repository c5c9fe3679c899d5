"""Face Landmarker bundle, ``FILE.task``: a zip of three TensorFlow Lite networks, run by LiteRT on one thread."""

import io
import math
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchface.errors import FileFormatError
from torchface.files.extra_packages import import_extra
from torchface.files.whole_files import read_file

_MAX_BYTES = 2**26  # of the file, and of each network in it; they have 0.2 to 2.6 million
_MAX_ENTRIES = 64
_MAX_TENSORS = 2**28  # bytes that a network's tensors may take together
_STORED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_FLOAT = 4
_NETWORKS = {
    "face_detector.tflite": ((1, 128, 128, 3), ((1, 896, 16), (1, 896, 1))),
    "face_landmarks_detector.tflite": ((1, 256, 256, 3), ((1, 1, 1, 1434), (1, 1, 1, 1))),
    "face_blendshapes.tflite": ((1, 146, 2), ((52,),)),
}
"""Entries that a bundle has, with the shapes of each network's input and outputs; further outputs are not read."""


class LiteNetwork:
    """One TensorFlow Lite network of float32 tensors, with the shapes of its input and outputs."""

    def __init__(self, content: bytes, name: str, given: tuple[int, ...], wanted: tuple[tuple[int, ...], ...]) -> None:
        interpreter = _interpreter(content, name)
        inputs, outputs = interpreter.get_input_details(), interpreter.get_output_details()
        found = [_signature(one) for one in (*inputs, *outputs)]
        rows = [next((row for row, one in enumerate(outputs) if _signature(one) == shape), -1) for shape in wanted]
        if found[: len(inputs)] != [given] or -1 in rows:
            raise FileFormatError(f"{name}: found shapes {found} (float32), expected input {given}, outputs {wanted}")
        bytes_needed = sum(
            _FLOAT * math.prod(max(int(side), 1) for side in one["shape"]) for one in interpreter.get_tensor_details()
        )
        if bytes_needed > _MAX_TENSORS:
            raise FileFormatError(f"{name}: found tensors of {bytes_needed} bytes, expected at most {_MAX_TENSORS}")
        try:
            interpreter.allocate_tensors()
        except (RuntimeError, ValueError) as error:
            raise FileFormatError(f"{name}: found a damaged network ({error}), expected one that runs") from error
        self._interpreter, self._name = interpreter, name
        self._input = inputs[0]["index"]
        self._outputs = [outputs[row]["index"] for row in rows]

    def __call__(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """The outputs of float32 values of the input's shape."""
        self._interpreter.set_tensor(self._input, values)
        try:
            self._interpreter.invoke()
        except (RuntimeError, ValueError) as error:
            raise FileFormatError(f"{self._name}: found a damaged network ({error}), expected one that runs") from error
        found = tuple(self._interpreter.get_tensor(index) for index in self._outputs)
        if not all(np.isfinite(one).all() for one in found):
            raise FileFormatError(f"{self._name}: found outputs that are not finite, expected numbers")
        return found


@dataclass(frozen=True, eq=False)
class LandmarkerBundle:
    """The three networks of a bundle."""

    boxes: LiteNetwork  # from a picture (1,128,128,3) in [-1,1] to 896 boxes with six points each, and their scores
    # From a crop (1,256,256,3) in [0,1] to 478 points of three numbers in its pixels, and a score.
    landmarks: LiteNetwork
    blendshapes: LiteNetwork  # from 146 of them, (1,146,2), to weights (52,)


def load_bundle(path: str | Path) -> LandmarkerBundle:
    """Reads a bundle; nothing is unpacked but its networks, and nothing larger than they may be."""
    path = Path(path)
    content = read_file(path, _MAX_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as bundle:
            entries = bundle.infolist()
            if len(entries) > _MAX_ENTRIES:
                raise FileFormatError(f"{path}: found {len(entries)} entries, expected at most {_MAX_ENTRIES}")
            networks = [
                LiteNetwork(_entry(bundle, entries, name, path), f"{path}, {name}", *shapes)
                for name, shapes in _NETWORKS.items()
            ]
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, ValueError) as error:
        raise FileFormatError(f"{path}: found a damaged zip ({error}), expected a Face Landmarker bundle") from error
    return LandmarkerBundle(*networks)


def _entry(bundle: zipfile.ZipFile, entries: list[zipfile.ZipInfo], name: str, path: Path) -> bytes:
    """One network's bytes; its checksum is tested on the way."""
    own = [entry for entry in entries if entry.filename == name]
    if len(own) != 1:
        names = ", ".join(entry.filename[:60] for entry in entries[:8])
        raise FileFormatError(f"{path}: found {len(own)} entries {name} among {names}, expected one")
    entry = own[0]
    if entry.flag_bits & 1 or entry.compress_type not in _STORED:
        raise FileFormatError(f"{path}, {name}: found it encrypted or packed by other means, expected it plain")
    if not 0 < entry.file_size <= _MAX_BYTES:
        raise FileFormatError(f"{path}, {name}: found {entry.file_size} bytes, expected 1 to {_MAX_BYTES}")
    with bundle.open(entry) as opened:
        content = opened.read(entry.file_size + 1)
    if len(content) != entry.file_size:
        raise FileFormatError(f"{path}, {name}: found {len(content)} bytes, expected {entry.file_size}")
    return content


def _interpreter(content: bytes, name: str) -> Any:
    runtime = import_extra("ai_edge_litert.interpreter", "ai-edge-litert", "mediapipe", name)
    try:
        return runtime.Interpreter(model_content=content, num_threads=1)
    except (RuntimeError, ValueError) as error:
        raise FileFormatError(f"{name}: found no TensorFlow Lite network ({error}), expected one") from error


def _signature(detail: dict[str, Any]) -> tuple[int, ...] | str:
    """The shape of a tensor of float32; the name of its type where it is another."""
    return tuple(map(int, detail["shape"])) if detail["dtype"] is np.float32 else str(detail["dtype"])
