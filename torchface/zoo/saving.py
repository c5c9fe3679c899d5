"""Saved models: folders with a description, a state and a card."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import nn

from torchface.errors import NameMismatchError
from torchface.files.model_roots import check_model_name
from torchface.files.models import ModelRecord, write_model
from torchface.number_checks import checked_type
from torchface.zoo.kinds import KINDS


@dataclass(frozen=True)
class ModelCard:
    """What its maker says of a model: what whoever uses it has to know, and what makes it again.

    Args:
        licence: under which the model may be used, such as ``MIT``.
        data: what it has learned from.
        metrics: what was measured on data held out.
        recipe: the command that makes it again.
        text: Markdown: what the model is good for, measured how, its limits.
        url: where it comes from, if from elsewhere.
        settings: of the recipe, the effective ones.

    Example:
        >>> card = ModelCard("MIT", "60 scans of 12 volunteers", {"mean_mm": 0.41}, "python -m train.morphable")
        >>> card.metrics["mean_mm"], card.url
        (0.41, '')
    """

    licence: str
    data: str
    metrics: Mapping[str, float]
    recipe: str
    text: str = ""
    url: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)


def save_model(model: nn.Module, folder: str | Path, card: ModelCard, half: Collection[str] = ()) -> ModelRecord:
    """Writes a model as ``model.toml``, ``state.safetensors`` and ``CARD.md``.

    Args:
        model: of one of the classes in ``KINDS``.
        folder: made where it is missing; its name is the model's.
        card: what is to be known of it.
        half: names in the state that are stored in half precision.

    Returns:
        The record as written.

    Raises:
        NameMismatchError: the model's class has no kind, or the folder's name is none for a model.
        FileFormatError: the folder cannot be written to.
        ValueRangeError: the state or a metric is not finite.
        ArgumentTypeError: the card holds something else than texts, numbers, paths, and lists and tables of them.

    Example:
        >>> from torchface import zoo
        >>> prior = zoo.get_model("shape_prior")
        >>> record = save_model(prior, "my_prior", ModelCard("MIT", data="none", metrics={}, recipe="a copy"))
        >>> zoo.get_model("./my_prior", zoo.KINDS[record.kind]).names == prior.names
        True
    """
    kinds = [kind for kind, known in KINDS.items() if type(model) is known]
    if not kinds:
        known = ", ".join(model_class.__name__ for model_class in KINDS.values())
        raise NameMismatchError(f"save_model: found a {type(model).__name__}, expected one of {known}")
    checked_type("card", card, ModelCard)
    for name in ("licence", "data", "recipe", "text", "url"):
        checked_type(f"card.{name}", getattr(card, name), str)
    folder = Path(folder)
    check_model_name(folder)
    record = ModelRecord(
        kinds[0], card.licence, card.data, dict(card.metrics), card.recipe, card.url, dict(card.settings)
    )
    return write_model(model, folder, record, card.text, half)
