"""The whole way from a webcam's picture to blendshape weights, as one ONNX model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import onnx
import torch
from torch import Tensor, nn

from torchface import __version__
from torchface.capture.anybody import WebcamControls, WebcamSolver
from torchface.capture.anybody.webcam_state import CONTROLS, POSES
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER, FaceReading
from torchface.landmarks.images.frame_reader.face_reader import STATE, FaceReader
from torchface.landmarks.images.frame_reader.picture_pieces import picture_size
from torchface.onnx.exported_model import chained_models, exported_model, half_stored
from torchface.onnx.network_graphs import halves
from torchface.onnx.unrolled_operators import TRANSLATIONS
from torchface.shape_names import ARKIT

READ = (
    *READ_FOR_SOLVER, "size", "used_interval", "used_controls", "solver_state", "reader_state"
)  # fmt: skip
"""What the first part of the graph hands to the second."""

SOLVED = ("weights", "rotation", "translation", "gaze", "calibrated", "next_state")
"""What the second part gives."""

OUTPUTS = (
    "weights", "rotation", "translation", "gaze", "landmarks", "iris", "presence", "calibrated", "next_state"
)  # fmt: skip

_SHORTEST, _LONGEST, _USUAL = 1e-3, 1.0, 1 / 30  # seconds
_HIGHEST = (5.0, 10.0, 1.0, 1.0, 1.0)


class WebcamAnswer(NamedTuple):
    """A frame's outputs: as of ``WebcamState``, and the state for the next frame."""

    weights: Tensor
    rotation: Tensor
    translation: Tensor
    gaze: Tensor
    tracked: Tensor
    calibrated: Tensor
    error: Tensor
    next_state: Tensor


class WebcamSolverGraph(nn.Module):
    """``WebcamSolver`` with named outputs beside its state, float32.

    Args:
        solver: as it is to be exported.
    """

    def __init__(self, solver: WebcamSolver) -> None:
        super().__init__()
        self.solver, self.state_size = solver, solver.layout.length

    def forward(self, *given: Tensor) -> WebcamAnswer:
        """The frame's answer, of ``READ_FOR_SOLVER``, the picture's size (2,), seconds since the frame before (),
        ``CONTROLS`` (5,) and the state (S,), zeros to start; all float32."""
        vector = self.solver(*given)
        state = self.solver.layout.unpack(vector)
        return WebcamAnswer._make([*(getattr(state, name) for name in WebcamAnswer._fields[:-1]), vector])


class AnswerSolver(Protocol):
    """A module that solves weights, such as ``WebcamSolverGraph``."""

    state_size: int

    def __call__(self, *given: Tensor) -> WebcamAnswer: ...


class WebcamReading(nn.Module):
    """The first part of what the graph computes: the picture's face, and all that the second part takes.

    Args:
        reader: reads faces.
    """

    def __init__(self, reader: FaceReader) -> None:
        super().__init__()
        self.reader = reader

    def forward(self, image: Tensor, interval: Tensor, controls: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """``READ`` of the graph's inputs."""
        interval = torch.where(torch.isfinite(interval), interval, _USUAL).clamp(_SHORTEST, _LONGEST)
        controls = torch.where(torch.isfinite(controls), controls, WebcamControls().tensor())
        controls = controls.clamp(min=0).minimum(torch.tensor(_HIGHEST))
        state = torch.where(torch.isfinite(state).all(), state, 0.0)
        reading, after = self.reader(image, interval, torch.where(controls[3] > 0, 0.0, state[:STATE]))
        read = [getattr(reading, name).clone() for name in READ_FOR_SOLVER]
        return *read, picture_size(image), interval, controls, state[STATE:], after


class WebcamSolving(nn.Module):
    """The second part: weights, head and next state of what the first has read.

    Args:
        solver: solves weights, such as ``WebcamSolverGraph``.
    """

    def __init__(self, solver: AnswerSolver) -> None:
        super().__init__()
        self.solver = solver

    def forward(self, *read: Tensor) -> tuple[Tensor, ...]:
        """``SOLVED`` of ``READ``."""
        answer = self.solver(*read[:-1])
        solved = answer._asdict() | {"next_state": torch.cat([read[-1], answer.next_state])}
        return tuple(solved[name].clone() for name in SOLVED)  # outputs of a graph are its own


class WebcamGraph(nn.Module):
    """What the graph computes: picture, seconds, controls and state in; weights, head and next state out.

    Whatever comes, numbers that are not finite or beyond their range count as usual ones, and a state that is not
    finite as a start.

    Args:
        solver: solves weights, such as ``WebcamSolverGraph``.
    """

    def __init__(self, reader: FaceReader, solver: AnswerSolver) -> None:
        super().__init__()
        self.reader, self.solver = reader, solver

    def forward(self, image: Tensor, interval: Tensor, controls: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """``OUTPUTS`` of ``image`` uint8 (H,W,C), ``interval`` (), ``controls`` (5,) and ``state`` (S,)."""
        read = WebcamReading(self.reader)(image, interval, controls, state)
        given = dict(zip(READ, read, strict=True)) | dict(zip(SOLVED, WebcamSolving(self.solver)(*read), strict=True))
        return tuple(given[name] for name in OUTPUTS)


def reading_model(reader: FaceReader, state_size: int) -> onnx.ModelProto:
    """The model of :class:`WebcamReading`, with networks stored as halves, for a solver of so many state numbers."""
    examples = {
        "image": torch.zeros(96, 128, 4, dtype=torch.uint8),
        "interval": torch.tensor(_USUAL),
        "controls": WebcamControls().tensor(),
        "state": torch.zeros(STATE + state_size),
    }
    sizes = {"image": ("height", "width", "channels")}
    model = exported_model(WebcamReading(reader), examples, READ, {}, sizes, TRANSLATIONS, optimize=False)
    names = halves(reader, "reader.")
    return half_stored(model, {name for name in names if not name.startswith("reader.boxes.")})


def solving_model(solver: AnswerSolver) -> onnx.ModelProto:
    """The model of :class:`WebcamSolving`."""
    lost = FaceReading.lost()
    given = [getattr(lost, name) for name in READ_FOR_SOLVER]
    given += [torch.tensor([128.0, 96.0]), torch.tensor(_USUAL), WebcamControls().tensor()]
    given += [torch.zeros(solver.state_size), torch.zeros(STATE)]
    examples = dict(zip(READ, given, strict=True))
    return exported_model(WebcamSolving(solver), examples, SOLVED, {}, None, TRANSLATIONS, optimize=False)


def webcam_model(
    reading: onnx.ModelProto, solving: onnx.ModelProto, facts: Mapping[str, object] | None = None
) -> onnx.ModelProto:
    """The model of :class:`WebcamGraph`, of those of its parts.

    Inputs are ``image`` uint8 (H,W,C), 3 channels or 4, red first; ``interval`` (), seconds; ``controls`` (5,), see
    ``CONTROLS``; ``state`` (S,), zeros to start. Outputs are ``weights`` (52,), ``rotation`` (3,3), ``translation``
    (3,), millimetres, ``gaze`` (2,2), radians, ``landmarks`` (68,2) and ``iris`` (2,2), pixels, NaN without a face,
    ``presence`` (), ``calibrated`` () and ``next_state`` (S,).
    """
    size = reading.graph.input[3].type.tensor_type.shape.dim[0].dim_value
    metadata = {
        "task": "webcam",
        "names": list(ARKIT),
        "state": str(size),
        "controls": list(CONTROLS),
        "usual_controls": WebcamControls().tensor().tolist(),
        "poses": list(POSES),
        "image": "uint8, rows, columns, channels: red, green, blue, and one more that counts for nothing",
        "units": "seconds, pixels, millimetres, radians; weights, 1 is the whole shape",
        "version": __version__,
        **(facts or {}),
    }
    return chained_models(reading, solving, OUTPUTS, metadata)
