"""The exported video solver is the one of ``torchface track``: on what that finds in a video it gives its weights."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface.capture.video import VideoSettings
from torchface.cli import main
from torchface.io.cameras import save_calibration
from torchface.workflows.track import TrackSettings, track_video
from torchface.workflows.track_result import Tracked

pytestmark = [pytest.mark.real, pytest.mark.slow]

PRIOR = "shape_prior"


def played(session: onnxruntime.InferenceSession, tracked: Tracked) -> Tensor:
    """Weights (T,N) of the landmarks that ``track`` solved, each frame from the state of the one before."""
    names = [output.name for output in session.get_outputs()]
    state = {i.name: np.full(i.shape, np.nan, np.float32) for i in session.get_inputs() if "previous_" in i.name}
    weights = []
    for marks, trust in zip(tracked.pinhole.numpy(), tracked.frames.confidence.numpy(), strict=True):
        found = session.run(names, {"landmarks": marks, "confidence": trust, **state})
        handed = dict(zip(names, found, strict=True))
        state = {name: handed[name.removeprefix("previous_")] for name in state}
        weights.append(torch.from_numpy(handed["weights"]))
    return torch.stack(weights)


def test_the_graph_gives_the_weights_of_track(data: Path, ict_folder: Path, tmp_path: Path) -> None:
    """A face 60 pixels wide before a webcam, a rig of nobody's; with a dynamics prior too: see the benchmarks."""
    settings = TrackSettings(prior=PRIOR, part="face", overlay=False)
    tracked = track_video(data / "video" / "webcam" / "brother.mkv", ict_folder, tmp_path / "take", settings)
    camera, graph = tmp_path / "camera.toml", tmp_path / "solver.onnx"
    save_calibration(tracked.calibration, camera)
    given = ["--rig", f"{ict_folder}", "--part", "face", "--camera", f"{camera}", "--out", f"{graph}", "--quiet"]
    main(["export", "video-solver", *given, "--prior", PRIOR, "--landmarks", f"{tmp_path}/take/landmarks.csv"])
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    assert json.loads(metadata["settings"]) == asdict(VideoSettings.of_found_landmarks())
    apart = played(session, tracked) - tracked.solution.weights
    assert float(apart.square().mean().sqrt()) < 0.01
