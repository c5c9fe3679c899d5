"""Examples before a camera: weights follow a smile that grows, and the solved example is drawn."""

from pathlib import Path

import numpy as np
import pytest
from planted_faces import GrowingSmile

from torchface.capture.anybody import WebcamControls, rig_examples
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.workflows.examples import live_examples
from torchface.workflows.examples.example_take import Method
from torchface.workflows.examples.live_examples import ExamplesSolver
from torchface.workflows.head_rotations import head_angles
from torchface.workflows.named_finders import NamedFinder


@pytest.mark.parametrize("method", ["all", "regional", "linear"])
def test_examples_follow_too_and_are_drawn(method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_examples, "load_finder", lambda name: NamedFinder(None, Path(name)))
    monkeypatch.setattr(live_examples, "LandmarkTracker", lambda finder, detector: GrowingSmile())
    monkeypatch.setattr(live_examples, "graph_detector", lambda: None)
    rig_examples(performer(texture=False)).save(tmp_path / "examples.json")
    solver, picture = ExamplesSolver([tmp_path / "examples.json"], method), np.zeros((240, 320, 3), np.uint8)
    frames = [solver.step(picture, 1 / 30, WebcamControls()) for _ in range(8)]
    assert not frames[0].seen
    smile = [float(frame.weights[ARKIT.index("mouthSmileLeft")]) for frame in frames]
    assert smile[-1] > smile[1] + (0.3 if method == "all" else 0.1)
    assert float(head_angles(frames[-1].rotation.double()).abs().max()) < 0.1
    drawn = frames[-1].drawn
    assert ((drawn[..., 0] > 150) & (drawn[..., 1] < 100)).sum() > 20  # the solved example's, red
    assert not picture.any()
