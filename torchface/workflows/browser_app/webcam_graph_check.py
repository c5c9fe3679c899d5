"""Whether an ONNX file is the graph from a webcam's picture to weights, as the page runs it."""

from __future__ import annotations

import json
from pathlib import Path

import onnxruntime

from torchface.errors import FileFormatError
from torchface.shape_names import ARKIT

_INPUTS = {"image": "tensor(uint8)", "interval": "tensor(float)", "controls": "tensor(float)", "state": "tensor(float)"}
_OUTPUTS = (
    *("weights", "rotation", "translation", "gaze", "landmarks", "iris"),
    *("presence", "calibrated", "next_state"),
)


def check_webcam_graph(data: bytes, path: str | Path) -> None:
    """Looks at inputs, outputs and names of shapes; runs nothing.

    Args:
        data: the file's bytes.
        path: names it in errors.
    """
    wanted = f"expected the graph of torchface export webcam ({', '.join(_INPUTS)} to {', '.join(_OUTPUTS)})"
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors alone
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has no common class for what it raises
        raise FileFormatError(f"{path}: not an ONNX file that runs ({str(error)[:160]}), {wanted}") from error
    inputs = {one.name: one.type for one in session.get_inputs()}
    missing = sorted(set(_OUTPUTS) - {one.name for one in session.get_outputs()})
    if inputs != _INPUTS or missing:
        found = ", ".join(f"{name} {kind}" for name, kind in inputs.items())
        raise FileFormatError(f"{path}: found the inputs {found} and no output {', '.join(missing) or '-'}; {wanted}")
    names = session.get_modelmeta().custom_metadata_map.get("names", "[]")
    if tuple(json.loads(names)) != ARKIT:
        raise FileFormatError(f"{path}: found the shapes {names:.80}, expected ARKit's 52 in their order")
