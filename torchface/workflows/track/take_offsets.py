"""Fixed offsets between a rig's landmarks and a finder's: given, of an earlier take, or of this one."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from torchface.capture.own_rig import VideoSolver
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.capture.own_rig.offset_estimate import estimate_offsets
from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.rig import BlendshapeRig
from torchface.workflows.track.track_files import (
    OFFSETS,
)
from torchface.workflows.track.track_models import (
    TrackModels,
)


def rig_digest(rig: BlendshapeRig) -> str:
    """Changes when a rig does."""
    correctives = rig.correctives
    more = {} if correctives is None else {"correctives": correctives.deltas, "definitions": correctives.definitions}
    return content_key("rig", neutral=rig.neutral, deltas=rig.deltas, names=rig.names, **more)


def _finder_digest(models: TrackModels) -> str:
    """Changes when what finds landmarks does; a table does not say what found it."""
    return "" if models.finder is None else models.seeing


def offsets_of(path: Path, rig: BlendshapeRig, models: TrackModels) -> LandmarkOffsets:
    """A file's offsets, which must be this rig's and this finder's.

    Raises:
        FileFormatError: it is no such file.
        ValueRangeError: they are another rig's or finder's.
    """
    found = LandmarkOffsets.load(path)
    found.require(rig_digest(rig), _finder_digest(models), path)
    return found


def take_offsets(
    solver: VideoSolver,
    rig: BlendshapeRig,
    models: TrackModels,
    landmarks: Tensor,
    trust: Tensor,
    given: Path | None,
    out: Path,
) -> tuple[LandmarkOffsets | None, bool]:
    """The offsets of a rig and a finder, and whether they were known: as given, of an earlier take, or of this one."""
    if given is not None:
        return offsets_of(given, rig, models), True
    if (out / OFFSETS).is_file():
        try:
            return offsets_of(out / OFFSETS, rig, models), True
        except (FileFormatError, ValueRangeError):
            pass  # another rig's, or damaged: made anew
    return estimate_offsets(solver, landmarks, trust, rig_digest(rig), _finder_digest(models)), False
