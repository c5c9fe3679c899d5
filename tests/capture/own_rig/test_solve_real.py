"""Landmarks of a real face, found by OpenFace, on the real rig."""

from pathlib import Path

import pytest
import torch

from torchface.capture import ShapePrior, VideoSolver
from torchface.io import load_identity_modes, load_rig, load_take
from torchface.modeling import FitSettings, HeadModel, MorphableModel, fit_images
from torchface.rig import BlendshapeRig

pytestmark = pytest.mark.real


@pytest.mark.bench
def test_real_landmarks_move_the_real_rig(data: Path, ict_folder: Path, performances: list[Path]) -> None:
    rig = load_rig(ict_folder, part="face")
    takes = [rig.weights_from(load_take(path).weights).clamp(0, 1) for path in performances[:3]]
    landmarks = load_take(data / "landmarks" / "openface_100_frames.csv").landmarks.values
    modes = load_identity_modes(ict_folder, part="face").deltas[:12]
    sizes = modes.flatten(1).norm(dim=1)
    model = HeadModel.on(rig.neutral, MorphableModel(rig.vertices, modes / sizes[:, None, None], sizes))
    reach = landmarks[torch.isfinite(landmarks).all(-1)].amax(0)
    image_size = (int(1.2 * reach[0]), int(1.2 * reach[1]))
    fit = fit_images(model, rig, landmarks[:1], image_size, settings=FitSettings(transfers=0, texture_size=0))
    actor = BlendshapeRig(fit.mesh, rig.deltas, rig.names)
    prior = ShapePrior.fit(takes, rig.names)
    solver = VideoSolver(actor, rig.neutral.landmarks, fit.cameras[0].intrinsics, prior)
    solution = solver(landmarks[:40])
    eyes = float((landmarks[0, 36] - landmarks[0, 45]).norm())
    errors = solution.errors[solution.solved] / eyes
    still = (solution.weights < 1e-3).float().mean(0), (solution.weights > 0.999).float().mean(0)
    print(f"\n{eyes:.0f} px between the eyes, error {float(errors.mean()):.1%}, noise {fit.noise:.2f} px")
    print(f"on 0: {float(still[0].mean()):.0%} of all weights, on 1: {float(still[1].mean()):.1%}")
    print(f"shapes that move: {int((still[0] < 0.9).sum())} of {len(rig.names)}")
    assert float(errors.mean()) < 0.06
    assert float(still[0].mean()) < 0.75
    assert float(still[1].mean()) < 0.03
