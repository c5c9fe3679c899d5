"""Which kind of input a path is, and how each becomes an animation of the model's dense mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torchface.attachment import Attachment
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io import load_rig
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.tables.csv_table import TableReader
from torchface.mesh import Mesh
from torchface.progress import Progress
from torchface.rig import BlendshapeRig
from torchface.workflows.animated_meshes import load_animated
from torchface.workflows.enhance.coarse_animation import CoarseAnimation, same_topology
from torchface.workflows.enhance.head_correspondence import (
    HeadCorrespondence,
    correspondence_notes,
    find_correspondence,
    of_one_topology,
)
from torchface.workflows.enhance.marker_animation import MarkerSites, check_attachment, marker_animation
from torchface.workflows.enhance.mesh_input import other_topology
from torchface.workflows.marker_input import DEFAULT_OPTIONS, MarkerOptions
from torchface.workflows.track.track_files import ANIMATION, SUMMARY

CORRESPONDENCE = "correspondence.safetensors"


@dataclass(frozen=True)
class InputSettings:
    """How an input is read.

    Args:
        rig: what weights move, whose topology the meshes have, or on which the attachment's markers sit.
        attachment: where the markers sit, on the rig or on the model's mesh.
        pairs: vertices of the input and where they lie on the model; registration tells if absent.
        part: keep this annotated region of the rig only.
        neutral: a frame of the markers with the face at rest.
        fps: frames a second of meshes, where their file does not say.
        markers: how the marker file is read.
    """

    rig: Path | None = None
    attachment: Path | None = None
    pairs: Path | None = None
    part: str | None = None
    neutral: int | None = None
    fps: float | None = None
    markers: MarkerOptions = DEFAULT_OPTIONS


def read_coarse(path: Path, model: Mesh, settings: InputSettings, state: Path, progress: Progress) -> CoarseAnimation:
    """An animation in the model's vertices, from markers, weights, an animated ``.glb``, meshes or a tracked video.

    Args:
        path: ``.c3d``, ``.trc``, ``.csv`` of markers or weights, ``.glb``, ``.safetensors``, a mesh, a folder of
            meshes, or the folder of ``torchface track``.
        model: the model's neutral.
        settings: what belongs to the input.
        state: a folder for what a later run may take up.
        progress: called with each step and how far it is.

    Raises:
        NameMismatchError: markers without an attachment, or weights without a rig.
        AlignmentError: it does not lie on the model: another size, actor, or order of vertices.
        TorchfaceError: a file is broken, or they do not fit each other.
    """
    progress("reading the input")
    if is_markers(path):
        return _markers(path, model, settings, state, progress)
    for name, value in (("--attachment", settings.attachment), ("--neutral", settings.neutral)):
        if value is not None:
            raise ValueRangeError(f"{path}: found {name} and no markers, expected a .c3d, .trc or .csv of markers")
    animated = load_animated(tracked_animation(path), settings.rig, settings.part)
    if has_topology_of(animated.neutral, model):
        return same_topology(animated, model, settings.fps)
    found = find_correspondence(animated.neutral, model, settings.pairs, path, state / CORRESPONDENCE, progress)
    progress("setting up the thin shell")
    return other_topology(animated, model, found, settings.fps)


def is_markers(path: Path) -> bool:
    """Whether a file holds markers."""
    if not path.exists():
        raise FileFormatError(f"{path}: found no such file or folder, expected an animation or markers")
    ending = path.suffix.lower()
    return ending in (".c3d", ".trc") or (ending == ".csv" and is_marker_header(TableReader(path).header))


def has_topology_of(mesh: Mesh, model: Mesh) -> bool:
    """Whether two meshes have the same vertices and triangles."""
    same = mesh.faces.shape == model.faces.shape and len(mesh.vertices) == len(model.vertices)
    return same and bool((mesh.faces.cpu() == model.faces.cpu()).all())


def tracked_animation(path: Path) -> Path:
    """Of the folder of a tracked video its animation, which brings the rig along; any other path as it is."""
    if path.is_dir() and (path / SUMMARY).is_file() and (path / ANIMATION).is_file():
        return path / ANIMATION
    return path


def _markers(path: Path, model: Mesh, settings: InputSettings, state: Path, progress: Progress) -> CoarseAnimation:
    if settings.attachment is None:
        raise NameMismatchError(f"{path}: found markers without an attachment, expected where they sit (--attachment)")
    attachment = Attachment.load(settings.attachment)
    rig = None if settings.rig is None else load_rig(settings.rig, part=settings.part)
    if check_attachment(attachment, settings.attachment, rig, model):
        sites, notes = MarkerSites(attachment), list[str]()
    else:
        assert rig is not None
        found = _rig_on_model(rig, model, settings, state, progress)
        sites, notes = MarkerSites(attachment, rig, found), correspondence_notes(found, settings.rig or path)
    progress("setting up the thin shell")
    animation = marker_animation(path, sites, model, settings.neutral, settings.markers)
    return replace(animation, notes=(*notes, *animation.notes))


def _rig_on_model(
    rig: BlendshapeRig, model: Mesh, settings: InputSettings, state: Path, progress: Progress
) -> HeadCorrespondence:
    if has_topology_of(rig.neutral, model):
        return of_one_topology(rig.neutral, model)
    source = settings.rig or Path("rig")
    return find_correspondence(rig.neutral, model, settings.pairs, source, state / CORRESPONDENCE, progress)
