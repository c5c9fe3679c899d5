"""The whole way from a webcam's picture to blendshape weights, as one ONNX model."""

import copy
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import onnx
import torch
from torch import Tensor, nn

from torchface.capture.anybody import WebcamControls, WebcamSolver
from torchface.capture.anybody.webcam_state import CONTROLS, POSES
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER, FaceReading
from torchface.landmarks.images.frame_reader.face_reader import STATE, FaceReader, people_beside
from torchface.landmarks.images.frame_reader.face_search import FOUND
from torchface.landmarks.images.frame_reader.picture_pieces import picture_size
from torchface.onnx.exported_model import chained_models, exported_model, half_stored
from torchface.onnx.graph_parts import PART, graph_part, with_parts
from torchface.onnx.network_graphs import halves
from torchface.onnx.unrolled_operators import TRANSLATIONS
from torchface.shape_names import ARKIT

READ = (
    *READ_FOR_SOLVER, "size", "used_interval", "used_controls", "solver_state", "reader_state"
)  # fmt: skip
"""What the first part of the graph hands to the second."""

SOLVED = ("weights", "rotation", "translation", "gaze", "calibrated", "beside", "next_state")
"""What the second part gives."""

OUTPUTS = (
    "weights", "rotation", "translation", "gaze", "landmarks", "iris", "presence", "calibrated", "beside",
    "next_state",
)  # fmt: skip

_SHORTEST, _LONGEST, _USUAL = 1e-3, 1.0, 1 / 30  # seconds
_PICTURE = torch.zeros(96, 128, 4, dtype=torch.uint8)
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
    """``WebcamSolver`` with named outputs beside its state, float32."""

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
    """The first part of what the graph computes: the picture's face, and all that the second part takes."""

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
    """The second part: weights, head and next state of what the first has read."""

    def __init__(self, solver: AnswerSolver) -> None:
        super().__init__()
        self.solver = solver

    def forward(self, *read: Tensor) -> tuple[Tensor, ...]:
        """``SOLVED`` of ``READ``."""
        answer = self.solver(*read[:-1])
        reader_state = read[-1]
        solved = answer._asdict() | {"beside": people_beside(reader_state)}
        solved["next_state"] = torch.cat([reader_state, answer.next_state])
        return tuple(solved[name].clone() for name in SOLVED)  # outputs of a graph are its own


class WebcamGraph(nn.Module):
    """What the graph computes: picture, seconds, controls and state in; weights, head and next state out.

    Whatever comes, numbers that are not finite or beyond their range count as usual ones, and a state that is not
    finite as a start.
    """

    def __init__(self, reader: FaceReader, solver: AnswerSolver) -> None:
        super().__init__()
        self.reader, self.solver = reader, solver

    def forward(self, image: Tensor, interval: Tensor, controls: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """``OUTPUTS`` of ``image`` uint8 (H,W,C), ``interval`` (), ``controls`` (5,) and ``state`` (S,)."""
        read = WebcamReading(self.reader)(image, interval, controls, state)
        given = dict(zip(READ, read, strict=True)) | dict(zip(SOLVED, WebcamSolving(self.solver)(*read), strict=True))
        return tuple(given[name] for name in OUTPUTS)


class _Part(nn.Module):
    """A part of a reader as a module."""

    def __init__(self, reader: FaceReader) -> None:
        super().__init__()
        self.reader = reader


class _Cells(_Part):
    def forward(self, images: Tensor) -> Tensor:
        return self.reader.boxes.cells(images)


class _Search(_Part):
    def forward(self, image: Tensor, place: Tensor, waiting: Tensor, attempt: Tensor, longest: Tensor) -> Tensor:
        return self.reader.search(image, place, waiting, attempt, longest)


class _Look(_Part):
    def forward(self, image: Tensor, place: Tensor) -> Tensor:
        return self.reader.look(image, place)


def _cell_part(images: Tensor) -> Tensor:
    rows, columns = ((side // 4 + 1) // 2 for side in images.shape[2:])
    return graph_part([images], "cells", [1, rows * columns, 6])


def reading_parts(reader: FaceReader) -> dict[str, Callable[[], onnx.ModelProto]]:
    """What makes the models of the parts of :class:`WebcamReading` that take long."""
    place = torch.tensor([64.0, 48.0, 64.0, 1.0, 0.0])
    picture, sizes = {"image": _PICTURE, "place": place}, {"image": ("height", "width", "channels")}
    sought = {**picture, "waiting": torch.tensor(False), "attempt": torch.tensor(0.0), "longest": torch.tensor(128.0)}

    def cells() -> onnx.ModelProto:
        given = {"images": torch.zeros(1, 3, 96, 128)}
        return exported_model(_Cells(reader), given, ["out"], {}, {"images": (None, None, "height", "width")})

    def search() -> onnx.ModelProto:
        apart = copy.copy(reader)
        apart._modules = {**reader._modules, "boxes": copy.copy(reader.boxes)}
        apart.boxes.cells = _cell_part  # type: ignore[method-assign]
        model = exported_model(_Search(apart), sought, ["out"], {}, sizes, PART, optimize=False)
        return with_parts(model, {"cells": cells()}, "reader.")

    def look() -> onnx.ModelProto:
        return exported_model(_Look(reader), picture, ["out"], {}, sizes, optimize=False)

    return {"look": look, "search": search}


def reading_model(
    reader: FaceReader, state_size: int, parts: Mapping[str, onnx.ModelProto] | None = None
) -> onnx.ModelProto:
    """The model of :class:`WebcamReading`, with networks stored as halves; ``reading_parts`` makes its parts where
    absent."""
    examples = {
        "image": _PICTURE,
        "interval": torch.tensor(_USUAL),
        "controls": WebcamControls().tensor(),
        "state": torch.zeros(STATE + state_size),
    }
    sizes = {"image": ("height", "width", "channels")}
    apart, parts = reader, dict(parts or {})
    if isinstance(reader, FaceReader):
        apart, parts = copy.copy(reader), parts or {name: make() for name, make in reading_parts(reader).items()}
        length = len(reader.look(_PICTURE, torch.tensor([64.0, 48.0, 64.0, 1.0, 0.0])))
        apart.look = lambda *given: graph_part(list(given), "look", [length])  # type: ignore[method-assign]
        apart.search = lambda *given: graph_part(list(given), "search", [FOUND])  # type: ignore[method-assign]
    model = exported_model(WebcamReading(apart), examples, READ, {}, sizes, {**TRANSLATIONS, **PART}, optimize=False)
    names = halves(reader, "reader.")
    return half_stored(
        with_parts(model, parts, "reader."), {name for name in names if not name.startswith("reader.boxes.")}
    )


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
    ``presence`` (), ``calibrated`` (), ``beside`` (2,), how many other people stand to the left of the face in the
    picture and to the right, smoothed, and ``next_state`` (S,).
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
        **(facts or {}),
    }
    return chained_models(reading, solving, OUTPUTS, metadata)
