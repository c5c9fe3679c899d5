"""The whole way from a webcam's picture to blendshape weights, as one ONNX model."""

from __future__ import annotations

from collections.abc import Mapping

import onnx
import torch
from onnx import TensorProto

from torchface import __version__
from torchface.capture.anybody import WebcamControls
from torchface.capture.anybody.webcam_state import CONTROLS, POSES
from torchface.errors import ShapeError
from torchface.landmarks.images.face_reading import READ_BY_NETWORKS
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.onnx.graph_values import OPSET, Value, ValueGraph
from torchface.onnx.webcam.face_reader import STATE, ReaderSettings, WebcamNetworks, read_face
from torchface.onnx.webcam.picture_pieces import picture_size
from torchface.shape_names import ARKIT

SOLVED = ("weights", "rotation", "translation", "gaze", "calibrated")
"""What a solver gives."""

_SHORTEST, _LONGEST, _USUAL = 1e-3, 1.0, 1 / 30  # seconds
_HIGHEST = torch.tensor([5.0, 10.0, 1.0, 1.0, 1.0])


def webcam_model(
    networks: WebcamNetworks,
    solver: onnx.ModelProto,
    settings: ReaderSettings | None = None,
    facts: Mapping[str, object] | None = None,
) -> onnx.ModelProto:
    """The model: picture, seconds since the one before, controls and state in; weights, head and next state out.

    Inputs are ``image`` uint8 (H,W,C), 3 channels or 4, red first; ``interval`` (), seconds; ``controls`` (5,), see
    ``CONTROLS``; ``state`` (S,), zeros to start. Outputs are ``weights`` (52,), ``rotation`` (3,3), ``translation``
    (3,), millimetres, ``gaze`` (2,2), radians, ``landmarks`` (68,2) and ``iris`` (2,2), pixels, NaN without a face,
    ``presence`` (), ``calibrated`` () and ``next_state`` (S,). Whatever comes, numbers that are not finite or beyond
    their range count as usual ones, and a state that is not finite as a start.

    Args:
        networks: what read faces.
        solver: the graph that solves weights. Its inputs are ``READ_BY_NETWORKS``'s names with their shapes,
            ``presence`` (), ``size`` (2,), width and height of the picture, ``interval`` () and ``controls`` (5,),
            finite and in their ranges, and ``state`` (S,), zeros to start; inputs that it has no use for may be
            missing. Its outputs are ``SOLVED``'s names and ``next_state`` (S,).
        settings: when a face counts as found and as lost.
        facts: further metadata, such as licence.

    Raises:
        ShapeError: the solver's graph has other inputs or outputs.
    """
    own, theirs = STATE, _state_size(solver)
    graph = ValueGraph()
    image, controls = graph.value("image"), graph.value("controls")
    interval = _finite(graph, graph.value("interval").shaped(1), _USUAL).least(_LONGEST).most(_SHORTEST)
    controls = _finite(graph, controls, WebcamControls().tensor())
    controls = controls.most(0.0).least(graph.as_value(_HIGHEST))
    forget = controls.rows(3, 4) > 0.0
    state = graph.value("state")
    broken = _broken(graph, state).number().reduced("ReduceMax", 0, keep=True) > 0.5
    state = graph.where(broken, 0.0, state)
    reader_state = graph.where(forget, 0.0, state.rows(0, own))
    read = read_face(graph, image, interval, reader_state, networks, settings or ReaderSettings())
    given = {name: getattr(read, name) for name in READ_BY_NETWORKS}
    given |= {
        "presence": read.presence.shaped(),
        "size": picture_size(image),
        "interval": interval.shaped(),
        "controls": controls,
        "state": state.rows(own, own + theirs),
    }
    wanted = [one.name for one in solver.graph.input]
    if set(wanted) - set(given):
        raise ShapeError(f"solver's graph: found inputs {wanted}, expected no others than {list(given)}")
    solved = graph.include(solver, "solver/", {name: given[name] for name in wanted})
    if missing := {*SOLVED, "next_state"} - set(solved):
        raise ShapeError(f"solver's graph: found outputs {list(solved)}, expected also {sorted(missing)}")
    outputs: dict[str, tuple[Value, tuple[int, ...]]] = {
        "weights": (solved["weights"], (len(ARKIT),)),
        "rotation": (solved["rotation"], (3, 3)),
        "translation": (solved["translation"], (3,)),
        "gaze": (solved["gaze"], (2, 2)),
        "landmarks": (read.landmarks, (COUNT, 2)),
        "iris": (read.iris, (2, 2)),
        "presence": (given["presence"], ()),
        "calibrated": (solved["calibrated"], ()),
        "next_state": (graph.cat(read.state, solved["next_state"]), (own + theirs,)),
    }
    for name, (value, _) in outputs.items():
        graph.build.op("Identity", value.name, output=name)
    metadata = {
        "task": "webcam",
        "names": list(ARKIT),
        "state": str(own + theirs),
        "controls": list(CONTROLS),
        "usual_controls": WebcamControls().tensor().tolist(),
        "poses": list(POSES),
        "image": "uint8, rows, columns, channels: red, green, blue, and one more that counts for nothing",
        "units": "seconds, pixels, millimetres, radians; weights, 1 is the whole shape",
        "version": __version__,
        **(facts or {}),
    }
    inputs: dict[str, tuple[int | str, ...]] = {
        "image": ("height", "width", "channels"),
        "interval": (),
        "controls": (5,),
        "state": (own + theirs,),
    }
    shapes = {name: shape for name, (_, shape) in outputs.items()}
    return graph.root.model("webcam", inputs, shapes, metadata, OPSET, {"image": TensorProto.UINT8})


def _broken(graph: ValueGraph, value: Value) -> Value:
    """Where a value is not finite."""
    return graph.op("IsNaN", value) | graph.op("IsInf", value)


def _finite(graph: ValueGraph, value: Value, usual: float | torch.Tensor) -> Value:
    """A value with usual numbers where it is not finite."""
    return graph.op("Where", _broken(graph, value), usual, value)


def _state_size(model: onnx.ModelProto) -> int:
    for given in model.graph.input:
        if given.name == "state":
            return int(given.type.tensor_type.shape.dim[0].dim_value)
    raise ShapeError(f"solver's graph: found inputs {[one.name for one in model.graph.input]}, expected state (S,)")
