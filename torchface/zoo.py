"""Learned models by name: those that come with torchface, and the user's own in ``$TORCHFACE_HOME``."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from torch import nn

from torchface.capture.action_units.classifier import ActionUnitClassifier
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.priors import DynamicsPrior, ReciprocalPrior, ShapePrior
from torchface.capture.video.video_solver import VideoSolver
from torchface.capture.webcam.examples.example_solver import ExampleSolver
from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.model_roots import MODEL_NAME, is_folder, is_model, model_names, model_roots
from torchface.files.models import DESCRIPTION, STATE, ModelRecord, model_fault, read_model, read_record, write_model
from torchface.landmarks.images.appearance_model import AppearanceModel
from torchface.landmarks.images.box_network import BoxNetwork
from torchface.landmarks.images.eyes import EyeNetwork
from torchface.landmarks.images.landmark_trees import LandmarkTrees
from torchface.landmarks.images.network import LandmarkNetwork
from torchface.landmarks.scans.uv_detector import UVLandmarkDetector
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.rigging.expression_regression import ExpressionRegression

KINDS: dict[str, type[nn.Module]] = {
    "action_units": ActionUnitClassifier,
    "appearance": AppearanceModel,
    "dynamics_prior": DynamicsPrior,
    "enhancement": EnhancementModel,
    "example_solver": ExampleSolver,
    "expression_regression": ExpressionRegression,
    "eye_network": EyeNetwork,
    "face_boxes": BoxNetwork,
    "head": HeadModel,
    "landmark_network": LandmarkNetwork,
    "landmark_trees": LandmarkTrees,
    "marker_solver": MarkerSolver,
    "morphable": MorphableModel,
    "reciprocal_prior": ReciprocalPrior,
    "shape_prior": ShapePrior,
    "uv_landmarks": UVLandmarkDetector,
    "video_solver": VideoSolver,
}
"""What a file may ask for: a kind is looked up here and nowhere else."""

HOME = "TORCHFACE_HOME"
__all__ = [
    "HOME",
    "KINDS",
    "STATE",
    "ModelDescription",
    "damaged_models",
    "describe",
    "find",
    "get_model",
    "list_models",
    "save_model",
]


@dataclass(frozen=True)
class ModelDescription(ModelRecord):
    """A :class:`ModelRecord`, and where the model was found.

    Args:
        name: of the model.
        folder: that it lies in.
        shadowed: folders of other models of the same name, which this one goes before.

    Example:
        >>> described = describe("marker_solver")
        >>> described.licence, described.folder.name, described.shadowed
        ('MIT', 'marker_solver', ())
    """

    name: str = ""
    folder: Path = Path()
    shadowed: tuple[Path, ...] = ()


def list_models() -> list[str]:
    """Names of the models that can be loaded, sorted; damaged ones are left out with a warning that says why.

    Example:
        >>> {"head", "landmark_network", "marker_solver"} <= set(list_models())
        True
    """
    damaged = damaged_models()
    for name, fault in damaged.items():
        _warn_once(f"model {name!r} is left out: {fault}")
    return sorted(_all_names() - set(damaged))


def damaged_models() -> dict[str, str]:
    """Models that cannot be loaded, by name, and why: as far as description, kind and the state's size tell.

    Example:
        >>> damaged_models()
        {}
    """
    faults = {name: model_fault(_named(name)[0], KINDS) for name in sorted(_all_names())}
    return {name: fault for name, fault in faults.items() if fault is not None}


def describe(name_or_path: str | Path) -> ModelDescription:
    """What a model is, without loading it: kind, licence, data, metrics, recipe, url, size and sha256 of its state.

    Raises:
        NameMismatchError: there is no model of this name.
        FileFormatError: its ``model.toml`` cannot be read.

    Example:
        >>> describe("face_landmarks").kind
        'landmark_trees'
    """
    folder = find(name_or_path)
    found = dict(vars(read_record(folder)))
    found["url"] = found["url"] or folder.resolve().as_uri()
    shadowed = () if _is_path(name_or_path) else tuple(_named(str(name_or_path))[1:])
    return ModelDescription(**found, name=folder.name, folder=folder, shadowed=shadowed)


def get_model(name_or_path: str | Path) -> Any:
    """A model, ready for use.

    Args:
        name_or_path: a name of :func:`list_models`; or a folder, as a ``Path`` or by its path. A name of the zoo goes
            before a folder of that name in the working directory; a separator (``./head``) asks for the folder.

    Returns:
        A module of one of the classes in ``KINDS``, in evaluation mode, on the CPU.

    Raises:
        NameMismatchError: there is no model of this name.
        FileFormatError: a file is missing, damaged, of a newer format, or does not have the hash it should have.

    Example:
        >>> prior = get_model("shape_prior")
        >>> rest = torch.zeros(1, len(prior.names), dtype=torch.float64)
        >>> bool(prior.log_density(rest) > prior.log_density(rest + 1))
        True
    """
    return read_model(find(name_or_path), KINDS)


def save_model(
    model: nn.Module,
    folder: str | Path,
    *,
    licence: str,
    data: str,
    metrics: Mapping[str, float],
    recipe: str,
    card: str = "",
    url: str = "",
    settings: Mapping[str, Any] | None = None,
    half: Collection[str] = (),
) -> ModelRecord:
    """Writes a model as ``model.toml``, ``state.safetensors`` and ``CARD.md``.

    Args:
        model: of one of the classes in ``KINDS``.
        folder: made where it is missing; its name is the model's.
        licence: under which the model may be used, such as ``MIT``.
        data: what it has learned from.
        metrics: what was measured on data held out.
        recipe: the command that makes it again.
        card: Markdown for the card: what the model is good for, measured how, its limits.
        url: where it comes from, if from elsewhere.
        settings: of the recipe, the effective ones.
        half: names in the state that are stored in half precision.

    Returns:
        The record as written.

    Raises:
        NameMismatchError: the model's class has no kind, or the folder's name is none for a model.
        FileFormatError: the folder cannot be written to.
        ValueRangeError: the state or a metric is not finite.

    Example:
        >>> prior = get_model("shape_prior")
        >>> record = save_model(prior, "my_prior", licence="MIT", data="none", metrics={}, recipe="a copy")
        >>> get_model("./my_prior").names == prior.names
        True
    """
    kinds = [kind for kind, known in KINDS.items() if type(model) is known]
    if not kinds:
        known = ", ".join(one.__name__ for one in KINDS.values())
        raise NameMismatchError(f"save_model: found a {type(model).__name__}, expected one of {known}")
    folder = Path(folder)
    if not MODEL_NAME.fullmatch(folder.name):
        raise NameMismatchError(f"{folder}: found the name {folder.name!r}, expected letters, digits, - and _")
    record = ModelRecord(kinds[0], licence, data, dict(metrics), recipe, url, dict(settings or {}))
    return write_model(model, folder, record, card, half)


def find(name_or_path: str | Path) -> Path:
    """The folder of a model; see :func:`get_model`. A name that several folders have is told with a warning, once.

    Example:
        >>> sorted(path.name for path in find("head").iterdir())
        ['CARD.md', 'model.toml', 'state.safetensors']
    """
    given = str(name_or_path)
    if _is_path(name_or_path):
        folder = Path(given)
        if not is_folder(folder):
            raise FileFormatError(f"{given!r}: found no such folder, expected one with {DESCRIPTION}")
        return folder
    named = _named(given)
    if named:
        if named[1:]:
            others = ", ".join(str(folder.resolve()) for folder in named[1:])
            _warn_once(
                f"model {given!r}: {named[0]} goes before {others}; for another one name its folder by a path, "
                f"such as {named[1].resolve()}"
            )
        return named[0]
    why = f" (the folder of that name holds no {DESCRIPTION})" if is_folder(Path(given or os.devnull)) else ""
    known = ", ".join(list_models()) or "none at all"
    home = os.environ.get(HOME)
    missing = f"; ${HOME} is {home!r}, which is no folder" if home and not is_folder(Path(home)) else ""
    raise NameMismatchError(
        f"model: found no {given[:80]!r}{why}, expected one of {known}; or the path of a model's folder{missing}"
    )


def _is_path(name_or_path: str | Path) -> bool:
    given = str(name_or_path)
    return isinstance(name_or_path, Path) or "/" in given or os.sep in given


def _roots() -> list[Path]:
    return model_roots(Path(__file__).resolve().parent, os.environ.get(HOME))


def _all_names() -> set[str]:
    """Of the models of every root, damaged ones among them; a root that cannot be listed is named in a warning."""
    names: set[str] = set()
    for root in _roots():
        try:
            names.update(model_names(root))
        except OSError as error:
            _warn_once(f"models: {root} cannot be listed ({error.strerror})")
    return names


def _named(name: str) -> list[Path]:
    """Folders of models of this name, the winner first: those of the roots, then that in the working directory."""
    folders = [root / name for root in _roots() if is_model(root, name)]
    local = Path(name or os.devnull)
    try:
        if (local / DESCRIPTION).is_file() and local.resolve() not in [folder.resolve() for folder in folders]:
            folders.append(local)
    except (OSError, ValueError):  # a name that is too long for a file, a NUL
        pass
    return folders


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, stacklevel=3)
