"""A filmed performer, and what tracking gives of the film when it is killed and started again."""

import math
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from planted.light_stage import LightStageSettings, render_lit_video
from torchface import BlendshapeRig, save_rig
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io import save_calibration
from torchface.landmarks import FaceReading, LandmarkTracker
from torchface.rendering.point_light import PointLight
from torchface.synthetic import performer
from torchface.workflows.track import frame_readings
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_result import Tracked
from torchface.workflows.track.track_video import track_video

FRAMES = 11
PIECE = 4
QUICK = TrackSettings(overlay="none")


@dataclass(frozen=True)
class Filmed:
    """A film, its rig's file, and what was performed."""

    video: Path
    rig: Path
    camera: Path
    actor: BlendshapeRig
    weights: torch.Tensor
    landmarks: torch.Tensor
    rotation: torch.Tensor


@dataclass(frozen=True)
class Done:
    """What tracking gave; what lay in its folder when it was killed, and how many frames were tracked after that."""

    tracked: Tracked
    out: Path
    left: tuple[str, ...]
    steps: int


@pytest.fixture(scope="package")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    """The mean performer opens the jaw, smiles and raises the brows while the head turns."""
    folder = tmp_path_factory.mktemp("film")
    actor = performer(texture=True)
    weights = torch.zeros(FRAMES, len(actor.names))
    ramp = torch.linspace(0, 1, FRAMES)
    for name, size in {"jawOpen": 0.8, "browInnerUp": 0.9, "mouthSmileLeft": 0.7, "mouthSmileRight": 0.7}.items():
        weights[:, actor.names.index(name)] = size * (ramp if name == "jawOpen" else (math.pi * ramp).sin())
    light = PointLight(torch.full((3,), 0.35), torch.full((3,), 0.7), torch.tensor([-500.0, -700.0, 100.0]))
    settings = LightStageSettings(width=160, height=120, samples=1, turn=12.0)
    film = render_lit_video(
        folder / "film.avi", actor, weights, light, 30.0, torch.Generator().manual_seed(0), settings
    )
    save_rig(actor, folder / "rig.glb")
    intrinsics = film.cameras[0].intrinsics
    save_calibration(CameraCalibration(intrinsics, torch.zeros(5), 160, 120, 0.1), folder / "camera.toml")
    marks = actor.neutral.landmarks
    landmarks = torch.stack([
        camera.project(actor(weights[t : t + 1])[0, marks].double()) for t, camera in enumerate(film.cameras)
    ])  # fmt: skip
    rotation = torch.stack([camera.rotation for camera in film.cameras])
    return Filmed(
        folder / "film.avi", folder / "rig.glb", folder / "camera.toml", actor, weights, landmarks.float(), rotation
    )


@pytest.fixture(scope="package")
def done(filmed: Filmed, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The film tracked with everything, in pieces of a few frames; killed in the third piece and started again."""
    out = tmp_path_factory.mktemp("tracked") / "out"
    settings = TrackSettings(camera=filmed.camera)

    def killed(what: str, frames: int = 0, total: int = 0) -> None:
        if what == "tracking landmarks" and frames == 2 * PIECE + 2:
            raise KeyboardInterrupt

    steps = 0
    step = LandmarkTracker.step

    def counted(self: LandmarkTracker, frame: torch.Tensor) -> FaceReading:
        nonlocal steps
        steps += 1
        return step(self, frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_readings, "PIECE", PIECE)
        with pytest.raises(KeyboardInterrupt):
            track_video(filmed.video, filmed.rig, out, settings, killed)
        left = tuple(path.name for path in out.iterdir())
        patch.setattr(LandmarkTracker, "step", counted)
        tracked = track_video(filmed.video, filmed.rig, out, settings)
    return Done(tracked, out, left, steps)
