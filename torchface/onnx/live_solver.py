"""The marker solve one frame at a time, as frames come in."""

from __future__ import annotations

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.onnx.corrective_graph import CorrectiveGraph
from torchface.onnx.corrective_model import corrective_model
from torchface.onnx.solver_graph import STEPS, SolverGraph
from torchface.onnx.solver_graph_export import choose_rho, random_frames
from torchface.onnx.solver_model import solver_model

_TRIAL_FRAMES = 128


class LiveMarkerSolver:
    """A ``MarkerSolver`` for frames that come in one at a time, each started from the one before.

    Runs ``SolverGraph`` in ONNX Runtime on one thread: a frame takes a fraction of a millisecond, also with markers
    missing, where the batch solver takes several. The weights are the graph's: above the exact least energy by some
    millionths.

    Args:
        solver: the rig, the attachment and the alignment.
    """

    def __init__(self, solver: MarkerSolver) -> None:
        solver = solver.cpu().float()
        if solver.activation is not None:
            made = corrective_model(CorrectiveGraph(solver))
        else:
            rho = choose_rho(solver, STEPS, random_frames(solver, _TRIAL_FRAMES))
            made = solver_model(SolverGraph(solver, rho=rho))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        # A thread that spins between frames would take a core from the application.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(
            made.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self.names, self.labels = solver.names, solver.labels
        self._weights = np.zeros((1, len(self.names)), np.float32)
        # The first run allocates; better before the first frame than in it.
        self._solve(np.full((1, len(self.labels), 3), np.nan, np.float32))

    def step(self, markers: Tensor) -> Tensor:
        """The weights (N,) of the next frame.

        Args:
            markers: (M,3), millimetres, in the order of ``labels``; NaN for not seen. Without a single marker the
                weights of the frame before stay.

        Raises:
            ShapeError: ``markers`` is not (M,3).
            ValueRangeError: a coordinate is infinite.
        """
        if markers.shape != (len(self.labels), 3):
            raise ShapeError(f"markers: found {tuple(markers.shape)}, expected ({len(self.labels)},3)")
        frame = markers.detach().cpu().float().numpy()[None]
        if np.isinf(frame).any():
            raise ValueRangeError("markers: found an infinite coordinate, expected millimetres, or NaN for not seen")
        self._weights = self._solve(frame)
        return torch.from_numpy(self._weights[0].copy())

    def reset(self) -> None:
        """Forgets the frame before, as at the start of another take."""
        self._weights = np.zeros_like(self._weights)

    def _solve(self, frame: np.ndarray) -> np.ndarray:
        (weights,) = self._session.run(None, {"markers": frame, "previous": self._weights})
        return np.asarray(weights)
