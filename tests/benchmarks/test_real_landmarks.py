"""The video solver on landmarks of real people: jumps, offsets, bounds and lids, by prior and with offsets.

The landmarks are what MediaPipe found in six clips, which is another network's answer and no truth; each clip is solved
with ICT-FaceKit's mean head, which is none of these people, and with a head fitted to six of its frames.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.capture.own_rig import VideoSettings, VideoSolution, VideoSolver
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.landmark_offset_estimate import estimate_offsets
from torchface.capture.priors import DynamicsPrior, adapt_dynamics
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.io import load_rig
from torchface.io.rigs.ict_facekit import load_identity_modes
from torchface.modeling import FitSettings, HeadModel, MorphableModel, fit_images
from torchface.rig import BlendshapeRig
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, adaptive_filter
from torchface.workflows.named_priors import load_priors

pytestmark = [pytest.mark.real, pytest.mark.bench]

CLIPS = {
    "single_face": (640, 360, 30.0),
    "again": (640, 480, 30.0),
    "bird": (640, 480, 30.0),
    "book": (640, 480, 30.0),
    "brother": (640, 480, 30.0),
    "head_pose_male": (480, 270, 12.0),
}
JUMP, BOUND, OFTEN = 0.25, 0.999, 0.1


@dataclass(frozen=True, eq=False)
class Row:
    """What a solve of a clip is like: frames with a jump, error in pixels and without its fixed part, shapes often at
    their bound, slope of the lids' opening on the reference's, blink where the reference's eyes are shut."""

    frames: int
    jumps: int
    error: float
    varying: float
    bounds: int
    slope: float
    blink: float
    milliseconds: float


def opening(landmarks: Tensor) -> Tensor:
    """Of both eyes beside their distance, (T,)."""
    pairs = ((37, 41), (38, 40), (43, 47), (44, 46))
    apart = (landmarks[:, 36] - landmarks[:, 45]).norm(dim=1)
    return torch.stack([(landmarks[:, a] - landmarks[:, b]).norm(dim=1) for a, b in pairs]).mean(0) / apart


def projected(solver: VideoSolver, solution: VideoSolution) -> Tensor:
    """The rig's landmarks in the image, (T,68,2)."""
    weights, rotation, translation = (x.double() for x in (solution.weights, solution.rotation, solution.translation))
    K = solver.intrinsics.double()
    rows = solver.points.chosen(weights, rotation, translation, K)
    placed = solver.points.at(weights)[torch.arange(len(rows))[:, None], rows]
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    return image[..., :2] / image[..., 2:]


def measured(solver: VideoSolver, landmarks: Tensor, raw: Tensor) -> Row:
    begun = time.process_time()
    with torch.no_grad():
        solution = solver(landmarks)
    spent = (time.process_time() - begun) / len(landmarks)
    seen = projected(solver, solution)
    apart = (landmarks[:, 36] - landmarks[:, 45]).norm(dim=1)[:, None, None]
    off = (seen - landmarks) / apart
    left = (off - off.mean(0)) * apart
    reference, found = opening(raw), opening(seen)
    centred = reference - reference.mean()
    shut = reference < 0.5 * reference.median()
    blinks = [i for i, name in enumerate(solver.names) if name.startswith("eyeBlink")]
    return Row(
        len(landmarks),
        int((solution.weights.diff(dim=0).abs() > JUMP).any(1).sum()),
        float(solution.errors.median()),
        float(left.square().sum(-1).mean().sqrt()),
        int(((solution.weights > BOUND).double().mean(0) > OFTEN).sum()),
        float((centred * (found - found.mean())).sum() / centred.square().sum()),
        float(solution.weights[shut][:, blinks].mean()),
        1e3 * spent,
    )


def fitted(rig: BlendshapeRig, modes: Tensor, landmarks: Tensor, size: tuple[int, int]) -> BlendshapeRig:
    sizes = modes.flatten(1).norm(dim=1)
    model = HeadModel.on(rig.neutral, MorphableModel(rig.vertices, modes / sizes[:, None, None], sizes))
    chosen = landmarks[torch.linspace(0, len(landmarks) - 1, 6).round().long()]
    camera = assumed_calibration(*size).intrinsics
    fit = fit_images(model, rig, chosen, size, camera=camera, settings=FitSettings(transfers=0, texture_size=0))
    return BlendshapeRig(rig.neutral.with_vertices(fit.mesh.vertices), rig.deltas, rig.names)


def test_real_landmarks(data: Path, ict_folder: Path) -> None:
    """With offsets and the default settings of ``track`` the fixed part of the error goes and nothing jumps more."""
    rig = load_rig(ict_folder, part="face")
    modes = load_identity_modes(ict_folder, part="face").deltas
    references = np.load(data / "landmarks" / "mediapipe_68.npz")
    plain = zoo.get_model("shape_prior").renamed(rig.names)
    default = load_priors(rig, "shape_prior", None).shapes
    learned = zoo.get_model("dynamics_prior")
    assert isinstance(learned, DynamicsPrior)
    print(
        f"\n{'clip':16s}{'head':6s}{'way':24s}{'frames with jumps':>18s}{'px':>7s}{'varying':>9s}{'bounds':>8s}", end=""
    )
    print(f"{'lids':>7s}{'blink':>7s}{'ms':>7s}")
    totals: dict[str, list[Row]] = {}
    for clip, (width, height, fps) in CLIPS.items():
        raw = torch.from_numpy(references[clip]).double()
        landmarks = adaptive_filter(raw, LANDMARK_SETTINGS)
        calibration = assumed_calibration(width, height)
        for head, actor in (("mean", rig), ("fitted", fitted(rig, modes, raw, (width, height)))):
            apart = VideoSettings(pixel_noise=0.5, relative_noise=0.025, steps=5)
            walking = VideoSettings.of_found_landmarks(fps=fps)
            remembering = VideoSettings.of_found_landmarks(True, fps=fps)
            K, motion = calibration.intrinsics, adapt_dynamics(learned, rig.names, fps)
            ways = {
                "no prior, frames apart": VideoSolver(actor, None, K, settings=apart),
                "prior, frames apart": VideoSolver(actor, None, K, plain, settings=apart),
                "prior and dynamics": VideoSolver(actor, None, K, default, motion, remembering),
                "track without offsets": VideoSolver(actor, None, K, default, settings=walking),
            }
            for way in ("track without offsets", "prior and dynamics"):
                offsets = estimate_offsets(ways[way], landmarks)
                assert offsets is not None
                assert offsets.millimetres.shape == (LANDMARKS, 3)
                ways["track" if way[0] == "t" else "track with dynamics"] = ways[way].shifted(offsets)
            for way, one in ways.items():
                row = measured(one, landmarks, raw)
                totals.setdefault(way, []).append(row)
                print(f"{clip:16s}{head:6s}{way:24s}{row.jumps:11d} of {row.frames:3d}{row.error:7.2f}", end="")
                print(
                    f"{row.varying:9.2f}{row.bounds:8d}{row.slope:7.2f}{row.blink:7.2f}{row.milliseconds:7.1f}",
                    flush=True,
                )
    means = {way: sum(row.error for row in rows) / len(rows) for way, rows in totals.items()}
    jumps = {way: sum(row.jumps for row in rows) for way, rows in totals.items()}
    bounds = {way: sum(row.bounds for row in rows) for way, rows in totals.items()}
    for way in totals:
        print(
            f"{way:24s} {means[way]:.2f} px, {jumps[way]} frames with jumps, {bounds[way]} shapes often at their bound"
        )
    assert means["track"] < 0.6 * means["no prior, frames apart"]
    assert jumps["track"] < 0.2 * jumps["no prior, frames apart"]
    assert bounds["track"] < 0.5 * bounds["no prior, frames apart"]
