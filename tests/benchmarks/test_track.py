"""What a filmed performer comes back as through ``torchface track``: landmarks as they are found, priors on and off."""

from pathlib import Path

import torch

from planted.light_stage import LightStageSettings, render_lit_video
from torchface import Take, Track, save_rig
from torchface.evaluation import weight_jitter
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io.camera_files import save_calibration
from torchface.io.weights.weight_csv import save_weights_csv
from torchface.rendering.point_light import PointLight
from torchface.synthetic.head.performer import performer
from torchface.synthetic.stages.weight_curves import perform
from torchface.workflows.evaluate.compare_with_truth import EvaluationSettings, evaluate
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_video import track_video

FRAMES, FPS = 150, 60.0
WIDTH, HEIGHT = 320, 240
RUNS = {
    "no prior": TrackSettings(overlay="none"),
    "shape prior": TrackSettings(overlay="none", prior="shape_prior"),
    "shape and dynamics": TrackSettings(overlay="none", prior="shape_prior", dynamics="dynamics_prior"),
    "whole take": TrackSettings(overlay="none", prior="shape_prior", dynamics="dynamics_prior", whole_take=True),
}


def filmed(folder: Path, seed: int) -> None:
    """The mean performer, a made-up performance, a head that turns by 22 degrees, 120 pixels across the face."""
    actor, generator = performer(), torch.Generator().manual_seed(seed)
    track = perform(FRAMES, generator, FPS).weights
    assert track is not None
    weights = actor.weights_from(track)
    light = PointLight(torch.full((3,), 0.35), torch.full((3,), 0.7), torch.tensor([-500.0, -700.0, 100.0]))
    settings = LightStageSettings(width=WIDTH, height=HEIGHT, samples=1)
    film = render_lit_video(folder / "film.mp4", actor, weights, light, FPS, generator, settings)
    save_rig(actor, folder / "rig.glb")
    save_weights_csv(Take(FPS, weights=Track(actor.names, weights[..., None])), folder / "true.csv")
    intrinsics = film.cameras[0].intrinsics
    save_calibration(CameraCalibration(intrinsics, torch.zeros(5), WIDTH, HEIGHT, 0.1), folder / "camera.toml")


def test_priors_on_found_landmarks(tmp_path: Path) -> None:
    print(f"\n{'':20} face mm   95 %  mouth mm  weights  jitter  weights a second")
    errors: dict[str, list[float]] = {name: [] for name in RUNS}
    for seed in (31, 32):
        folder = tmp_path / str(seed)
        folder.mkdir()
        filmed(folder, seed)
        for name, settings in RUNS.items():
            settings = TrackSettings(**{**vars(settings), "camera": folder / "camera.toml"})
            tracked = track_video(folder / "film.mp4", folder / "rig.glb", folder / "out", settings)
            found = evaluate(
                folder / "out" / "weights.csv",
                [folder / "true.csv"],
                folder / "evaluation",
                EvaluationSettings(rig=folder / "rig.glb"),
            )
            assert found.shapes is not None
            face, mouth = found.regions["face"], found.regions["round the mouth"]
            rate = FRAMES / tracked.seconds["weights"]
            errors[name].append(face.mean)
            weights, jitter = float(found.shapes.error.mean.mean()), weight_jitter(tracked.solution.weights)
            print(
                f"{name:20} {face.mean:7.3f} {face.percentile_95:6.2f}  {mouth.mean:8.3f}  "
                f"{weights:7.4f} {jitter:7.4f} {rate:10.0f}"
            )
    assert sum(errors["shape prior"]) < 0.8 * sum(errors["no prior"])
