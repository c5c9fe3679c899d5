"""What solves anybody's face: the embedded performer's rig stands for theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer
from torchface.workflows.live.actor_solver import ActorSolver
from torchface.workflows.live.live_frames import FrameSource
from torchface.workflows.live.solved_frames import FaceSolver, LiveControls, LiveFrame
from torchface.workflows.track.track_models import load_track_models
from torchface.workflows.track.track_video import camera_of


class PersonSolver:
    """Solves frames for ARKit's weights.

    Args:
        solver: by any rig's names.
    """

    names = ARKIT

    def __init__(self, solver: FaceSolver) -> None:
        self._solver = solver
        self._matrix = mapping(solver.names, ARKIT)

    def step(self, picture: np.ndarray, interval: float | None, controls: LiveControls) -> LiveFrame:
        """Solves the next frame; see :class:`FaceSolver`."""
        solved = self._solver.step(picture, interval, controls)
        return replace(solved, weights=(controls.gain * (self._matrix @ solved.weights)).clamp(0, 1))


def person_solver(source: FrameSource) -> PersonSolver:
    """A solver for whoever sits before a camera.

    Raises:
        FileFormatError: a model is damaged.
    """
    rig = performer(texture=False)
    models = load_track_models(rig, fps=source.video.fps)
    return PersonSolver(ActorSolver(rig, models, camera_of(source.video, None)))
