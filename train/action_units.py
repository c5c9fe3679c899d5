"""``torchface train action_units --video FILE --labels FILE``: a classifier of action units, of one or more performers.

The labels say where helmet, markers and regions are in the video, and which units are performed when; levels of
intensity are found without labels. Without videos, embedded performers are painted and filmed by code: 6 take about
six minutes of one core.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface import Take, TorchfaceError, Track, zoo
from torchface.capture import ActionUnitClassifier
from torchface.capture.action_units import RegionGroup, RegionVideo, TrainingSettings, classify, read_regions
from torchface.capture.action_units.classifier import group_regions
from torchface.capture.action_units.painted_regions import performed_groups
from torchface.errors import ValueRangeError
from torchface.files.whole_files import make_folder
from torchface.io import save_rig, save_take
from torchface.io.action_labels import ActionLabels, load_action_labels
from torchface.io.video import open_video
from torchface.progress import Progress
from torchface.rendering.compositing import headed, save_rendered_image, sheet
from torchface.synthetic import draw_identities

from .classifier_evaluation import Split, cross_validation, labelled_intensities, level_agreement
from .filmed_performers.action_performance import PerformanceSettings
from .filmed_performers.camera_stage import StageSettings, record_session
from .model_cards import model_card
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe

_FPS = 30.0


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        video: Head-camera videos, one a performer; the others' faces are warped to the first performer's. Embedded
            performers are filmed if absent.
        labels: What is in each of them, as TOML.
        test_video: Videos of performers to test on.
        test_labels: What is in each of those.
        films: Folder for the films of embedded performers; beside each are its marker take, rig, sites and weights.
        performers: Embedded performers to learn from.
        held_out: Embedded performers to test on.
        repetitions: Of each action unit, by an embedded performer.
        size: Pixels a side that every region is brought to.
        folds: In how many turns the cross-validation leaves performers out, of a single one whole repetitions; 0 leaves
            it out.
        training: How it is trained.
    """

    video: tuple[Path, ...] = ()
    labels: tuple[Path, ...] = ()
    test_video: tuple[Path, ...] = ()
    test_labels: tuple[Path, ...] = ()
    films: Path = Path("out/action_unit_films")
    performers: int = 4
    held_out: int = 2
    repetitions: int = 5
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
    """Reads, stabilises, aligns, labels, fits, evaluates and saves."""
    progress = run.progress
    if settings.video or settings.labels:
        learned = _labelled(settings.video, settings.labels)
        held_out = _labelled(settings.test_video, settings.test_labels) if settings.test_video else []
        data, licence = "head-camera videos", "that of the videos"
    else:
        films = filmed(settings, progress)
        learned, held_out = films[: settings.performers], films[settings.performers :]
        data, licence = "films of embedded performers; no person's face", "MIT"
    labels = [own for _, own in learned]
    groups = performed_groups(labels)
    names = group_regions(groups)
    videos: list[RegionVideo] = []
    for path, own in learned:
        reference = videos[0].neutral if videos else None
        videos.append(read_regions(open_video(path), own, names, reference, settings.size))
        progress(f"{path.name}: {own.frames} frames, {len(own.performed)} repetitions")
    metrics: dict[str, float] = {}
    if settings.folds:
        alone = len(videos) == 1
        split: Split = "repetitions" if alone else "performers"
        folds = settings.folds if alone else min(settings.folds, len(videos))
        accuracy = cross_validation(videos, labels, groups, settings.training, folds, split)
        metrics = {f"cross-validated accuracy, {name}": value for name, value in accuracy.items()}
        metrics["cross-validated accuracy"] = sum(accuracy.values()) / len(accuracy)
    classifier = ActionUnitClassifier.fit(videos, labels, groups, settings.training, progress)
    for path, own in held_out:
        video = read_regions(open_video(path), own, names, classifier.neutral, settings.size)
        truth = labelled_intensities(video, own, groups, settings.training)
        agreement = level_agreement(classify(classifier, video), truth, settings.training.levels)
        metrics |= {f"{path.stem}, {name}": value for name, value in agreement.items()}
        progress(f"{path.name}: {agreement['within_one']:.1%} within one level")
    frames = sum(own.frames for own in labels)
    save(classifier, settings, metrics, f"{frames} frames of {len(labels)} {data}.", licence)
    picture = levels_picture(videos[0], labelled_intensities(videos[0], labels[0], groups, settings.training), groups)
    save_rendered_image(picture, settings.out / "levels.png")
    return Trained(classifier, metrics)


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
    classifier: ActionUnitClassifier, settings: Settings, metrics: dict[str, float], data: str, licence: str
) -> None:
    """Writes the model with its effective settings, measured accuracy and card."""
    card = model_card(
        settings,
        licence=licence,
        data=data,
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


def filmed(settings: Settings, progress: Progress) -> list[tuple[Path, ActionLabels]]:
    """Films of embedded performers, written to ``settings.films``, and their labels; those held out come last."""
    count = settings.performers + settings.held_out
    if not settings.performers or not settings.repetitions:
        raise ValueRangeError("found --performers 0 or --repetitions 0, expected 1 or more")
    folder = make_folder(settings.films)
    stage = StageSettings(performance=PerformanceSettings(settings.repetitions, min(3, settings.repetitions), fps=_FPS))
    films = []
    for number, identity in enumerate(draw_identities(count, torch.Generator().manual_seed(settings.seed))):
        generator = torch.Generator().manual_seed(settings.seed + 1 + number)
        one = record_session(folder, f"p{number}", identity, generator, stage, progress)
        save_rig(one.rig, folder / f"p{number}.glb")
        first = one.attachment.on(one.rig.neutral.faces, one.rig(one.performance.weights[:1]))[0]
        stood_off = one.recording.markers[0] - first  # markers are balls, whose centres lie off the skin
        replace(one.attachment, residual=stood_off).save(folder / f"p{number}.json")
        weights = Track(one.rig.names, one.performance.weights[..., None])
        save_take(Take(_FPS, weights=weights), folder / f"p{number}.csv")
        films.append((one.video.path, one.labels))
    return films


def _labelled(videos: tuple[Path, ...], paths: tuple[Path, ...]) -> list[tuple[Path, ActionLabels]]:
    if not videos or len(videos) != len(paths):
        raise TorchfaceError(f"found {len(videos)} videos and {len(paths)} files of labels, expected one for each")
    return [(video, load_action_labels(path)) for video, path in zip(videos, paths, strict=True)]


RECIPE = Recipe(Settings, train, __doc__, lambda _, trained: metric_lines(trained.metrics, "8.2%"))

if __name__ == "__main__":
    RECIPE.main()
