"""The inputs of an enhancement, of any kind, as animations of the model's dense mesh."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import FileFormatError, NameMismatchError, TopologyError, ValueRangeError
from torchface.io import load_rig
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.io.tables.csv_table import TableReader
from torchface.mesh import Mesh
from torchface.progress import Progress
from torchface.workflows.animated_meshes import AnimatedMesh, known_rate, load_animated, moved_mesh, rate_notes
from torchface.workflows.enhance.coarse_animation import (
    SAMPLED,
    CoarseAnimation,
    check_astray,
    check_finite,
    distances_at_rest,
    resampling_note,
    same_topology,
)
from torchface.workflows.enhance.head_correspondence import (
    PLACE,
    HeadCorrespondence,
    find_correspondence,
    has_topology_of,
    placed,
)
from torchface.workflows.enhance.marker_animation import MarkerSites, check_attachment, marker_animation
from torchface.workflows.marker_input import DEFAULT_OPTIONS, MarkerOptions
from torchface.workflows.track.track_files import ANIMATION, SUMMARY

# Of six real takes' frames on the performer, those that left 1.5 mm and more gave 0.5 to 0.7; first frames at rest, of
# eight other people too, 0.8 and more.
_NEARER_TO_REST, _NEARER_MM = 0.75, 0.2
CORRESPONDENCE = "correspondence.safetensors"


@dataclass(frozen=True)
class InputSettings:
    """How an input is read."""

    # What weights move, whose topology the meshes have, or on which the attachment's markers sit.
    rig: Path | None = None
    attachment: Path | None = None  # where the markers sit, on the rig or on the model's mesh
    pairs: Path | None = None  # vertices of the input and where they lie on the model; found by registration if absent
    part: str | None = None  # keep this annotated region of the rig only
    neutral: int | None = None  # a frame of the markers with the face at rest
    fps: float | None = None  # frames a second of meshes, where their file does not say
    markers: MarkerOptions = DEFAULT_OPTIONS  # how the marker file is read


def read_coarse(path: Path, model: Mesh, settings: InputSettings, state: Path, progress: Progress) -> CoarseAnimation:
    """An animation in the model's vertices, from markers, weights, an animated ``.glb``, meshes or a tracked video's
    folder.

    The folder ``state`` is for what a later run may take up.
    """
    progress("reading the input")
    if is_markers(path):
        return _markers(path, model, settings, state, progress)
    options = settings.markers
    of_markers = {"--attachment": settings.attachment, "--neutral": settings.neutral, "--labels": options.labels}
    for name, value in {**of_markers, "--flip": options.flip}.items():
        if value is not None:
            raise ValueRangeError(f"{path}: found {name} and no markers, expected a .c3d, .trc or .csv of markers")
    source = tracked_animation(path)
    animated, notes = at_even_rate(load_animated(source, settings.rig, settings.part, options.unit), settings.fps)
    if settings.rig is not None and animated.take is not None and source.suffix.lower() in SCENE_ENDINGS:
        notes = [*notes, f"warning: --rig {settings.rig} is not used: {source.name} has its own rig"]
    if has_topology_of(animated.neutral, model):
        coarse = same_topology(animated, model, settings.fps)
        return replace(coarse, notes=(*notes, *coarse.notes))
    state_file = state / CORRESPONDENCE
    correspondence = find_correspondence(animated.neutral, model, settings.pairs, path, state_file, progress)
    progress("setting up the thin shell")
    coarse = other_topology(animated, model, correspondence, settings.fps)
    return replace(coarse, notes=(*notes, *coarse.notes))


def at_even_rate(animated: AnimatedMesh, fps: float | None) -> tuple[AnimatedMesh, list[str]]:
    """The animation at an even rate, which the model's timing and the results have, and what is to be said of it and
    of frames that are missing."""
    take = animated.take
    if take is None or take.seconds is None or animated.rig is None:
        return animated, [f"warning: {animated.path.name}: {animated.missing}"] if animated.missing else []
    even = take.resampled(fps)
    return moved_mesh(animated.path, animated.rig, even), [resampling_note(animated.path, take, even)]


def is_markers(path: Path) -> bool:
    """Whether a file holds markers."""
    if not path.exists():
        raise FileFormatError(f"{path}: found no such file or folder, expected an animation or markers")
    ending = path.suffix.lower()
    return ending in (".c3d", ".trc") or (ending == ".csv" and is_marker_header(TableReader(path).header))


def tracked_animation(path: Path) -> Path:
    """Of the folder of a tracked video its animation, which brings the rig along; any other path as it is."""
    if path.is_dir() and (path / SUMMARY).is_file() and (path / ANIMATION).is_file():
        return path / ANIMATION
    return path


def other_topology(
    animated: AnimatedMesh, model: Mesh, correspondence: HeadCorrespondence, fps: float | None
) -> CoarseAnimation:
    """An animation of other vertices, spread over the model's by the thin shell."""
    carry = correspondence.carrier(animated.neutral, model, animated.path)

    def read(begin: int, end: int) -> Tensor:
        vertices = animated.read(begin, end)
        check_finite(vertices, animated.path, 1, begin)
        check_astray(vertices, animated.neutral, animated.path, begin)
        return carry(vertices)

    assumed = [] if animated.rig is not None else [_first_frame_note(animated, correspondence)]
    return CoarseAnimation(
        animated.path,
        "meshes of another topology",
        animated.count,
        read,
        known_rate(animated.fps, fps),
        lambda begin, end: placed(correspondence.pose, animated.read(begin, end)),
        animated.neutral.faces,
        correspondence.residual,
        (*rate_notes(animated.path, animated.fps, fps), *assumed, *correspondence.notes(animated.path), PLACE),
    )


def _first_frame_note(animated: AnimatedMesh, correspondence: HeadCorrespondence) -> str:
    """That the first frame is taken to be at rest; a warning where another one is much nearer to the model at rest."""
    known, note = correspondence.known, f"{animated.path.name} is taken to be at rest in its first frame"
    rows = range(0, animated.count, max(1, animated.count // SAMPLED))
    some = torch.cat([animated.read(t, t + 1)[:, known] for t in rows])
    check_finite(some, animated.path, rows.step)
    off = distances_at_rest(some.double(), correspondence.bent[known].double())
    nearest = int(off.argmin())
    if float(off[nearest]) > min(_NEARER_TO_REST * float(off[0]), float(off[0]) - _NEARER_MM):
        return note
    return (
        f"warning: {note}, {float(off[0]):.1f} mm from the model's head at rest, but frame {rows[nearest]} is "
        f"{float(off[nearest]):.1f} mm from it: motion counts from the wrong face; put a mesh at rest first, or give a "
        "rig of these vertices (--rig)"
    )


def _markers(path: Path, model: Mesh, settings: InputSettings, state: Path, progress: Progress) -> CoarseAnimation:
    if settings.attachment is None:
        raise NameMismatchError(f"{path}: found markers without an attachment, expected where they sit (--attachment)")
    attachment = Attachment.load(settings.attachment)
    rig = None if settings.rig is None else load_rig(settings.rig, part=settings.part)
    if check_attachment(attachment, settings.attachment, rig, model):
        if rig is not None and not has_topology_of(rig.neutral, model):
            raise TopologyError(
                f"{settings.attachment}: found marker sites on the model's own mesh beside --rig {settings.rig}, "
                f"expected sites on that rig, or no --rig"
            )
        sites, notes = MarkerSites(attachment), list[str]()
    else:
        assert rig is not None
        source = settings.rig or path
        state_file = state / CORRESPONDENCE
        correspondence = find_correspondence(rig.neutral, model, settings.pairs, source, state_file, progress)
        sites, notes = MarkerSites(attachment, rig, correspondence), correspondence.notes(source)
    progress("setting up the thin shell")
    animation = marker_animation(path, sites, model, settings.neutral, settings.markers)
    return replace(animation, notes=(*notes, *animation.notes))
