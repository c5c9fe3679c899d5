"""A small actor: the performer's face with folds that deepen as it moves, learned, and a take of it in every form."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Mesh, Take, Track, save_rig, save_take, zoo
from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.io import MeshSequenceWriter
from torchface.progress import silent
from torchface.synthetic import performer
from torchface.synthetic.stages import place_markers
from torchface.workflows.enhance.coarse_input import InputSettings, read_coarse

FPS = 30.0
FRAMES = 12


@dataclass(frozen=True, eq=False)
class Actor:
    """Files of one actor."""

    model: str  # name of the folder of the learned model
    rig: BlendshapeRig  # coarse, of the model's topology
    mesh: Mesh  # at rest
    weights: Tensor  # of the take, (T,N), from rest
    attachment: Attachment  # of 60 markers on the rig
    folder: Path  # of all files

    @property
    def frames(self) -> Tensor:
        """The take's meshes, coarse."""
        return self.rig(self.weights)


def folded(frames: Tensor, neutral: Tensor) -> Tensor:
    """Frames with folds across the face that deepen with the motion below them."""
    amount = (frames - neutral).norm(dim=-1, keepdim=True).clamp(max=6.0) / 6
    return frames + amount * 0.4 * torch.sin(neutral[:, 1:2]) * torch.tensor([0.0, 0.0, 1.0])


def coarse(actor: Actor, path: Path, state: Path, **given: Any) -> Any:
    return read_coarse(path, actor.mesh, InputSettings(**given), state, silent)


def written(path: Path, frames: Tensor, faces: Tensor) -> Path:
    with MeshSequenceWriter(path, len(frames), frames.shape[1], faces) as writer:
        writer.append(frames)
    return path


def shuffled(actor: Actor) -> tuple[Tensor, Tensor]:
    """Another order of the vertices, and the triangles in it."""
    order = torch.randperm(len(actor.mesh.vertices), generator=torch.Generator().manual_seed(1))
    return order, order.argsort()[actor.mesh.faces]


@pytest.fixture(scope="package")
def actor(tmp_path_factory: pytest.TempPathFactory) -> Actor:
    folder = tmp_path_factory.mktemp("actor")
    whole = performer(texture=False)
    rig = whole.part(whole.neutral.annotations.regions["face"])
    generator = torch.Generator().manual_seed(0)
    extremes = torch.rand(4, len(rig.names), generator=generator) ** 5
    ramp = torch.tensor([0.0, 0.5, 1.0, 0.5])
    learned = (extremes[:, None] * ramp[:, None]).flatten(0, 1)
    with torch.no_grad():
        database = folded(rig(learned), rig.vertices)
    sequences = torch.arange(4).repeat_interleave(4)
    model = EnhancementModel.fit(
        CapturedPerformance(database, rig.neutral.faces, sequences, rig.vertices), EnhancementSettings(fps=FPS), rank=8
    )
    zoo.save_model(model, folder / "model", zoo.ModelCard("MIT", "made", {}, "here"))
    weights = torch.linspace(0, 1, FRAMES)[:, None] * (0.6 * extremes[0] + 0.4 * extremes[1])
    attachment = place_markers(rig, 60)
    save_rig(rig, folder / "rig.glb")
    attachment.save(folder / "attachment.json")
    save_take(Take(FPS, weights=Track(rig.names, weights[..., None])), folder / "weights.csv")
    return Actor(str(folder / "model"), rig, rig.neutral, weights, attachment, folder)
