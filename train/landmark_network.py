"""``torchface train landmark_network --out models/NAME``: a network that finds 68 landmarks in pictures of faces.

Learns from rendered people alone: ``--ict FaceXModel`` takes ICT-FaceKit's heads of real people beside the embedded
performers. Pictures stay in files, of which a batch is read at a time. 15,000 pictures take about 50 minutes of one
core, 8,000 steps two hours; a GPU is used if there is one. Killed and started again it goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import ValueRangeError
from torchface.landmarks import LandmarkNetwork, NetworkSettings
from torchface.landmarks.images.ibug_68 import INNER
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings, augmented

from .face_pictures import EACH, PART, StoredPictures, picture_files
from .model_cards import model_card
from .recipe_settings import ANY_DEVICE, RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe

_TEST_BATCH = 64
_LIDS = ((37, 41), (38, 40), (43, 47), (44, 46))


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        pictures: How many to render.
        held_out: Of them, the last, of people whom it does not learn from, kept for the test.
        folder: Where pictures are kept, for other recipes too.
        ict: ICT-FaceKit's FaceXModel folder; embedded performers alone without.
        workers: Processes that render.
        network: How the network is trained.
    """

    out: Path = Path("models/landmark_network")
    pictures: int = 15_000
    held_out: int = 480
    folder: Path = Path("out/face_pictures")
    ict: Path | None = None
    seed: int = 1
    workers: int = 2
    network: NetworkSettings = field(default_factory=NetworkSettings)

    devices: ClassVar[tuple[str, ...]] = ANY_DEVICE


@recipe
def train(settings: Settings, run: Run) -> LandmarkNetwork:
    """Renders, trains, evaluates and saves.

    Raises:
        ValueRangeError: fewer pictures than are held out and a part more.
    """
    progress = run.progress
    if settings.pictures < settings.held_out + PART:
        raise ValueRangeError(
            f"pictures: found {settings.pictures}, expected {settings.held_out} to hold out and {PART} more at least"
        )
    files = picture_files(settings.folder, settings.pictures, settings.seed, settings.ict, settings.workers, progress)
    pictures = StoredPictures(files)
    count = EACH * ((len(pictures) - settings.held_out) // EACH)  # whole people
    learned = StoredPictures(files, count)
    model = LandmarkNetwork.fit(learned, None, settings.network, progress, run.checkpoint, run.device, run.log)
    save(model, settings, evaluate(model, pictures, count))
    return model


@torch.no_grad()
def evaluate(model: LandmarkNetwork, pictures: StoredPictures, first: int) -> dict[str, float]:
    """What the model does on pictures from a number on, augmented as in training, but none hidden or absent."""
    plain = AugmentationSettings(turn=8.0, hidden=0.0, absent=0.0)
    generator = torch.Generator().manual_seed(0)
    found, truth, visible = [], [], []
    for start in range(first, len(pictures), _TEST_BATCH):
        numbers = torch.arange(start, min(start + _TEST_BATCH, len(pictures)))
        rgba, landmarks, seen = pictures[numbers]
        crops = augmented(rgba, landmarks, seen, model.size, model.margin, generator, plain)
        found.append(model(crops.images).landmarks)
        truth.append(crops.landmarks)
        visible.append(crops.visible)
    return measures(torch.cat(found), torch.cat(truth), torch.cat(visible))


def measures(found: Tensor, truth: Tensor, visible: Tensor) -> dict[str, float]:
    """Errors of landmarks (M,68,2) that can be seen (M,68), and how far the lids' opening is measured.

    The opening is the mean distance of two pairs of lid landmarks; slope and correlation are those of what was found
    against the truth.
    """
    eyes = (truth[:, 36] - truth[:, 45]).norm(dim=-1)
    frontal = eyes > 0.8 * eyes.median()  # far eyes of turned heads are hardly apart
    errors = (found - truth).norm(dim=-1)[:, INNER] / eyes[:, None]
    weight = visible[:, INNER] * frontal[:, None]

    def opened(points: Tensor) -> Tensor:
        return torch.stack([(points[:, a] - points[:, b]).norm(dim=-1) for a, b in _LIDS], 1)[frontal].flatten()

    read, true = opened(found), opened(truth)
    both = torch.cov(torch.stack([true, read]))
    return {
        "mean error of inner landmarks, % of the distance of the eyes' outer corners": 100
        * float((errors * weight).sum() / weight.sum()),
        "lid opening, correlation": float(both[0, 1] / (both[0, 0] * both[1, 1]).sqrt()),
        "lid opening, slope": float(both[0, 1] / both[0, 0]),
    }


def save(model: LandmarkNetwork, settings: Settings, metrics: dict[str, float]) -> None:
    """Writes the model with its card."""
    heads = "embedded performers" if settings.ict is None else "ICT-FaceKit's heads (MIT) and embedded performers"
    card = model_card(
        settings,
        licence="MIT",
        data=f"{settings.pictures} rendered pictures of {heads}; no person's photograph.",
        metrics=metrics,
        text=(
            "iBUG's 68 landmarks of a face in a crop of a colour or grey image, with the deviation to be expected of "
            "each, whether something hides it, and whether there is a face at all. Good for faces within 60 degrees of "
            "frontal, from 24 pixels a box, at any roll that the crop is turned by. The figures are of rendered people "
            "that it had not seen; tests/benchmarks/test_real_faces.py measures it on photographs."
        ),
    )
    zoo.save_model(
        model, settings.out, card, half=tuple(name for name, value in model.state_dict().items() if value.ndim > 1)
    )


RECIPE = Recipe(
    Settings, train, __doc__, lambda settings, _: metric_lines(zoo.describe(settings.out.resolve()).metrics)
)

if __name__ == "__main__":
    RECIPE.main()
