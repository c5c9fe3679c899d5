"""``torchface train appearance --data DIR --out models/NAME``: an actor's appearance, to refine landmarks by.

The folder holds images with a ``.pts`` beside each, as ``torchface annotate`` saves them.
"""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface import TorchfaceError, zoo
from torchface.landmarks import AppearanceModel, AppearanceSettings
from torchface.landmarks.images.appearance.annotated_frames import AnnotatedFrame, load_annotated_frames
from torchface.landmarks.images.appearance.appearance_level import sample_pixels
from torchface.landmarks.images.appearance.shape_modes import planar_pose
from torchface.rendering.compositing import caption, save_rendered_image, sheet

from .model_cards import model_card
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, recipe

_OFF = 0.03
_TO_REST = 0.5
_DOT = 2
_ROOM = 0.75


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        data: Folder of images with iBUG's 68 landmarks as .pts beside each.
        folds: How many trial models are measured, each on the share of the frames that it has not seen; at most one a
            frame; 0 measures nothing.
        model: How the model is made and fitted.
    """

    data: Path
    out: Path = Path("models/appearance")
    folds: int = 15
    model: AppearanceSettings = field(default_factory=AppearanceSettings)


@dataclass(frozen=True, eq=False)
class Trained:
    """A model, and the errors of frames that trial models had not seen: at the start and refined, (M,), of the eyes'
    distance; empty where nothing was measured."""

    model: AppearanceModel
    start_errors: Tensor
    errors: Tensor


@recipe
def train(settings: Settings, run: Run) -> Trained:
    """Loads, splits, fits, evaluates on left-out frames, fits on all, saves."""
    progress = run.progress
    frames = load_annotated_frames(settings.data)
    if settings.folds < 0 or settings.folds == 1:
        raise TorchfaceError(f"--folds: found {settings.folds}, expected 0, or 2 and more")
    progress(f"{len(frames)} annotated frames")
    landmarks = torch.stack([frame.landmarks for frame in frames])
    folds = min(settings.folds, len(frames))
    before, after, refined = torch.zeros(0), torch.zeros(0), landmarks.clone()
    if folds >= 2:
        start = drawn_starts(landmarks, settings.seed)
        for fold in range(folds):
            rows = torch.arange(len(frames)) % folds == fold
            learn = [frame for frame, left_out in zip(frames, rows.tolist(), strict=True) if not left_out]
            trial = AppearanceModel.fit([frame.image for frame in learn], landmarks[~rows], settings.model)
            for row in torch.nonzero(rows)[:, 0].tolist():  # images differ in size
                refined[row] = trial(frames[row].image[None], start[row : row + 1])[0]
            progress("measuring on left-out frames", fold + 1, folds)
        before, after = relative_errors(start, landmarks), relative_errors(refined, landmarks)
    model = AppearanceModel.fit([frame.image for frame in frames], landmarks, settings.model, progress)
    save(model, settings, frames, before, after)
    if len(after):
        pictures = [_picture(frame, shape) for frame, shape in zip(frames, refined, strict=True)]
        save_rendered_image(sheet(pictures[:15], 5), settings.out / "held_out.png")
    return Trained(model, before, after)


def drawn_starts(landmarks: Tensor, seed: int) -> Tensor:
    """Starts (M,68,2) like those of a detector that hardly knows extreme faces: half of the way to the usual face, and
    off by some hundredths of the eyes' distance."""
    generator = torch.Generator().manual_seed(seed)
    usual = landmarks.median(0).values
    usual = usual - usual.mean(0)
    start = torch.lerp(landmarks, planar_pose(usual, landmarks).apply(usual), _TO_REST)
    unit = (landmarks[:, 36] - landmarks[:, 45]).norm(dim=1)[:, None, None]
    shift = _OFF * torch.randn(len(landmarks), 1, 2, generator=generator)
    return start + unit * (shift + 0.5 * _OFF * torch.randn(landmarks.shape, generator=generator))


def relative_errors(found: Tensor, truth: Tensor) -> Tensor:
    """Mean distance of landmarks (M,68,2) of the distance between the eyes' outer corners, (M,)."""
    return (found - truth).norm(dim=2).mean(1) / (truth[:, 36] - truth[:, 45]).norm(dim=1)


def save(
    model: AppearanceModel, settings: Settings, frames: list[AnnotatedFrame], before: Tensor, after: Tensor
) -> None:
    """Writes the model with its effective settings, measured errors and card."""
    metrics = {}
    if len(after):
        metrics = {
            "left_out_error": float(after.mean()),
            "left_out_worst": float(after.max()),
            "left_out_start": float(before.mean()),
        }
    card = model_card(
        settings,
        licence="private: holds the looks of the person it learned from",
        data=f"{len(frames)} annotated frames of {settings.data.name}.",
        metrics=metrics,
        text=(
            "Refines the 68 landmarks of one person, from the start that a detector gives. Errors are mean distances "
            "of landmarks in frames left out of trial models, of the distance between the eyes' outer corners; the "
            "starts lie half of the way to the person's usual face and are off by some hundredths besides. What only "
            "one frame shows, its trial model has never seen: on the video itself errors are smaller."
        ),
    )
    zoo.save_model(model, settings.out, card)


def _picture(frame: AnnotatedFrame, found: Tensor) -> Tensor:
    """A face with its annotated landmarks in green and those refined in red, cut out and named."""
    image = frame.image.clone()
    for points, color in ((frame.landmarks, (0.2, 1.0, 0.2)), (found, (1.0, 0.2, 0.1))):
        x, y = points.round().long().unbind(1)
        for dx in range(_DOT):
            for dy in range(_DOT):
                columns, rows = (x + dx).clamp(0, image.shape[2] - 1), (y + dy).clamp(0, image.shape[1] - 1)
                image[:, rows, columns] = torch.tensor(color)[:, None]
    low, high = frame.landmarks.amin(0), frame.landmarks.amax(0)
    x, y = ((low + high) / 2).tolist()
    reach = _ROOM * float((high - low).max())
    rows = torch.linspace(y - reach, y + reach, 300)
    columns = torch.linspace(x - 0.8 * reach, x + 0.8 * reach, 240)
    places = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1).reshape(1, -1, 2)
    return caption(sample_pixels(image[None], places)[0].unflatten(1, (300, 240)), frame.name)


def _lines(_: Settings, trained: Trained) -> list[str]:
    if not len(trained.errors):
        return []
    return [
        f"left-out frames: {trained.errors.mean():.4f} of the eyes' distance, {trained.errors.max():.4f} worst",
        f"at the start:    {trained.start_errors.mean():.4f}",
    ]


RECIPE = Recipe(Settings, train, __doc__, _lines)

if __name__ == "__main__":
    RECIPE.main()
