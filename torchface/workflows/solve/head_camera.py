"""A head camera's predictions as weight curves for a marker take."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

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
from torchface.temporal.interpolation import frames_beside, values_at

_SAME_RATE, _ROUNDING = 1e-3, 1e-6
_AGREES, _MOVES = 0.5, 0.05  # a correlation; the deviation of a weight that markers show to move
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

    @property
    def labels_file(self) -> Path:
        """Where the labels are."""
        return self.labels or self.video.with_suffix(".toml")


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

    They begin together unless the labels say otherwise; a video of another rate is resampled to the take's, and where
    the take has no frame of it the markers are left alone.
    """
    classifier = zoo.get_model(camera.classifier, ActionUnitClassifier)
    if unknown := [unit for unit in camera.units if unit not in classifier.units]:
        raise NameMismatchError(f"--units: found {', '.join(unknown)}, expected some of {', '.join(classifier.units)}")
    where = camera.labels_file
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
    return resampled_curves(curves, take, camera.gamma, labels.offset)


def resampled_curves(curves: ActionUnitCurves, take: Take, gamma: float = GAMMA, offset: float = 0.0) -> Predicted:
    """Curves of a video that began ``offset`` seconds after a take, frame by frame of it; shapes it never moves are
    left out."""
    moved = curves.active.any(0)
    names = tuple(name for name, moves in zip(curves.names, moved.tolist(), strict=True) if moves)
    weights, active = curves.weights[:, moved], curves.active[:, moved]
    rows, last = torch.arange(len(weights)), len(weights) - 1
    at = (take.times - offset) * curves.fps  # in frames of the video
    before, _ = frames_beside(rows, at)
    early, late = at < -_ROUNDING, at > last + _ROUNDING
    active_frames = (active[before] | active[(before + 1).clamp(max=last)]) & ~(early | late)[:, None]
    notes = []
    if abs(curves.fps - take.fps) > _SAME_RATE * take.fps:
        notes.append(f"video of {curves.fps:g} frames a second brought to the take's {take.fps:g}")
    if bool(early.any()):
        notes.append(f"the video begins {int(early.sum())} frames after the take; there the markers are alone")
    if bool(late.any()):
        notes.append(f"the video ends {int(late.sum())} frames before the take; there the markers are alone")
    elif last - float(at[-1]) > 1.5:
        notes.append(f"the video goes on for {last - float(at[-1]):.0f} frames after the take; left out")
    if hidden := int((~curves.seen).any(1).sum()):
        notes.append(f"{hidden} frames of the video do not show the paint of a region; there the markers are alone")
    together = "take and video are taken to begin together"
    notes.append(f"the video is taken to begin {offset:g} s after the take" if offset else together)
    weighed = gamma_curves(active_frames, gamma, max(round(_BLEND_SECONDS * take.fps), _MIN_BLEND_FRAMES))
    values = values_at(weights, rows, at)
    return Predicted(Track(names, values[..., None]), Track(names, weighed[..., None]), tuple(notes))


def video_warnings(alone: Take, predicted: Predicted) -> list[str]:
    """Whether the video's curves move as the weights of the markers alone; nothing where they do, or the markers show
    no motion of these shapes."""
    assert alone.weights is not None
    shown, own = (
        of.select(predicted.weights.names).values[..., 0].double() for of in (predicted.weights, alone.weights)
    )
    leads = predicted.gamma.values[..., 0] > 0
    ours, theirs, moves = _centred(torch.where(leads, shown, 0.0), own, torch.ones_like(leads))
    if not bool(moves.any()):
        return []
    size = 2 * len(own)
    spectrum = torch.fft.rfft(ours, size, dim=0).conj() * torch.fft.rfft(theirs, size, dim=0)
    correlation = torch.fft.irfft(spectrum, size, dim=0) @ moves / moves.sum()  # by how many frames the video is early
    ours, theirs, moves = _centred(shown, own, leads)  # where it leads, for it may show a part of the take
    found = max(float(correlation[0]), float((ours * theirs).sum(0) @ moves / moves.sum().clamp(min=_MOVES)))
    if found > _AGREES:
        return []
    best = int(correlation.argmax())
    seconds = (best if best < len(own) else best - size) / alone.fps
    moved = f" (by {float(correlation[best]):.2f} with `offset` in its labels {seconds:+.2f} s from now)"
    return [
        f"the video's curves and those of the markers alone correlate by {found:.2f}"
        f"{moved if float(correlation[best]) > _AGREES else ''}, expected more than {_AGREES}: is it a video of this "
        "take, from its beginning on, at its true rate? Compare with a solve without it"
    ]


def _centred(shown: Tensor, own: Tensor, among: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Curves (T,K) among some frames with mean 0 and norm 1, and how far ``own`` moves there, (K,), 0 where little."""
    count = among.sum(0).clamp(min=1)
    ours, theirs = (torch.where(among, one - (one * among).sum(0) / count, 0.0) for one in (shown, own))
    moves = torch.nn.functional.threshold(theirs.norm(dim=0) / count.sqrt(), _MOVES, 0.0)
    return torch.nn.functional.normalize(ours, dim=0), torch.nn.functional.normalize(theirs, dim=0), moves


def _fitting_table(units: tuple[str, ...], names: tuple[str, ...]) -> str:
    for name in built_in_tables():
        with suppress(NameMismatchError):
            if load_shape_table(name).matrix(units, names).any():
                return name
    raise NameMismatchError(
        f"shape table: found no built-in one ({', '.join(built_in_tables())}) for the units "
        f"{', '.join(units)} of a rig with {', '.join(names[:5])}, ...; expected one for them (--table FILE)"
    )
