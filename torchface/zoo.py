"""Learned models by name: those that come with torchface, and the user's own in ``$TORCHFACE_HOME``."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from torchface.capture.action_units.classifier import ActionUnitClassifier
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.priors import DynamicsPrior, ReciprocalPrior, ShapePrior
from torchface.capture.video.video_solver import VideoSolver
from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.models import DESCRIPTION, STATE, ModelRecord, read_model, read_record, write_model
from torchface.landmarks.images.appearance_model import AppearanceModel
from torchface.landmarks.images.landmark_trees import LandmarkTrees
from torchface.landmarks.scans.uv_detector import UVLandmarkDetector
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.rigging.expression_regression import ExpressionRegression

KINDS: dict[str, type[nn.Module]] = {
    "action_units": ActionUnitClassifier,
    "appearance": AppearanceModel,
    "dynamics_prior": DynamicsPrior,
    "expression_regression": ExpressionRegression,
    "head": HeadModel,
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
__all__ = ["HOME", "KINDS", "STATE", "ModelDescription", "describe", "find", "get_model", "list_models", "save_model"]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True)
class ModelDescription(ModelRecord):
    """A :class:`ModelRecord`, and where the model was found.

    Args:
        name: of the model.
        folder: that it lies in.
    """

    name: str = ""
    folder: Path = Path()


def list_models() -> list[str]:
    """Names of the models that there are, sorted."""
    found: set[str] = set()
    for root in _roots():
        found |= {entry.name for entry in root.iterdir() if _is_model(root, entry.name)}
    return sorted(found)


def describe(name_or_path: str | Path) -> ModelDescription:
    """What a model is, without loading it: kind, licence, data, metrics, recipe, url, size and sha256 of its state.

    Raises:
        NameMismatchError: there is no model of this name.
        FileFormatError: its ``model.toml`` cannot be read.
    """
    folder = find(name_or_path)
    found = dict(vars(read_record(folder)))
    found["url"] = found["url"] or folder.resolve().as_uri()
    return ModelDescription(**found, name=folder.name, folder=folder)


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
    """
    kinds = [kind for kind, known in KINDS.items() if type(model) is known]
    if not kinds:
        known = ", ".join(one.__name__ for one in KINDS.values())
        raise NameMismatchError(f"save_model: found a {type(model).__name__}, expected one of {known}")
    folder = Path(folder)
    if not _NAME.fullmatch(folder.name):
        raise NameMismatchError(f"{folder}: found the name {folder.name!r}, expected letters, digits, - and _")
    record = ModelRecord(kinds[0], licence, data, dict(metrics), recipe, url, dict(settings or {}))
    return write_model(model, folder, record, card, half)


def find(name_or_path: str | Path) -> Path:
    """The folder of a model; see :func:`get_model`."""
    given = str(name_or_path)
    if isinstance(name_or_path, Path) or "/" in given or os.sep in given:
        folder = Path(given)
        if "\0" in given or not folder.is_dir():
            raise FileFormatError(f"{given!r}: found no such folder, expected one with {DESCRIPTION}")
        return folder
    if _NAME.fullmatch(given):
        for root in _roots():
            if _is_model(root, given):
                return root / given
    local = Path(given or os.devnull)
    if (local / DESCRIPTION).is_file():
        return local
    why = f" (the folder of that name holds no {DESCRIPTION})" if local.is_dir() else ""
    known = ", ".join(list_models()) or "none at all"
    raise NameMismatchError(
        f"model: found no {given[:80]!r}{why}, expected one of {known}; or the path of a model's folder"
    )


def _roots() -> list[Path]:
    """Folders of models, the first wins: the checkout's or the installed package's, then the user's own."""
    package = Path(__file__).resolve().parent
    checkout = package.parent
    own = checkout / "models" if (checkout / "pyproject.toml").is_file() else package / "_models"
    home = os.environ.get(HOME)
    return [root for root in (own, *([Path(home)] if home else [])) if root.is_dir()]


def _is_model(root: Path, name: str) -> bool:
    """Whether a root holds this model; a link that leads out of the root is none."""
    folder = root / name
    try:
        inside = folder.resolve().is_relative_to(root.resolve())
        return bool(_NAME.fullmatch(name)) and inside and (folder / DESCRIPTION).is_file()
    except (OSError, RuntimeError):  # a loop of links
        return False
