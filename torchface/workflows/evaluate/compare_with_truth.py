"""From a result and the truth on disk to how far they are apart: figures, tables, heat maps."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.escaped_text import listed
from torchface.evaluation import ShapeErrors, region_figures, rigidly_aligned, shape_errors, vertex_errors
from torchface.files.job_lock import holds_out, within_job
from torchface.files.whole_files import all_or_none
from torchface.mesh import Annotations, Mesh
from torchface.progress import Progress, silent
from torchface.shape_names import mapping
from torchface.temporal.interpolation import frames_beside, values_at
from torchface.viz.figures.error_maps import round_maximum
from torchface.workflows.animated_meshes import AnimatedMesh, load_animated
from torchface.workflows.evaluate.evaluation_record import ALL, Compared, Evaluation, write_tables

_CHUNK = 32
_MAX_DISTANCES = 2**29
_SAME_RATE = 0.002
_SAME_FRAME = 0.25  # of a frame by which times may differ
_ROUNDED = 1e-6  # seconds
_REACH = 0.4
_MOVED = 0.01  # a weight from which a shape moves
_GROUPS = ("round the jaw", "round the brows", "round the nose", "round the eyes", "round the mouth")
_GROUP_OF_LANDMARK = (*[0] * 17, *[1] * 10, *[2] * 9, *[3] * 12, *[4] * 20)


@dataclass(frozen=True)
class EvaluationSettings:
    """What is compared how."""

    rig: Path | None = None  # moves the result's weights, and annotates meshes of its topology
    truth_rig: Path | None = None  # moves the truth's weights; rig if absent
    part: str | None = None  # keep this annotated region only
    frames: tuple[int, ...] | None = None  # frames of the result that the truth's are, in order, from 0; all if absent
    align: bool = False  # each frame of the result rigidly with the truth
    maximum: float | None = None  # of the heat maps' scale, millimetres; the 95th percentile, rounded up, if absent
    by_number: bool = False  # the first frame is compared with the first, and so on, whatever their times


@holds_out(within_job)
def evaluate(
    result: Path,
    truth: Path,
    out: Path,
    settings: EvaluationSettings = EvaluationSettings(),
    progress: Progress | None = None,
) -> Evaluation:
    """Reads, compares and writes tables and a summary; see ``torchface evaluate --help`` for the arguments.

    Writes ``regions.csv``, ``frames.csv``, ``shapes.csv`` where both have weights, and ``summary.json``;
    :func:`torchface.workflows.evaluate.evaluate_page.write_evaluation_page` makes the report.
    """
    progress = progress or silent
    progress("reading result and truth")
    animated = load_animated(result, settings.rig, settings.part)
    true = load_animated(truth, settings.truth_rig or settings.rig, settings.part)
    hint = "; other rigs need --truth-rig, raw scans torchface register first"
    true.neutral.require_topology(animated.neutral, true.path, animated.path, hint)
    progress("comparing")
    evaluation = compare(animated, true, settings)
    progress("writing")
    with all_or_none():
        write_tables(evaluation, out)
    return evaluation


def compare(found: AnimatedMesh, true: AnimatedMesh, settings: EvaluationSettings) -> Evaluation:
    """Compares frame by frame."""
    frames, true_rows, notes = _pairs(found, true, settings)
    aligned = settings.align
    if len(frames) * len(found.neutral.vertices) > _MAX_DISTANCES:
        raise ValueRangeError(
            f"{found.path}: found {len(frames)} frames of {len(found.neutral.vertices)} vertices, more than "
            f"{_MAX_DISTANCES} distances; expected fewer (--part face, or --frames)"
        )
    errors, rotation, translation = [], [], []
    for begin in range(0, len(frames), _CHUNK):  # some frames at a time: all of a take's vertices fill the memory
        rows = frames[begin : begin + _CHUNK]
        a, b, motion = _pair(found, true, rows, true_rows[begin : begin + _CHUNK], aligned)
        errors.append(vertex_errors(a, b))
        if motion is not None:
            rotation.append(motion[0])
            translation.append(motion[1])
    distances = torch.cat(errors)
    empty = ~torch.isfinite(distances).any(1)
    if empty.all():
        raise ValueRangeError(f"{found.path}: found NaN in every frame of it or of {true.path}, expected vertices")
    if empty.any():
        first = int(frames[empty][0])
        notes.append(f"{int(empty.sum())} of {len(frames)} frames are NaN (the first {first}) and were left out")
    notes += _absent(found, true)
    maximum = settings.maximum
    if maximum is not None and not 0 < maximum < float("inf"):
        raise ValueRangeError(f"scale: found {maximum}, expected a positive number of millimetres")
    regions = {ALL: torch.ones(distances.shape[1], dtype=torch.bool), **compared_regions(found.neutral)}
    figures = region_figures(distances, regions)
    paths = found.path, true.path
    result, truth = (path.name if paths[0].name != paths[1].name else str(path) for path in paths)
    return Evaluation(
        result,
        truth,
        found.neutral,
        frames,
        found.fps or true.fps,
        distances,
        figures,
        _shapes(found, true, frames, true_rows),
        aligned,
        torch.cat(rotation) if rotation else None,
        torch.cat(translation) if translation else None,
        tuple(_shown(found, true, (frames, true_rows), distances, aligned)),
        round_maximum(figures[ALL].percentile_95) if maximum is None else maximum,
        tuple(notes),
    )


def _pairs(found: AnimatedMesh, true: AnimatedMesh, settings: EvaluationSettings) -> tuple[Tensor, Tensor, list[str]]:
    """Frames of the result that are compared, (K,) int64, and where the truth is at their times, frames (K,) float64.

    With them what is to be said of them. 2.5 is halfway between frames 2 and 3.
    """
    timed = found.take is not None and true.take is not None
    by_number = settings.frames is not None or settings.by_number or (found.count == true.count and not timed)
    if by_number or found.fps is None or true.fps is None:
        return _by_number(found, true, settings.frames)
    numbered = found.numbered and true.numbered
    here, there = _times(found, numbered), _times(true, numbered)
    fastest = max(found.fps, true.fps)
    even = all(one.take is None or one.take.seconds is None for one in (found, true))
    alike = even and not _rate_notes(found, true)  # then it is not known which frames of the longer the shorter has
    if abs(float(here[0] - there[0])) * found.fps <= _SAME_FRAME and even and (found.count == true.count or alike):
        return _by_number(found, true, None)
    nearest = torch.searchsorted((here[1:] + here[:-1]) / 2, there)
    same = (here[nearest] - there).abs() * fastest <= _SAME_FRAME
    rows, true_rows = nearest[same], same.nonzero()[:, 0].double()
    spans = [f"{float(times[0]):.3f} to {float(times[-1]):.3f} s" for times in (here, there)]
    if len(rows) == found.count == true.count:
        return rows, true_rows, []
    if len(rows) == min(found.count, true.count):
        spans = [f"{int(numbers[0])} to {int(numbers[-1])}" for numbers in (rows, true_rows)]
        note = f"{len(rows)} frames at the same times were compared, {spans[0]} of the result with {spans[1]}"
        return rows, true_rows, [f"{note} of the truth"]
    if not alike and (found.count != true.count or not even):
        rows = torch.arange(found.count) if found.count <= true.count else nearest.unique()
        inside = (here[rows] >= there[0] - _ROUNDED) & (here[rows] <= there[-1] + _ROUNDED)  # beyond it is held still
        before, fraction = frames_beside(there, here[rows])
        true_rows = before + fraction
        beside = (there[true_rows.round().long()] - here[rows]).abs() * true.fps <= 1
        rows, true_rows = rows[inside & beside], true_rows[inside & beside]
        if len(rows):
            note = f"{len(rows)} of the result's {found.count} frames were compared, each with the truth at its time"
            return rows, true_rows, [f"{note}, linear between the truth's {true.count} frames"]
    worst = int((here[nearest] - there).abs().argmax())
    raise ValueRangeError(
        f"{found.path}: found {found.count} frames from {spans[0]}, expected the times of the {true.count} of "
        f"{true.path}, {spans[1]}: {int(same.sum())} have one, and frame {worst} of the truth is "
        f"{float((here[nearest] - there)[worst].abs()):.3f} s from the nearest; or say which frames of the result "
        "they are (--frames), or compare the first with the first (--by-number)"
    )


def _by_number(
    found: AnimatedMesh, true: AnimatedMesh, chosen: tuple[int, ...] | None
) -> tuple[Tensor, Tensor, list[str]]:
    frames, notes = _frames(found, true, chosen), _rate_notes(found, true)
    if chosen is None and found.missing != true.missing:
        lost = ", ".join(f"{one.path.name}: {one.missing}" for one in (found, true) if one.missing)
        notes = [*notes, f"warning: {lost}; the first frame was compared with the first, and so on"]
    return frames, torch.arange(len(frames), dtype=torch.float64), notes


def _times(animated: AnimatedMesh, numbered: bool) -> Tensor:
    """When each frame is shown (T,), seconds since the recording began where frames are numbered, else the first."""
    if animated.take is None:
        return torch.arange(animated.count, dtype=torch.float64) / (animated.fps or 1.0)
    return animated.take.clock if numbered else animated.take.times


def _rate_notes(found: AnimatedMesh, true: AnimatedMesh) -> list[str]:
    if found.fps is None or true.fps is None or abs(found.fps / true.fps - 1) <= _SAME_RATE:
        return []
    return [f"found {found.fps:g} and {true.fps:g} frames a second; frames were compared by their number"]


def _frames(found: AnimatedMesh, true: AnimatedMesh, chosen: tuple[int, ...] | None) -> Tensor:
    if chosen is None:
        if found.count != true.count:
            raise ShapeError(
                f"{found.path}: found {found.count} frames, expected the {true.count} of {true.path}; "
                + ("cut the truth" if found.count < true.count else "or say which of the result's they are (--frames)")
            )
        return torch.arange(found.count)
    wrong = [frame for frame in chosen if not 0 <= frame < found.count]
    if wrong or len(chosen) != true.count:
        what = f"frame {wrong[0]}" if wrong else f"{len(chosen)} frames"
        raise ShapeError(
            f"frames: found {what}, expected one of 0 to {found.count - 1} for each of the {true.count} of {true.path}"
        )
    return torch.tensor(chosen)


def _pair(
    found: AnimatedMesh, true: AnimatedMesh, rows: Tensor, true_rows: Tensor, aligned: bool
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor] | None]:
    """Vertices (t,V,3) of the result's frames and of the truth's, and the rotation and translation of the former."""
    a = _read(found, rows)
    b = _read_between(true, true_rows).to(a)
    if not aligned:
        return a, b, None
    usable = (torch.isfinite(a) & torch.isfinite(b)).all(2).sum(1) >= 3
    moved, rotation, translation = a.clone(), torch.full((len(a),), torch.nan), torch.full((len(a),), torch.nan)
    if usable.any():
        motion = rigidly_aligned(a[usable], b[usable])
        moved[usable], rotation[usable] = motion.vertices, motion.degrees.to(rotation)
        translation[usable] = (motion.vertices - a[usable]).nanmean(1).norm(dim=-1).to(translation)
    moved[~usable] = torch.nan
    return moved, b, (rotation, translation)


def _read(animated: AnimatedMesh, rows: Tensor) -> Tensor:
    first, last = int(rows.min()), int(rows.max()) + 1
    together = last - first == len(rows) and bool((rows == torch.arange(first, last)).all())
    return animated.read(first, last) if together else torch.cat([animated.read(r, r + 1) for r in rows.tolist()])


def _read_between(animated: AnimatedMesh, rows: Tensor) -> Tensor:
    """Vertices (K,V,3) at frames (K,) float64, linear between two frames."""
    before = rows.floor()
    here = _read(animated, before.long())
    if torch.equal(before, rows):
        return here
    return torch.lerp(here, _read(animated, rows.ceil().long()), (rows - before).to(here)[:, None, None])


def _shown(
    found: AnimatedMesh, true: AnimatedMesh, pairs: tuple[Tensor, Tensor], errors: Tensor, aligned: bool
) -> list[Compared]:
    """The frame of median error and the worst one."""
    mean = errors.nanmean(1)
    order = mean.nan_to_num(-1.0).argsort()
    order = order[torch.isfinite(mean[order])]
    picked = dict.fromkeys([int(order[(len(order) - 1) // 2]), int(order[-1])])
    shown = []
    for row in picked:
        a, b, _ = _pair(found, true, pairs[0][row : row + 1], pairs[1][row : row + 1], aligned)
        shown.append(Compared(int(pairs[0][row]), a[0], b[0], errors[row]))
    return shown


def _shapes(found: AnimatedMesh, true: AnimatedMesh, frames: Tensor, true_rows: Tensor) -> ShapeErrors | None:
    if found.weights is None or true.weights is None or not mapping(found.weights.names, true.weights.names).any():
        return None
    solved = found.weights.values[frames, :, 0]
    actual = values_at(true.weights.values[..., 0], torch.arange(true.count), true_rows)
    return shape_errors(solved, found.weights.names, actual, true.weights.names)


def _absent(found: AnimatedMesh, true: AnimatedMesh) -> list[str]:
    """What is to be said of shapes that the truth's file moves and of which the result's has no column."""
    tracks = [None if one.take is None else one.take.weights for one in (found, true)]
    if tracks[0] is None or tracks[1] is None:
        return []
    moved = tracks[1].values[..., 0].nan_to_num().abs().amax(0) > _MOVED
    given = mapping(tracks[0].names, tracks[1].names).any(1)
    names = [name for name, absent in zip(tracks[1].names, (moved & ~given).tolist(), strict=True) if absent]
    what = f"{found.path.name} has no {listed(names)}, which {true.path.name} moves: taken for 0"
    return [what] if names else []


def compared_regions(mesh: Mesh) -> dict[str, Tensor]:
    """Regions (V,) of a mesh to compare in: those it is annotated with, and those round its landmarks.

    With 68 landmarks, the face's vertices are given to the brows, eyes, nose, mouth or jaw by the nearest landmark,
    where that is nearer than two fifths of the distance between the outer corners of the eyes.
    """
    notes = mesh.annotations or Annotations()
    regions = {name: mask.clone() for name, mask in notes.regions.items()}
    if notes.landmarks is None or len(notes.landmarks) != len(_GROUP_OF_LANDMARK):
        return regions
    points = mesh.vertices[notes.landmarks].double()
    nearest = torch.cdist(mesh.vertices.double(), points).min(1)
    reach = _REACH * float((points[36] - points[45]).norm())
    inside = (nearest.values <= reach) & notes.regions.get("face", torch.ones_like(nearest.indices, dtype=torch.bool))
    group = torch.tensor(_GROUP_OF_LANDMARK)[nearest.indices]
    for number, name in enumerate(_GROUPS):
        regions.setdefault(name, inside & (group == number))
    return regions
