"""The webcam's solver alone as an ONNX graph, without the networks that read pictures."""

from dataclasses import replace

import onnx
import torch

from torchface import __version__
from torchface.capture.anybody import WebcamSolver
from torchface.capture.anybody.webcam_state import CONTROLS, POSES
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER, FaceReading
from torchface.onnx.exported_model import exported_model
from torchface.onnx.unrolled_operators import TRANSLATIONS
from torchface.onnx.webcam.webcam_model import WebcamAnswer, WebcamSolverGraph
from torchface.shape_names import ARKIT

INPUTS = (*READ_FOR_SOLVER, "size", "interval", "controls", "state")


def empty_reading() -> FaceReading:
    """What networks read of a picture without a face."""
    return replace(FaceReading.lost(), deviation=torch.zeros(68))


def webcam_solver_model(solver: WebcamSolver) -> onnx.ModelProto:
    """The model of a solver: ``INPUTS`` to ``WebcamAnswer._fields``.

    The metadata holds ``names`` (JSON list, of the weights), ``state`` (S), ``controls``, ``poses`` and ``version``.
    """
    reading = empty_reading()
    examples = [getattr(reading, name) for name in READ_FOR_SOLVER]
    examples += [torch.tensor([640.0, 480.0]), torch.tensor(1 / 30), torch.zeros(len(CONTROLS))]
    examples.append(torch.zeros(solver.layout.length))
    return exported_model(
        WebcamSolverGraph(solver),
        dict(zip(INPUTS, examples, strict=True)),
        WebcamAnswer._fields,
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
