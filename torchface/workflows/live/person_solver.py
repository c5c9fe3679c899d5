"""What solves anybody's face: the webcam's graph, as the browser app runs it too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.onnx.webcam.webcam_session import WebcamSession
from torchface.progress import Progress
from torchface.workflows.live.solved_frames import LiveFrame
from torchface.workflows.webcam.webcam_graph import webcam_graph

_USUAL = 1 / 30  # seconds


class PersonSolver:
    """Solves frames for ARKit's weights.

    Args:
        session: runs the graph.
    """

    def __init__(self, session: WebcamSession) -> None:
        self._session = session
        self._ever = False

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self._session.names

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; see :class:`torchface.workflows.live.solved_frames.FaceSolver`."""
        self._session.controls = controls
        found = self._session.step(picture, _USUAL if interval is None else interval)
        solved = LiveFrame(
            found.weights, found.rotation, found.landmarks, found.iris, found.gaze, calibrated=found.calibrated
        )
        self._ever = (self._ever and not controls.reset) or solved.seen
        # Before the first face the graph's head looks anywhere.
        return solved if self._ever else replace(solved, rotation=torch.full((3, 3), torch.nan))


def person_solver(progress: Progress) -> PersonSolver:
    """A solver for whoever sits before a camera; the first time it is made, which takes a minute.

    Raises:
        FileFormatError: a model is damaged, or the cache cannot be written to.
    """
    return PersonSolver(WebcamSession(webcam_graph(progress)))
