"""``torchface train face_parts --out models/NAME``: a network that says which part of a face each pixel shows.

Learns from rendered people alone: ``--ict FaceXModel`` takes ICT-FaceKit's heads of real people beside the embedded
performers. 16,800 pictures take about 17 minutes of one core, 9,000 steps 50; a GPU is used if there is one. Killed and
started again it goes on.
"""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.landmarks.images.networks.part_network import PARTS, PartNetwork
from torchface.landmarks.images.networks.part_training import PartSettings, part_crops

from .model_cards import model_card
from .part_pictures import EACH, PART, PARTS_OF_FACES, SCENES, StoredPartPictures
from .recipe_settings import RenderedSettings
from .rendered_files import rendered_files
from .runner import Recipe, Run, recipe

_TEST_BATCH = 48


@dataclass(frozen=True, kw_only=True)
class Settings(RenderedSettings):
    """What the recipe does.

    Args:
        start: A network to go on from, by name or folder; a new one if absent.
        network: How the network is trained.
    """

    out: Path = Path("models/face_parts")
    pictures: int = 16_800
    held_out: int = 240
    folder: Path = Path("out/part_pictures")
    start: str | None = None
    network: PartSettings = field(default_factory=PartSettings)


@recipe
def train(settings: Settings, run: Run) -> PartNetwork:
    """Renders, trains, evaluates and saves."""
    settings.check_count(PART)
    first = None if settings.start is None else zoo.get_model(settings.start, PartNetwork)
    files = rendered_files(
        PARTS_OF_FACES, settings.folder, settings.pictures, settings.seed, settings.ict, settings.workers, run.progress
    )
    people = EACH * SCENES
    held_out = people * -(-settings.held_out // people)  # whole people
    learned = StoredPartPictures(files, held_out)
    model = PartNetwork.fit(learned, first, settings.network, run.progress, run.checkpoint, run.device, run.log)
    save(model, settings, overlaps(model, StoredPartPictures(files, 0, held_out)))
    return model


@torch.no_grad()
def overlaps(model: PartNetwork, pictures: StoredPartPictures) -> dict[str, float]:
    """Intersection over union of each part in crops as they are drawn for training, %."""
    generator, counts = torch.Generator().manual_seed(0), torch.zeros(len(PARTS), len(PARTS))
    for start in range(0, len(pictures), _TEST_BATCH):
        numbers = torch.arange(start, min(start + _TEST_BATCH, len(pictures)))
        images, parts, boxes = pictures[numbers]
        crops = part_crops(images, parts, boxes, generator, PartSettings())
        counts += _confusion(model(crops.images).argmax(1), crops.parts)
    both = counts.diagonal()
    shares = 100 * both / (counts.sum(0) + counts.sum(1) - both).clamp(min=1)
    return {f"intersection over union, %: {name}": float(share) for name, share in zip(PARTS, shares, strict=True)}


def _confusion(found: Tensor, truth: Tensor) -> Tensor:
    """How many pixels of each part (rows) are given each part (columns)."""
    known = truth >= 0
    return torch.bincount(truth[known] * len(PARTS) + found[known], minlength=len(PARTS) ** 2).view(len(PARTS), -1)


def save(model: PartNetwork, settings: Settings, metrics: dict[str, float]) -> None:
    """Writes the model with its card."""
    card = model_card(
        settings,
        licence="MIT",
        data=settings.rendered_data(),
        metrics=metrics,
        text=(
            "Reads an upright crop of 1.7 boxes of a face and says of each pixel whether it shows background, skin, "
            "hair, brows, eyes, lips, teeth, glasses, a hand or cloth. Beards are hair, hats are cloth, all between "
            "the lips is teeth, and clear lenses show what lies behind them. The figures are of rendered people "
            "that it had not seen."
        ),
    )
    zoo.save_model(
        model, settings.out, card, half=tuple(name for name, value in model.state_dict().items() if value.ndim > 1)
    )


RECIPE = Recipe(Settings, train, __doc__)

if __name__ == "__main__":
    RECIPE.main()
