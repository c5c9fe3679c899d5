"""The webcam's solver as an ONNX graph: the very module, with its state as one vector."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import onnx
import torch
from torch import Tensor, nn

from torchface import __version__
from torchface.capture.anybody import WebcamSolver
from torchface.capture.anybody.webcam_state import CONTROLS, POSES
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER, FaceReading
from torchface.onnx.exported_model import exported_model
from torchface.onnx.unrolled_operators import TRANSLATIONS
from torchface.shape_names import ARKIT

INPUTS = (*READ_FOR_SOLVER, "size", "interval", "controls", "state")
"""A ``FaceReading``'s tensors, the picture's width and height (2,), seconds since the frame before (), ``CONTROLS``
(5,) and the state (S,), zeros to start; all float32."""
OUTPUTS = ("weights", "rotation", "translation", "gaze", "tracked", "calibrated", "error", "next_state")
"""As of ``WebcamState``, and the state for the next frame."""


class WebcamAnswer(NamedTuple):
    """A frame's outputs, in the order of ``OUTPUTS``."""

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
        """The frame's answer, of ``INPUTS`` in their order."""
        vector = self.solver(*given)
        state = self.solver.layout.unpack(vector)
        return WebcamAnswer._make([*(getattr(state, name) for name in OUTPUTS[:-1]), vector])


def empty_reading() -> FaceReading:
    """What networks read of a picture without a face."""
    return replace(FaceReading.lost(), deviation=torch.zeros(68))


def webcam_solver_model(solver: WebcamSolver) -> onnx.ModelProto:
    """The model of a solver: ``INPUTS`` to ``OUTPUTS``.

    The metadata holds ``names`` (JSON list, of the weights), ``state`` (S), ``controls``, ``poses`` and ``version``.
    """
    reading = empty_reading()
    examples = [getattr(reading, name) for name in READ_FOR_SOLVER]
    examples += [torch.tensor([640.0, 480.0]), torch.tensor(1 / 30), torch.zeros(len(CONTROLS))]
    examples.append(torch.zeros(solver.layout.length))
    return exported_model(
        WebcamSolverGraph(solver),
        dict(zip(INPUTS, examples, strict=True)),
        OUTPUTS,
        {
            "task": "webcam_solver",
            "names": list(ARKIT),
            "state": solver.layout.length,
            "controls": list(CONTROLS),
            "poses": list(POSES),
            "units": "pixels, millimetres, seconds, radians; weights, 1 is the whole shape",
            "version": __version__,
        },
        translations=TRANSLATIONS,
        optimize=False,
    )
