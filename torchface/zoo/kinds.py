"""Classes of models by kind."""

import re

from torch import nn

from torchface.capture import ActionUnitClassifier, DynamicsPrior, ExampleSolver, MarkerSolver, ShapePrior, VideoSolver
from torchface.capture.priors import ReciprocalPrior
from torchface.enhancement import EnhancementModel
from torchface.errors import NameMismatchError
from torchface.landmarks import (
    AppearanceModel,
    BoxNetwork,
    EyeNetwork,
    LandmarkNetwork,
    LandmarkTrees,
    UVLandmarkDetector,
)
from torchface.landmarks.images.networks.part_network import PartNetwork
from torchface.modeling import ExpressionRegression, HeadModel, MorphableModel
from torchface.number_checks import checked_type

KINDS: dict[str, type[nn.Module]] = {
    "action_units": ActionUnitClassifier,
    "appearance": AppearanceModel,
    "dynamics_prior": DynamicsPrior,
    "enhancement": EnhancementModel,
    "example_solver": ExampleSolver,
    "expression_regression": ExpressionRegression,
    "eye_network": EyeNetwork,
    "face_boxes": BoxNetwork,
    "face_parts": PartNetwork,
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


def register(kind: str, model_class: type[nn.Module]) -> None:
    """Makes a kind of models of your own known: they are saved, described, verified and loaded like torchface's.

    ``torchface.onnx.export_model`` exports them if the class has a method ``example_inputs()``: tensors by name, two
    rows or more each, that ``forward`` takes in this order.

    Args:
        kind: lower-case letters, digits and ``_``; what ``model.toml`` says of such a model.
        model_class: has a property ``config``, a dict of plain values, and a classmethod ``from_config(config)`` that
            makes a model for a state to be loaded into.

    Raises:
        NameMismatchError: the name is none for a kind, is another class's, or the class lacks one of the two.

    Example:
        >>> from torchface import zoo
        >>> class Gain(nn.Module):
        ...     def __init__(self, count):
        ...         super().__init__()
        ...         self.gain = nn.Parameter(torch.ones(count))
        ...     @property
        ...     def config(self):
        ...         return {"count": len(self.gain)}
        ...     @classmethod
        ...     def from_config(cls, config):
        ...         return cls(config["count"])
        >>> zoo.register("gain", Gain)
        >>> record = zoo.save_model(Gain(3), "my_gain", zoo.ModelCard("MIT", "none", {}, "by hand"))
        >>> zoo.get_model("./my_gain", Gain).gain.shape
        torch.Size([3])
    """
    if not _KIND.fullmatch(checked_type("kind", kind, str)):
        raise NameMismatchError(f"kind: found {kind[:80]!r}, expected up to 64 lower-case letters, digits and _")
    known = KINDS.get(kind, model_class)
    if known is not model_class and (known.__module__, known.__qualname__) != (
        model_class.__module__,
        model_class.__qualname__,
    ):
        raise NameMismatchError(f"kind: found {kind!r}, which is {known.__name__}'s, expected another name")
    other = next((name for name, taken in KINDS.items() if taken is model_class and name != kind), None)
    if other is not None:
        raise NameMismatchError(f"kind: found {kind!r} for {model_class.__name__}, which is {other!r} already")
    missing = [name for name in ("config", "from_config") if not hasattr(model_class, name)]
    if missing:
        raise NameMismatchError(f"{model_class.__name__}: found no {missing[0]}, expected `config` and `from_config`")
    KINDS[kind] = model_class


_KIND = re.compile(r"[a-z][a-z0-9_]{0,63}", re.ASCII)
