"""A wrinkled database on the embedded performer, small enough for quick tests."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from torchface.enhancement import CapturedPerformance, EnhancementModel
from torchface.geometry.meshes.operators import vertex_normals
from torchface.synthetic.head.performer import performer


@dataclass(frozen=True, eq=False)
class Database:
    """Smooth and wrinkled frames (K,V,3) of one mesh, and sequences (K,)."""

    neutral: Tensor
    faces: Tensor
    smooth: Tensor
    frames: Tensor
    sequences: Tensor
    landmarks: Tensor


@pytest.fixture(scope="session")
def database() -> Database:
    """Four sequences of nine frames, neutral to an extreme and back, with waves that grow with the displacement."""
    rig = performer(texture=False)
    chosen = ("browInnerUp", "mouthSmileLeft", "mouthSmileRight", "mouthPucker", "noseSneerLeft", "eyeBlinkRight")
    deltas = rig.deltas[[rig.names.index(name) for name in chosen]]
    extremes = torch.tensor(
        [[1, 0.5, 0, 0, 0, 0], [0, 1, 0.8, 0, 0.4, 0], [0.3, 0, 0, 1, 0, 0], [0, 0, 0.6, 0, 1.0, 0.9]]
    )
    course = torch.linspace(0, torch.pi, 9).sin()
    weights = (course[None, :, None] * extremes[:, None]).flatten(0, 1)
    moved = torch.einsum("kn,nvc->kvc", weights, deltas)
    neutral, faces = rig.neutral.vertices, rig.neutral.faces
    smooth = neutral + moved
    waves = 0.1 * (2.1 * neutral[:, 1]).sin() * moved.norm(dim=-1)
    frames = smooth + waves[..., None] * vertex_normals(smooth, faces)
    return Database(neutral, faces, smooth, frames, torch.arange(4).repeat_interleave(9), rig.neutral.landmarks)


@pytest.fixture(scope="session")
def model(database: Database) -> EnhancementModel:
    """Learned of the database with as many components as frames."""
    return EnhancementModel.fit(
        CapturedPerformance(database.frames, database.faces, database.sequences, database.neutral),
        rank=36,
        patch_size=20,
    )
