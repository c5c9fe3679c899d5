"""Models by name or folder, each with its class for type checkers."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

import torch
from torch import nn

from torchface.capture import ActionUnitClassifier, DynamicsPrior, MarkerSolver, ShapePrior
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.files.models import CARD, ModelRecord, read_card, read_model, read_record
from torchface.landmarks import BoxNetwork, EyeNetwork, LandmarkNetwork, LandmarkTrees, UVLandmarkDetector
from torchface.landmarks.images.networks.part_network import PartNetwork
from torchface.modeling import ExpressionRegression, HeadModel
from torchface.zoo.hub import fetch_description, hub_reference
from torchface.zoo.kinds import KINDS
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


Model = TypeVar("Model", bound=nn.Module)
Device = str | torch.device


@overload
def get_model(name_or_path: Literal["action_units"], *, device: Device = "cpu") -> ActionUnitClassifier: ...
@overload
def get_model(name_or_path: Literal["dynamics_prior"], *, device: Device = "cpu") -> DynamicsPrior: ...
@overload
def get_model(name_or_path: Literal["expressions"], *, device: Device = "cpu") -> ExpressionRegression: ...
@overload
def get_model(name_or_path: Literal["eye_network"], *, device: Device = "cpu") -> EyeNetwork: ...
@overload
def get_model(name_or_path: Literal["face_parts"], *, device: Device = "cpu") -> PartNetwork: ...
@overload
def get_model(name_or_path: Literal["face_boxes"], *, device: Device = "cpu") -> BoxNetwork: ...
@overload
def get_model(name_or_path: Literal["face_landmarks"], *, device: Device = "cpu") -> LandmarkTrees: ...
@overload
def get_model(name_or_path: Literal["head"], *, device: Device = "cpu") -> HeadModel: ...
@overload
def get_model(name_or_path: Literal["landmark_network"], *, device: Device = "cpu") -> LandmarkNetwork: ...
@overload
def get_model(name_or_path: Literal["marker_solver"], *, device: Device = "cpu") -> MarkerSolver: ...
@overload
def get_model(name_or_path: Literal["shape_prior"], *, device: Device = "cpu") -> ShapePrior: ...
@overload
def get_model(name_or_path: Literal["uv_landmarks"], *, device: Device = "cpu") -> UVLandmarkDetector: ...
@overload
def get_model(name_or_path: str | Path, kind: type[Model], *, device: Device = "cpu") -> Model: ...
@overload
def get_model(name_or_path: str | Path, *, device: Device = "cpu") -> nn.Module: ...
def get_model(name_or_path: str | Path, kind: type[nn.Module] = nn.Module, *, device: Device = "cpu") -> Any:
    """A model, ready for use.

    What checks types knows the class of each model that ships by its name, and of any other by ``kind``.

    Args:
        name_or_path: a name of :func:`list_models`; or a folder, as a ``Path`` or by its path. A name of the zoo goes
            before a folder of that name in the working directory; a separator (``./head``) asks for the folder. Or
            ``hf://owner/name``, ``hf://owner/name@revision``, ``hf://owner/name/folder``: a repository of the Hugging
            Face Hub, fetched once (extra ``hub``).
        kind: the class that the model has to be of, or a base of it.
        device: where the model is to lie, such as ``"cuda:1"``.

    Returns:
        A module of one of the classes in ``KINDS``, in evaluation mode.

    Raises:
        NameMismatchError: there is no model of this name, or it is of another kind.
        FileFormatError: a file is missing, damaged, of a newer format, or does not have the hash it should have.
        ValueRangeError: the device is not there.
        MissingExtraError: a repository is asked for, and ``huggingface_hub`` is not installed.

    Example:
        >>> prior = get_model("shape_prior")
        >>> rest = torch.zeros(1, len(prior.names), dtype=torch.float64)
        >>> bool(prior.log_density(rest) > prior.log_density(rest + 1))
        True
        >>> get_model("shape_prior", MarkerSolver)
        Traceback (most recent call last):
            ...
        torchface.errors.NameMismatchError: model: found shape_prior, a ShapePrior, expected a MarkerSolver
    """
    target = _checked(device)
    if kind is not nn.Module:
        model_class = KINDS.get(describe(name_or_path).kind)
        if model_class is not None and not issubclass(model_class, kind):
            raise NameMismatchError(f"model: found {name_or_path}, {_a(model_class)}, expected {_a(kind)}")
    return read_model(find(name_or_path), KINDS).to(target)


def verify(name_or_path: str | Path) -> ModelDescription:
    """Checks that a model is whole: its files are there, the state has its size and hash, and it loads.

    Returns:
        What the model is.

    Raises:
        NameMismatchError: there is no model of this name.
        FileFormatError: a file is missing or damaged; the message says what was found and what was expected.

    Example:
        >>> verify("shape_prior").kind
        'shape_prior'
    """
    folder = find(name_or_path)
    description = describe(name_or_path)
    if not (folder / CARD).is_file():
        raise FileFormatError(f"{folder / CARD}: found no such file, expected the model's card")
    read_model(folder, KINDS)
    return description


def _a(kind: type) -> str:
    return f"{'an' if kind.__name__[0] in 'AEIOU' else 'a'} {kind.__name__}"


def _checked(device: Device) -> torch.device:
    """A device on which a tensor can be made."""
    try:
        target = torch.device(device)
        torch.empty(0, device=target)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as error:
        there = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
        there += ["mps"] if torch.backends.mps.is_available() else []
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueRangeError(f"device: found {str(device)!r} ({why}), expected one of {', '.join(there)}") from error
    return target
