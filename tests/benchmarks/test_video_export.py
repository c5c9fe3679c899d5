"""The exported video solver beside ``torchface track`` on real videos, with the zoo's priors and a rig of nobody's."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig import VideoSettings
from torchface.cli import main
from torchface.io.camera_files import save_calibration
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_result import Tracked
from torchface.workflows.track.track_video import track_video

pytestmark = pytest.mark.real

PRIORS = {"prior": "shape_prior", "dynamics": "dynamics_prior"}


def played(session: onnxruntime.InferenceSession, tracked: Tracked) -> Tensor:
    """Weights (T,N) of the landmarks that ``track`` solved, each frame from the state of the one before."""
    names = [output.name for output in session.get_outputs()]
    state = {i.name: np.full(i.shape, np.nan, np.float32) for i in session.get_inputs() if "previous_" in i.name}
    weights = []
    for marks, trust in zip(tracked.landmarks.numpy(), tracked.reading.trust.numpy(), strict=True):
        found = session.run(names, {"landmarks": marks, "confidence": trust, **state})
        handed = dict(zip(names, found, strict=True))
        state = {name: handed[name.removeprefix("previous_")] for name in state}
        weights.append(torch.from_numpy(handed["weights"]))
    return torch.stack(weights)


@pytest.mark.parametrize("remembers", [False, True])
@pytest.mark.parametrize("film", ["single_face.mp4", "webcam/brother.mkv"])
def test_the_graph_gives_the_weights_of_track(
    data: Path, ict_folder: Path, tmp_path: Path, film: str, remembers: bool
) -> None:
    priors = PRIORS if remembers else {"prior": PRIORS["prior"]}
    settings = TrackSettings(**priors, part="face", overlay="none")
    track_video(data / "video" / film, ict_folder, tmp_path / "take", settings)
    # From the table: of the film itself track also counts what networks read of the expression, which no graph does.
    by_table = replace(settings, landmarks=tmp_path / "take" / "landmarks.csv")
    tracked = track_video(data / "video" / film, ict_folder, tmp_path / "table", by_table)
    camera, graph = tmp_path / "camera.toml", tmp_path / "solver.onnx"
    save_calibration(tracked.calibration, camera)
    given = ["--rig", f"{ict_folder}", "--part", "face", "--camera", f"{camera}", "--out", f"{graph}", "--quiet"]
    chosen = [word for name, model in priors.items() for word in (f"--{name}", model)]
    rate = ["--fps", f"{tracked.video.fps:g}", "--landmarks", f"{tmp_path}/take/landmarks.csv"]
    rate += ["--offsets", f"{tmp_path}/table/landmark_offsets.json"]
    main(["export", "video-solver", *given, *chosen, *rate])
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    usual = replace(VideoSettings.of_found_landmarks(remembers), relative_noise=tracked.offsets.noise)
    assert json.loads(metadata["settings"]) == asdict(usual)
    apart = played(session, tracked) - tracked.solution.weights
    square, largest = float(apart.square().mean().sqrt()), float(apart.abs().max())
    print(f"\n{film}, {len(apart)} frames: root mean square {square:.4f}, at most {largest:.3f}")
    # With a memory the solve itself is not sure of more: where the prior's energy has two valleys, a frame's choice
    # hangs on the last digits, and later frames go on from it.
    assert square < (0.03 if remembers else 0.02)
