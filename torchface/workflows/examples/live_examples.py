"""Solver of a person's frames by example expressions, as the dissertation's program, before a camera."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchface.capture.anybody import ExampleShapes, WebcamControls, character_matrix, paper_expressions
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT
from torchface.viz.figures.landmark_dots import with_dots
from torchface.workflows.examples.example_take import Method, averaged_examples, example_solver
from torchface.workflows.head_rotations import head_rotations
from torchface.workflows.live.live_frames import LiveFrame, planes
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, graph_detector, load_finder


class ExamplesSolver:
    """Solves frames by examples, of several people by their mean, as the dissertation's program, for ARKit's weights
    and a turned head."""

    names = ARKIT

    def __init__(
        self, examples: Sequence[Path], method: Method, landmarks: str | None = None, progress: Progress = silent
    ) -> None:
        shapes = averaged_examples([ExampleShapes.load(path) for path in examples])
        self._solver, self._before = example_solver(shapes, method), torch.zeros(0)
        self._matrix = character_matrix(shapes.names, ARKIT)
        turns = {one.name: (math.radians(one.yaw), 0.0, -math.radians(one.roll)) for one in paper_expressions()}
        self._turns = torch.tensor([turns.get(name, (0.0, 0.0, 0.0)) for name in shapes.names])
        progress(f"reading {landmarks or DEFAULT_LANDMARKS}")
        self._tracker = LandmarkTracker(load_finder(landmarks or DEFAULT_LANDMARKS).finder, detector=graph_detector())

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; of nobody anything is learned on the way."""
        frame = planes(picture)
        marks = self._tracker.step(frame).landmarks
        if not bool(torch.isfinite(marks).all()):
            return LiveFrame(torch.zeros(len(ARKIT)), torch.full((3, 3), torch.nan), marks)
        with torch.no_grad():
            fit = self._solver.fit(marks[None], self._before if len(self._before) else None)
            self._before, solved = fit.weights, self._solver.landmarks(fit)[0]
        angles = fit.weights[0] @ self._turns.to(fit.weights)
        angles[2] -= torch.atan2(fit.placement.matrix[0, 1, 0], fit.placement.matrix[0, 0, 0])
        weights = (self._matrix.to(fit.weights) @ fit.weights[0]).clamp(0, 1)
        drawn = with_dots(frame, marks, solved).permute(1, 2, 0).numpy()
        return LiveFrame(weights, head_rotations(angles), marks, drawn=drawn)
