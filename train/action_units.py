"""``torchface train action_units --video FILE --labels FILE``: a classifier of action units, of one or more performers.

The labels say where helmet, markers and regions are in the video, and which units are performed when; levels of
intensity are found without labels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface import TorchfaceError, zoo
from torchface.capture import ActionUnitClassifier
from torchface.capture.action_units import GROUPS, RegionGroup, RegionVideo, TrainingSettings, classify, read_regions
from torchface.capture.action_units.classifier import group_regions
from torchface.io.action_labels import ActionLabels, load_action_labels
from torchface.io.video import open_video
from torchface.rendering.compositing import headed, save_rendered_image, sheet

from .classifier_evaluation import Split, cross_validation, labelled_intensities, level_agreement
from .model_cards import model_card
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        video: Head-camera videos, one a performer; the others' faces are warped to the first performer's.
        labels: What is in each of them, as TOML.
        test_video: Videos of performers to test on.
        test_labels: What is in each of those.
        size: Pixels a side that every region is brought to.
        folds: In how many turns the cross-validation leaves performers out, of a single one whole repetitions; 0 leaves
            it out.
        training: How it is trained.
    """

    video: tuple[Path, ...]
    labels: tuple[Path, ...]
    test_video: tuple[Path, ...] = ()
    test_labels: tuple[Path, ...] = ()
    out: Path = Path("models/action_units")
    size: int = 48
    folds: int = 5
    training: TrainingSettings = field(default_factory=TrainingSettings)


@dataclass(frozen=True, eq=False)
class Trained:
    """A classifier and what was measured."""

    classifier: ActionUnitClassifier
    metrics: dict[str, float]


@recipe
def train(settings: Settings, run: Run) -> Trained:
    """Reads, stabilises, aligns, labels, fits, evaluates and saves.

    Raises:
        TorchfaceError: there are not as many labels as videos, or a video or its labels cannot be used.
    """
    progress = run.progress
    labels = _labels(settings.video, settings.labels)
    test_labels = _labels(settings.test_video, settings.test_labels) if settings.test_video else []
    groups = performed_groups(labels)
    names = group_regions(groups)
    videos: list[RegionVideo] = []
    for path, own in zip(settings.video, labels, strict=True):
        reference = videos[0].neutral if videos else None
        videos.append(read_regions(open_video(path), own, names, reference, settings.size))
        progress(f"{path.name}: {own.frames} frames, {len(own.performed)} repetitions")
    classifier = ActionUnitClassifier.fit(videos, labels, groups, settings.training, progress)
    metrics: dict[str, float] = {}
    if settings.folds:
        alone = len(videos) == 1
        split: Split = "repetitions" if alone else "performers"
        folds = settings.folds if alone else min(settings.folds, len(videos))
        accuracy = cross_validation(videos, labels, groups, settings.training, folds, split)
        metrics = {f"cross-validated accuracy, {name}": value for name, value in accuracy.items()}
        metrics["cross-validated accuracy"] = sum(accuracy.values()) / len(accuracy)
    for path, own in zip(settings.test_video, test_labels, strict=True):
        video = read_regions(open_video(path), own, names, classifier.neutral, settings.size)
        truth = labelled_intensities(video, own, groups, settings.training)
        agreement = level_agreement(classify(classifier, video), truth, settings.training.levels)
        metrics |= {f"{path.stem}, {name}": value for name, value in agreement.items()}
        progress(f"{path.name}: {agreement['within_one']:.1%} within one level")
    save(classifier, settings, metrics, labels)
    picture = levels_picture(videos[0], labelled_intensities(videos[0], labels[0], groups, settings.training), groups)
    save_rendered_image(picture, settings.out / "levels.png")
    return Trained(classifier, metrics)


def performed_groups(labels: list[ActionLabels]) -> tuple[RegionGroup, ...]:
    """The groups that labels name, or the usual ones, of those units that are performed.

    Raises:
        TorchfaceError: a unit is performed that no group knows, or none is.
    """
    performed = {unit for own in labels for unit in own.units}
    usual = next((own.groups for own in labels if own.groups), GROUPS)
    known = {unit for group in usual for unit in group.units}
    if not performed or performed - known:
        found = ", ".join(sorted(performed)) or "none"
        raise TorchfaceError(
            f"labels: found the units {found}, expected some of {', '.join(sorted(known))}; others need [[groups]] in "
            "the labels, with name, regions and units"
        )
    groups = []
    for group in usual:
        units = tuple(unit for unit in group.units if unit in performed)
        other_units = tuple(unit for unit in group.other_units if unit in performed)
        if units:
            groups.append(RegionGroup(group.name, group.regions, units, other_units))
    return tuple(groups)


def levels_picture(video: RegionVideo, truth: Tensor, groups: tuple[RegionGroup, ...]) -> Tensor:
    """A row a unit: its regions' mean pattern at every level of intensity."""
    units = [(unit, group) for group in groups for unit in group.units]
    rows = []
    for a, (unit, group) in enumerate(units):
        alone = truth.sum(1) == truth[:, a]
        regions = video.patterns[:, [video.names.index(name) for name in group.regions]]
        side = torch.cat(list(regions.unbind(1)), dim=2)
        for level in truth[:, a].unique():
            mean = side[(truth[:, a] == level) & alone].mean(0)
            big = mean.repeat_interleave(2, 0).repeat_interleave(2, 1)
            rows.append(headed(big.expand(3, -1, -1), f"{unit}: {float(level):.2f}"))
    return sheet(rows, max(1, len(rows) // len(units)))


def save(
    classifier: ActionUnitClassifier, settings: Settings, metrics: dict[str, float], labels: list[ActionLabels]
) -> None:
    """Writes the model with its effective settings, measured accuracy and card."""
    frames = sum(own.frames for own in labels)
    card = model_card(
        settings,
        licence="that of the videos",
        data=f"{frames} frames of {len(labels)} head-camera videos.",
        metrics=metrics,
        text=(
            f"Action units {', '.join(classifier.units)} recognised by strokes of reflective paint in a head-camera "
            "video, frame by frame, each at one of a few levels of intensity. It knows no other units, and "
            "combinations only as far as they were performed. Accuracy is of unit and level together, of performers "
            "left out, or of repetitions left out where there is one performer; other performers' is the share of "
            "frames in which every unit is within a level of their own labels."
        ),
    )
    zoo.save_model(classifier, settings.out, card)


def _labels(videos: tuple[Path, ...], paths: tuple[Path, ...]) -> list[ActionLabels]:
    if not videos or len(videos) != len(paths):
        raise TorchfaceError(f"found {len(videos)} videos and {len(paths)} files of labels, expected one for each")
    return [load_action_labels(path) for path in paths]


RECIPE = Recipe(Settings, train, __doc__, lambda _, trained: metric_lines(trained.metrics, "8.2%"))

if __name__ == "__main__":
    RECIPE.main()
