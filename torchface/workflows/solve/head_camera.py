"""A head camera's predictions as weight curves for a marker take."""

from dataclasses import dataclass
from pathlib import Path

import torch

from torchface import zoo
from torchface.capture import ActionUnitClassifier
from torchface.capture.action_units import ActionUnitCurves, CurveSettings, action_unit_curves, load_shape_table
from torchface.capture.action_units.shape_table import built_in_tables
from torchface.capture.markers import gamma_curves
from torchface.capture.markers.hybrid_solver import GAMMA
from torchface.errors import FileFormatError, NameMismatchError
from torchface.io.action_labels import load_action_labels
from torchface.progress import Progress
from torchface.take import Take, Track

_SAME_RATE = 1e-3
_BLEND_SECONDS, _MIN_BLEND_FRAMES = 15 / 60, 5


@dataclass(frozen=True)
class HeadCamera:
    """A video of the face with painted patterns, and its classifier."""

    video: Path
    classifier: str | Path  # a trained ActionUnitClassifier, by name or folder
    # Where helmet, markers and regions are in the video; the video's name with .toml if absent.
    labels: Path | None = None
    # Action units in the rig's shapes: arkit, ict or a file; whichever of the two has the rig's names if absent.
    table: str | Path | None = None
    units: tuple[str, ...] = ()  # those that count; all of the classifier's if empty
    gamma: float = GAMMA  # the largest weight of a prediction, mm² over all markers


@dataclass(frozen=True, eq=False)
class Predicted:
    """Curves for the hybrid solve, frame by frame of a take."""

    weights: Track  # the classifier's predictions, (T,K,1)
    gamma: Track  # their weights, (T,K,1), mm² over all markers
    notes: tuple[str, ...]  # what had to be assumed, for people to read

    def frames(self, rows: slice) -> "Predicted":
        """Some of the frames."""
        return Predicted(self.weights.frames(rows), self.gamma.frames(rows), self.notes)


def predicted_curves(
    camera: HeadCamera, take: Take, names: tuple[str, ...], progress: Progress | None = None
) -> Predicted:
    """Classifies the video and resamples its predictions to the take's frames.

    Video and take begin together; a video of another rate is resampled to the take's, and where it ends before the
    take the markers are left alone.
    """
    classifier = zoo.get_model(camera.classifier, ActionUnitClassifier)
    if unknown := [unit for unit in camera.units if unit not in classifier.units]:
        raise NameMismatchError(f"--units: found {', '.join(unknown)}, expected some of {', '.join(classifier.units)}")
    where = camera.labels or camera.video.with_suffix(".toml")
    if not where.is_file():
        raise FileFormatError(
            f"{where}: found no such file, expected where helmet, markers and regions are in {camera.video.name}; "
            "--video-labels names another (docs/how_to/head_camera.md)"
        )
    labels = load_action_labels(where)
    if lacking := [name for name in classifier.regions if name not in labels.regions]:
        raise NameMismatchError(
            f"{where}: regions: found no {', '.join(lacking)}, expected those that the classifier reads: "
            f"{', '.join(classifier.regions)}"
        )
    table = load_shape_table(camera.table if camera.table is not None else _fitting_table(classifier.units, names))
    settings = CurveSettings(units=camera.units or None)
    curves = action_unit_curves(classifier, camera.video, labels, table, names, settings, progress)
    return resampled_curves(curves, take, camera.gamma)


def resampled_curves(curves: ActionUnitCurves, take: Take, gamma: float = GAMMA) -> Predicted:
    """Curves of a video, frame by frame of a take that began when it did; shapes it never moves are left out."""
    moved = curves.active.any(0)
    names = tuple(name for name, moves in zip(curves.names, moved.tolist(), strict=True) if moves)
    weights, active = curves.weights[:, moved], curves.active[:, moved]
    notes = []
    if abs(curves.fps - take.fps) > _SAME_RATE * take.fps:
        notes.append(f"video of {curves.fps:g} frames a second brought to the take's {take.fps:g}")
    at = take.times * curves.fps
    before = at.floor().long().clamp(max=len(weights) - 1)
    after = (before + 1).clamp(max=len(weights) - 1)
    fraction = (at - before).clamp(0, 1).to(weights)[:, None]
    there = torch.lerp(weights[before], weights[after], fraction)
    within = (at <= len(weights) - 1 + 1e-6)[:, None]
    active_frames = (active[before] | active[after]) & within
    if not bool(within.all()):
        missing = int((~within).sum())
        notes.append(f"the video ends {missing} frames before the take; there the markers are alone")
    elif len(weights) - 1 - float(at[-1]) > 1.5:
        notes.append(f"the video goes on for {len(weights) - 1 - float(at[-1]):.0f} frames after the take; left out")
    notes.append("take and video are taken to begin together")
    weighed = gamma_curves(active_frames, gamma, max(round(_BLEND_SECONDS * take.fps), _MIN_BLEND_FRAMES))
    return Predicted(Track(names, there[..., None]), Track(names, weighed[..., None]), tuple(notes))


def _fitting_table(units: tuple[str, ...], names: tuple[str, ...]) -> str:
    for name in built_in_tables():
        try:
            load_shape_table(name).matrix(units, names)
        except NameMismatchError:
            continue
        return name
    raise NameMismatchError(
        f"shape table: found no built-in one ({', '.join(built_in_tables())}) for a rig with {', '.join(names[:5])}, "
        "...; expected one for this rig (--table FILE)"
    )
