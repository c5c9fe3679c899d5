"""A finder by name in the place of the webcam's graph: the same solver, on what a tracker reads."""

from pathlib import Path

import numpy as np
import pytest
import torch
from planted_faces import GrowingSmile

from torchface.capture.anybody import WebcamControls
from torchface.errors import NameMismatchError
from torchface.shape_names import ARKIT
from torchface.workflows.live import finder_solver
from torchface.workflows.live.finder_solver import FinderSolver
from torchface.workflows.named_finders import NamedFinder


def test_weights_follow_what_the_finder_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finder_solver, "load_finder", lambda name: NamedFinder(None, Path(name)))
    monkeypatch.setattr(finder_solver, "LandmarkTracker", lambda finder, detector: GrowingSmile())
    monkeypatch.setattr(finder_solver, "graph_detector", lambda: None)
    solver, picture = FinderSolver("planted.onnx"), np.zeros((240, 320, 3), np.uint8)
    first = solver.step(picture, None, WebcamControls())
    assert not first.seen
    assert bool(first.rotation.isnan().all())
    frames = [solver.step(picture, 1 / 30, WebcamControls()) for _ in range(14)]
    smile = torch.stack([frame.weights for frame in frames])[:, ARKIT.index("mouthSmileLeft")]
    assert frames[-1].seen
    assert float(smile[-1]) > float(smile[0]) + 0.25
    assert float(frames[-1].weights[ARKIT.index("jawOpen")]) < 0.15


def test_a_table_finds_nothing_as_the_face_moves() -> None:
    with pytest.raises(NameMismatchError, match="a table of landmarks"):
        FinderSolver("landmarks.csv")
