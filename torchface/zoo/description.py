"""Descriptions of models, which need no loading."""

import re
from dataclasses import dataclass
from pathlib import Path

from torchface.files.models import ModelRecord, read_card, read_record
from torchface.zoo.hub import fetch_description, hub_reference
from torchface.zoo.model_folders import find, is_path, named_folders


@dataclass(frozen=True)
class ModelDescription(ModelRecord):
    """A :class:`ModelRecord`, and where the model was found.

    Args:
        name: of the model.
        folder: that it lies in.
        shadowed: folders of other models of the same name, which this one goes before.
        summary: the card's first words; empty where there is no card.

    Example:
        >>> described = describe("marker_solver")
        >>> described.licence, described.folder.name, described.shadowed
        ('MIT', 'marker_solver', ())
        >>> described.summary
        'Weights of blendshapes from 3D markers in millimetres, NaN for not seen'
    """

    name: str = ""
    folder: Path = Path()
    shadowed: tuple[Path, ...] = ()
    summary: str = ""


def describe(name_or_path: str | Path) -> ModelDescription:
    """What a model is, without loading it: kind, licence, data, metrics, recipe, url, size and sha256 of its state.

    Of a Hugging Face repository only the description and the card are fetched.

    Raises:
        NameMismatchError: there is no model of this name.
        FileFormatError: its ``model.toml`` cannot be read.

    Example:
        >>> describe("face_landmarks").kind
        'landmark_trees'
    """
    reference = hub_reference(str(name_or_path))
    folder = find(name_or_path) if reference is None else fetch_description(reference)
    record = dict(vars(read_record(folder)))
    record["url"] = record["url"] or (folder.resolve().as_uri() if reference is None else str(reference))
    shadowed = () if is_path(name_or_path) else tuple(named_folders(str(name_or_path))[1:])
    return ModelDescription(
        **record,
        name=folder.name if reference is None else reference.name,
        folder=folder,
        shadowed=shadowed,
        summary=_summary(read_card(folder)),
    )


def _summary(card: str) -> str:
    """The words of a card's first paragraph up to their first stop."""
    for line in card.splitlines():
        if line.strip() and not line.startswith(("#", "**")):
            return re.split(r"[:;.](?:\s|$)", line.strip())[0]
    return ""
