"""A finder by name in the place of the webcam's graph: the same solver, on what a tracker reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchface.capture.anybody import WebcamControls
from torchface.errors import NameMismatchError
from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.workflows.live import finder_solver
from torchface.workflows.live.finder_solver import FinderSolver
from torchface.workflows.named_finders import NamedFinder


class Planted:
    """Reads a smile that grows, of the embedded performer straight before the camera; no face at first."""

    def __init__(self) -> None:
        self.number = -1

    def step(self, image: torch.Tensor) -> FaceReading:
        self.number += 1
        if self.number == 0:
            return FaceReading.lost()
        rig, sure = performer(texture=False), torch.ones(68)
        weights = torch.zeros(1, len(rig.names))
        weights[0, rig.index(["mouthSmileLeft", "mouthSmileRight"])] = min(0.1 * self.number, 0.8)
        head = rig(weights)[0, rig.neutral.landmarks] * torch.tensor([1.0, -1, -1]) + torch.tensor([0.0, 0, 500])
        width, height = image.shape[2], image.shape[1]
        pixels = width * head[:, :2] / head[:, 2:] + 0.5 * (torch.tensor([width, height]) - 1)
        return FaceReading(pixels, 0.5 * sure, sure, sure[0])


def test_weights_follow_what_the_finder_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finder_solver, "load_finder", lambda name: NamedFinder(None, Path(name)))  # type: ignore[arg-type]
    monkeypatch.setattr(finder_solver, "LandmarkTracker", lambda finder, detector: Planted())
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
