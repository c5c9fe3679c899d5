"""``torchface train eye_network --out models/NAME``: a network that reads lids and irises off crops of eyes.

Learns from rendered people alone: ``--ict FaceXModel`` takes ICT-FaceKit's heads of real people beside the embedded
performers. 14,000 pictures of two eyes take about 25 minutes of one core, 6,000 steps half an hour; a GPU is used if
there is one. Killed and started again it goes on.
"""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.landmarks.images.networks.eye_augmentation import EyeAugmentation, augmented_eyes
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.eye_training import EyeSettings

from .eye_pictures import EACH, EYES, PART, StoredEyePictures
from .model_cards import model_card
from .recipe_settings import RenderedSettings
from .rendered_files import rendered_files
from .runner import Recipe, Run, recipe

_TEST_BATCH = 100
_SIZES = {"600": 1.0, "120": 0.5, "60": 0.25}
"""Sides of faces' boxes, pixels, and pixels of such pictures in one of the crop."""


@dataclass(frozen=True, kw_only=True)
class Settings(RenderedSettings):
    """What the recipe does.

    Args:
        network: How the network is trained.
    """

    out: Path = Path("models/eye_network")
    pictures: int = 14_000
    held_out: int = 400
    folder: Path = Path("out/eye_pictures")
    network: EyeSettings = field(default_factory=EyeSettings)


@recipe
def train(settings: Settings, run: Run) -> EyeNetwork:
    """Renders, trains, evaluates and saves."""
    progress = run.progress
    settings.check_count(PART)
    files = rendered_files(
        EYES, settings.folder, settings.pictures, settings.seed, settings.ict, settings.workers, progress
    )
    held_out = EACH * -(-settings.held_out // EACH)  # whole people
    learned = StoredEyePictures(files, held_out)
    model = EyeNetwork.fit(learned, None, settings.network, progress, run.checkpoint, run.device, run.log)
    save(model, settings, evaluate(model, StoredEyePictures(files, 0, held_out)))
    return model


def evaluate(model: EyeNetwork, pictures: StoredEyePictures) -> dict[str, float]:
    """What the model does on both eyes of pictures of several sizes, blurred, noisy and compressed as in training."""
    metrics: dict[str, float] = {}
    for name, size in _SIZES.items():
        given = EyeAugmentation(turn=6, scale=0.1, shift=0.06, hidden=0, absent=0, far=1, sizes=(size, size))
        metrics |= {
            f"faces of {name} pixels: {what}": value for what, value in measures(model, pictures, given).items()
        }
    return metrics


@torch.no_grad()
def measures(model: EyeNetwork, pictures: StoredEyePictures, augmentation: EyeAugmentation) -> dict[str, float]:
    """Of eyes that nothing hides: how well the lids' gap is measured, how far off irises are, which are shut."""
    generator = torch.Generator().manual_seed(0)
    gaps, irises, shut, visible = [], [], [], []
    for start in range(0, len(pictures), _TEST_BATCH):
        part = pictures.some(torch.arange(start, min(start + _TEST_BATCH, len(pictures))))
        for eye in range(2):
            eyes = torch.full((len(part),), eye)
            crops = augmented_eyes(part.rgba, part.labels, eyes, model.width, model.height, generator, augmentation)
            read = model(crops.images)
            width = (crops.points[:, 0] - crops.points[:, 3]).norm(dim=1)
            gaps.append(torch.stack([_gap(read.landmarks), _gap(crops.points)], 1))
            off = (read.iris - crops.points[:, 6]).norm(dim=1) / width
            irises.append(torch.where(crops.seen[:, 6] > 0, off, torch.nan))
            shut.append(torch.stack([read.closed, crops.closed], 1))
            visible.append(crops.visibility > 0.9)
    seen = torch.cat(visible)
    gap, closed = torch.cat(gaps)[seen], torch.cat(shut)[seen]
    sure = (closed[:, 1] < 0.1) | (closed[:, 1] > 0.9)
    called, is_shut = closed[sure, 0] > 0.5, closed[sure, 1] > 0.5
    both = (called & is_shut).sum()
    spread = torch.cov(gap.T)  # of gaps found and true
    return {
        "lid gap, correlation": float(spread[0, 1] / (spread[0, 0] * spread[1, 1]).sqrt()),
        "lid gap, slope": float(spread[0, 1] / spread[1, 1]),
        "irises, median error, % of the eye's width": 100 * float(torch.cat(irises)[seen].nanmedian()),
        "shut eyes found, %": 100 * float(both / is_shut.sum().clamp(min=1)),
        "eyes called shut that are, %": 100 * float(both / called.sum().clamp(min=1)),
    }


def _gap(points: Tensor) -> Tensor:
    """Mean distance (B,) of the upper from the lower lid's landmarks down the crop, of points (B,6,2)."""
    return (points[:, [5, 4], 1] - points[:, [1, 2], 1]).mean(1)


def save(model: EyeNetwork, settings: Settings, metrics: dict[str, float]) -> None:
    """Writes the model with its card."""
    card = model_card(
        settings,
        licence="MIT",
        data=settings.rendered_data("both eyes of "),
        metrics=metrics,
        text=(
            "Reads an upright crop of a right eye, or of a left one in a mirror: six landmarks of the lids and the "
            "iris's centre with the deviation to be expected of each, how far the eye is open, whether it is shut and "
            "whether something hides it. Good for faces within 50 degrees of frontal, from 50 pixels a box; below 100 "
            "pixels an eye has a dozen, and half-closed lids are hard to tell from looking down. The figures are of "
            "rendered people that it had not seen; tests/benchmarks/test_real_faces.py measures it on real ones."
        ),
    )
    zoo.save_model(
        model, settings.out, card, half=tuple(name for name, value in model.state_dict().items() if value.ndim > 1)
    )


RECIPE = Recipe(Settings, train, __doc__)

if __name__ == "__main__":
    RECIPE.main()
