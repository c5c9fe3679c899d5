"""The learned parts that track a video: landmarks of any face, the actor's own appearance, what faces do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from torch import nn

from torchface import zoo
from torchface.capture.priors import DynamicsPrior, ShapePrior
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.landmarks import AppearanceModel, LandmarkTrees
from torchface.model_files import read_record
from torchface.rig import BlendshapeRig
from torchface.workflows.track_state import digest

DEFAULT_LANDMARKS = "face_landmarks"
"""The model of the zoo that finds landmarks where none is named."""

_Model = TypeVar("_Model", bound=nn.Module)


@dataclass(frozen=True)
class TrackModels:
    """What tracks and solves.

    Args:
        trees: find landmarks in any face.
        appearance: refines them on the actor's own.
        prior: which weights faces have.
        dynamics: how weights go on.
        seeing: changes when what finds landmarks does.
        solving: changes when what solves does.
    """

    trees: LandmarkTrees
    appearance: AppearanceModel | None = None
    prior: ShapePrior | None = None
    dynamics: DynamicsPrior | None = None
    seeing: str = ""
    solving: str = ""


def load_track_models(
    rig: BlendshapeRig,
    landmarks: str | Path = DEFAULT_LANDMARKS,
    appearance: str | Path | None = None,
    prior: str | Path | None = None,
    dynamics: str | Path | None = None,
) -> TrackModels:
    """Reads models by name or folder, see :func:`torchface.zoo.get_model`, and holds them against the rig.

    Raises:
        NameMismatchError: there is none of a name, one is of another kind, or a prior has learned other shapes than
            the rig has.
        ValueRangeError: the trees find other landmarks than the 68.
        FileFormatError: a model is damaged.
    """
    trees = _read("--landmarks", landmarks, LandmarkTrees)
    if len(trees.mean) != 68:
        raise ValueRangeError(f"{landmarks}: found a model of {len(trees.mean)} landmarks, expected the 68 of iBUG")
    found = TrackModels(
        trees,
        None if appearance is None else _read("--appearance", appearance, AppearanceModel),
        None if prior is None else _read("--prior", prior, ShapePrior),
        None if dynamics is None else _read("--dynamics", dynamics, DynamicsPrior),
        digest(*(_hash(name) for name in (landmarks, appearance))),
        digest(*(_hash(name) for name in (prior, dynamics))),
    )
    for name, model in ((prior, found.prior), (dynamics, found.dynamics)):
        if model is not None:
            try:
                model.require(rig.names)
            except NameMismatchError as error:
                raise NameMismatchError(f"{name}: {error}") from error
    return found


def check_rate(fps: float, models: TrackModels, path: Path) -> None:
    """Refuses a dynamics prior of another frame rate than a video's: it spoils what is solved.

    Raises:
        ValueRangeError: the rates differ.
    """
    note = None if models.dynamics is None else models.dynamics.rate_note(fps)
    if note is not None:
        raise ValueRangeError(f"{path}: {note}")


def _read(option: str, name: str | Path, kind: type[_Model]) -> _Model:
    model = zoo.get_model(name)
    if not isinstance(model, kind):
        raise NameMismatchError(f"{option}: found {name}, a {type(model).__name__}, expected a {kind.__name__}")
    return model


def _hash(name: str | Path | None) -> str:
    return "" if name is None else read_record(zoo.find(name)).sha256
