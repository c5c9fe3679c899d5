"""``torchface train landmark_network --out models/NAME``: a network that finds landmarks and expressions of faces.

Learns from rendered people alone: ``--ict FaceXModel`` takes ICT-FaceKit's heads of real people beside the embedded
performers. Pictures stay in files, of which a batch is read at a time. 10,000 pictures take about 21 minutes of one
core, 8,000 steps 80 minutes of two; a GPU is used if there is one. ``--start zoo --network.heat 0`` goes on from the
network that ships. ``--start zoo --data FOLDER`` has it learn from photographs with ``.pts`` files of 68 landmarks, in
a minute or two. Killed and started again it goes on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import ValueRangeError
from torchface.landmarks import LandmarkNetwork, NetworkLandmarks, NetworkSettings
from torchface.landmarks.images.ibug_68 import COUNT, INNER
from torchface.landmarks.images.networks.landmark_training import cropped, openings
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings, Crops

from .annotated_pictures import annotated_pictures, inner_error
from .face_pictures import EACH, FACES, PART, StoredExpressions
from .model_cards import model_card
from .recipe_settings import RenderedSettings
from .rendered_files import rendered_files
from .rendered_people.dense_points import dense_places
from .runner import Recipe, Run, metric_lines, recipe

_TEST_BATCH = 64
# Of a network that has learned already: photographs are few, and what it knows beside them is to stay.
_GENTLE = NetworkSettings(steps=200, batch=16, rate=1e-4, average=0.95, heat=0.0)
_ZOO = "landmark_network"
_SHARE = "% of the distance of the eyes' outer corners"
OPENINGS = {"lid opening": [0, 1], "lips' gap": [2], "mouth's width": [4], "brows' height": [5, 6]}
"""Columns of ``openings``."""


@dataclass(frozen=True, kw_only=True)
class Settings(RenderedSettings):
    """What the recipe does.

    Args:
        start: A network to go on from, by name or folder; zoo for the one that ships; a new one if absent.
        kept: Share of that network in the mean of its weights and of those that it has learned since: it keeps what it
            knew of pictures unlike the new ones (Wortsman et al. 2022, robust fine-tuning).
        size: Pixels a side of the crops that it learns from.
        network: How the network is trained.
        data: Photographs with iBUG's .pts files of the same names, or a dlib .xml: the network goes on learning from
            them, gently unless ``network`` says otherwise, in place of rendered pictures. Of ten or more every fifth is
            kept for the test.
    """

    out: Path = Path("models/landmark_network")
    pictures: int = 15_000
    held_out: int = 480
    folder: Path = Path("out/face_pictures")
    start: str | None = None
    kept: float = 0.0
    size: int = 176
    network: NetworkSettings = field(default_factory=NetworkSettings)
    data: Path | None = None


@recipe
def train(settings: Settings, run: Run) -> LandmarkNetwork:
    """Renders, trains, calibrates, evaluates and saves."""
    progress = run.progress
    if settings.data is not None:
        return fine_tuned(settings, settings.data, run)
    settings.check_count(PART)
    if not 0 <= settings.kept < 1 or (settings.kept and settings.start is None):
        raise ValueRangeError(f"--kept: found {settings.kept:g}, expected [0,1), and 0 without --start")
    first = first_network(settings)
    before = {name: value.clone() for name, value in first.state_dict().items()}
    files = rendered_files(
        FACES, settings.folder, settings.pictures, settings.seed, settings.ict, settings.workers, progress
    )
    pictures = StoredExpressions(files)
    count = EACH * ((len(pictures) - settings.held_out) // EACH)  # whole people
    learned = StoredExpressions(files, count)
    model = LandmarkNetwork.fit(learned, first, settings.network, progress, run.checkpoint, run.device, run.log)
    keep(model, before, settings.kept)
    middle = EACH * ((count + len(pictures)) // (2 * EACH))
    calibrate(model, held_out(model, pictures, count, middle))
    save(model, settings, measures(held_out(model, pictures, middle, len(pictures))))
    return model


def fine_tuned(settings: Settings, data: Path, run: Run) -> LandmarkNetwork:
    """A network that has gone on learning from annotated photographs, measured before and after, and saved."""
    name = _ZOO if settings.start in (None, "zoo") else str(settings.start)
    model = zoo.get_model(name, LandmarkNetwork)
    run.progress("reading annotated pictures")
    learned, tested = annotated_pictures(data, model)
    before = inner_error(model, tested)
    network = settings.network if settings.network != NetworkSettings() else _GENTLE
    model = LandmarkNetwork.fit(learned, model, network, run.progress, run.checkpoint, run.device, run.log).cpu()
    kept = f"{len(tested)} pictures kept apart" if len(tested) < len(learned) else "the pictures learned from"
    what = f"mean error of inner landmarks of {kept}, {_SHARE}"
    save(
        model,
        settings,
        {f"{what}: before": before, f"{what}: after": inner_error(model, tested)},
        f"{len(learned)} annotated pictures of {data.name}, after {name}.",
        "that of the pictures",
    )
    return model


def first_network(settings: Settings) -> LandmarkNetwork:
    """The network that goes on learning, with a head for the points: a new one, or the one that the settings name."""
    if settings.start is None:
        network = LandmarkNetwork.drawn(settings.network.seed)
    else:
        network = zoo.get_model(_ZOO if settings.start == "zoo" else settings.start, LandmarkNetwork)
    places, mirror = dense_places()
    if network.dense is not None and network.points == len(places):
        network.dense.places.copy_(places)  # the performer may have changed since it learned
        return network if network.size == settings.size else network.resized(settings.size)
    with torch.random.fork_rng([]):
        torch.manual_seed(settings.network.seed)
        return network.with_points(places, mirror, size=settings.size)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What a network reads of pictures that it did not learn from, and the truth."""

    crops: Crops  # what it was shown, and where all marks are
    weights: Tensor  # that are posed, (M,52)
    found: NetworkLandmarks  # by the network, as it is calibrated


@torch.no_grad()
def held_out(model: LandmarkNetwork, pictures: StoredExpressions, first: int, last: int) -> HeldOut:
    """What a model reads of pictures from one number to another, augmented as in training, none hidden or absent."""
    plain = AugmentationSettings(turn=8.0, hidden=0.0, absent=0.0)
    generator = torch.Generator().manual_seed(0)
    shown: list[Crops] = []
    weights, found = [], []
    for start in range(first, last, _TEST_BATCH):
        numbers = torch.arange(start, min(start + _TEST_BATCH, last))
        crops, posed = cropped(pictures[numbers], model.size, model.margin, model.mirror, generator, plain)
        found.append(model(crops.images))
        shown.append(replace(crops, images=crops.images[:0]))
        weights.append(posed)
    crops = Crops(*(torch.cat([getattr(one, part.name) for one in shown]) for part in fields(Crops)))
    return HeldOut(crops, torch.cat(weights), NetworkLandmarks(*(torch.cat(part) for part in zip(*found, strict=True))))


@torch.no_grad()
def keep(model: LandmarkNetwork, before: Mapping[str, Tensor], share: float) -> None:
    """Moves a network's weights toward those that it had before."""
    for name, value in model.state_dict().items():
        if value.is_floating_point():
            value.lerp_(before[name].to(value), share)


def calibrate(model: LandmarkNetwork, seen: HeldOut) -> None:
    """Measures how wrong the network's deviations of weights are."""
    if model.dense is not None:
        model.dense.calibrate(seen.found.expression, seen.found.expression_deviation, seen.weights)


def measures(seen: HeldOut) -> dict[str, float]:
    """Errors of landmarks that can be seen, how openings follow the true ones, errors of points and weights."""
    found, truth, visible = seen.found.landmarks, seen.crops.landmarks[:, :COUNT], seen.crops.visible
    eyes = (truth[:, 36] - truth[:, 45]).norm(dim=-1)
    frontal = eyes > 0.8 * eyes.median()  # far eyes of turned heads are hardly apart

    def error(points: Tensor, rows: slice) -> float:
        off = (points - seen.crops.landmarks[:, rows]).norm(dim=-1) / eyes[:, None]
        weight = visible[:, rows] * frontal[:, None]
        return 100 * float((off * weight).sum() / weight.sum())

    errors = {f"mean error of inner landmarks, {_SHARE}": error(found[:, INNER], INNER)}
    read, true = openings(found, truth)[frontal], openings(truth, truth)[frontal]
    for name, rows in OPENINGS.items():
        both = torch.cov(torch.stack([true[:, rows].flatten(), read[:, rows].flatten()]))
        errors[f"{name}, correlation"] = float(both[0, 1] / (both[0, 0] * both[1, 1]).sqrt())
        errors[f"{name}, slope"] = float(both[0, 1] / both[0, 0])
    if seen.found.points.shape[1]:
        errors[f"mean error of other points, {_SHARE}"] = error(seen.found.points, slice(COUNT, None))
        off, own = seen.found.expression - seen.weights, seen.weights - seen.weights.mean(0)
        errors["error of weights, root mean square"] = float(off.square().mean().sqrt())
        errors["weights' own, about their means"] = float(own.square().mean().sqrt())
        errors["correlation of a shape, median"] = float(correlations(seen.found.expression, seen.weights).median())
    return errors


def correlations(found: Tensor, truth: Tensor) -> Tensor:
    """Of each column of (M,N) with that of the other, (N,)."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    return (a * b).sum(0) / (a.square().sum(0) * b.square().sum(0)).sqrt().clamp(min=1e-9)


def save(
    model: LandmarkNetwork, settings: Settings, metrics: dict[str, float], data: str = "", licence: str = "MIT"
) -> None:
    """Writes the model with its card; its data are rendered pictures unless they are named."""
    card = model_card(
        settings,
        licence=licence,
        data=data or settings.rendered_data(),
        metrics=metrics,
        text=(
            "iBUG's 68 landmarks of a face in a crop of a colour or grey image and 452 further points of its surface, "
            "with the deviation to be expected of each; which of the 68 something hides, whether there is a face at "
            "all, and the weights of ARKit's 52 blendshapes that are to be expected, with deviations. Good "
            "for faces within 60 degrees of frontal, from 24 pixels a box, at any roll that the crop is turned by. "
            + ("The figures are of rendered people that it had not seen; " if not data else "")
            + "tests/benchmarks/test_real_faces.py measures it on photographs."
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
