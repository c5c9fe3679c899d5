"""Landmark finders by the names that a user gives."""

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.landmarks import BoxNetwork, LandmarkNetwork, LandmarkTrees
from torchface.landmarks.images.boxes.network_detector import NetworkDetector, graph_boxes
from torchface.landmarks.images.checked_detector import PROPOSED, CheckedDetector, shipped_networks
from torchface.landmarks.images.face_landmarker.mediapipe_finder import MediaPipeFinder
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.landmarks.images.networks.crop_finder import BothSides
from torchface.landmarks.images.networks.eye_finder import EyedFinder, EyeFinder, graph_eye_finder
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.onnx_finder import graph_finder, onnx_finder
from torchface.landmarks.images.networks.part_finder import PartFinder, graph_part_finder
from torchface.landmarks.images.networks.part_network import PartNetwork
from torchface.landmarks.images.trees.landmark_consensus import ConsensusSettings
from torchface.landmarks.images.trees.tree_finder import PHOTOGRAPH, TreeFinder
from torchface.workflows.cached_graph import cached_graph

if TYPE_CHECKING:
    import onnx

__all__ = ["NamedFinder", "load_finder"]

DEFAULT_LANDMARKS = "landmark_network"  # the model of the zoo that finds landmarks where none is named
EYES = "eye_network"  # the model of the zoo that reads eyes
PARTS = "face_parts"  # the model of the zoo that says which part of a face each pixel shows
Shown = Literal["live", "film", "photograph"]
BUNDLE = ".task"  # the ending of MediaPipe's Face Landmarker bundles


@dataclass(frozen=True)
class NamedFinder:
    """What finds landmarks, and where it comes from.

    Args:
        finder: finds them.
        source: the file or folder, for keys of what depends on it.
        places: of the points that it finds beside the 68, on the embedded performer's sculpture, (P,3) millimetres.
        expects: whether it reads which weights are to be expected, so that solves need no other prior.
    """

    finder: LandmarkFinder
    source: Path | str
    places: Tensor = field(default_factory=lambda: torch.zeros(0, 3))
    expects: bool = False


def load_finder(
    name_or_path: str | Path = DEFAULT_LANDMARKS, shown: Shown = "live", option: str = "--landmarks"
) -> NamedFinder:
    """A finder of landmarks.

    Args:
        name_or_path: a model of the zoo by name or folder, see ``zoo.get_model``; an ``.onnx`` file, see
            :func:`~torchface.landmarks.images.networks.onnx_finder.onnx_finder`; or MediaPipe's Face Landmarker
            bundle, ``.task``.
        shown: what it is for. A network is shown the mirror image of faces in films and photographs too, trees take for
            a photograph the time that a single picture is worth.
        option: of the command that gives the name, for messages.

    Raises:
        NameMismatchError: there is none of this name, or it is of another kind.
        ValueRangeError: it finds other landmarks than iBUG's 68, or ``shown`` is none of these.
        FileFormatError: it is damaged, or a graph of other inputs and outputs.
        MissingExtraError: a bundle is asked for, and LiteRT, which runs it, is not installed.

    Example:
        >>> load_finder("face_landmarks").finder.name
        'face_landmarks'
    """
    if shown not in get_args(Shown):
        raise ValueRangeError(f"shown: found {shown!r}, expected one of {', '.join(get_args(Shown))}")
    if Path(name_or_path).suffix.lower() == ".csv":
        raise NameMismatchError(f"{option}: found {name_or_path}, a table of landmarks, expected what finds them")
    if Path(name_or_path).suffix.lower() == BUNDLE:
        return NamedFinder(MediaPipeFinder(name_or_path, Path(name_or_path).name), Path(name_or_path))
    if Path(name_or_path).suffix.lower() == ".onnx":
        return NamedFinder(onnx_finder(name_or_path), Path(name_or_path))
    model = zoo.get_model(name_or_path)
    if isinstance(model, LandmarkNetwork):
        finder = network_finder(model, str(name_or_path), shown != "live")
        return NamedFinder(finder, zoo.find(name_or_path), model.places, model.points > 0)
    if not isinstance(model, LandmarkTrees):
        raise NameMismatchError(
            f"{option}: found {name_or_path}, a {type(model).__name__}, expected a LandmarkTrees or LandmarkNetwork"
        )
    starts = PHOTOGRAPH if shown == "photograph" else ConsensusSettings()
    try:
        return NamedFinder(TreeFinder(model, starts, str(name_or_path)), zoo.find(name_or_path))
    except ValueRangeError as error:
        raise ValueRangeError(f"{name_or_path}: {error}") from error


def network_finder(network: LandmarkNetwork, name: str, both_sides: bool = False) -> EyedFinder:
    """A finder that runs a landmark network, and on the eyes that it finds the zoo's eye network, in ONNX Runtime:
    in a third of PyTorch's time for single crops. With ``both_sides`` it is shown each crop's mirror image too."""
    finder = graph_finder(_graph(network), Path(name))
    if both_sides:
        finder = replace(finder, network=BothSides(finder.network, network.mirror))
    return EyedFinder(finder, eye_finder())


@cache
def eye_finder() -> EyeFinder:
    """What reads lids and irises off the eyes of faces whose landmarks are known: the zoo's ``eye_network``."""
    return graph_eye_finder(_graph(zoo.get_model(EYES, EyeNetwork)))


@cache
def part_finder() -> PartFinder:
    """What says which part of a face each pixel of a photograph shows: the zoo's ``face_parts``."""
    return graph_part_finder(_graph(zoo.get_model(PARTS, PartNetwork)))


@cache
def graph_detector() -> CheckedDetector:
    """``shipped_detector`` in ONNX Runtime."""
    boxes, landmarks = shipped_networks()
    finder = graph_finder(_graph(landmarks), Path(DEFAULT_LANDMARKS))
    return CheckedDetector(NetworkDetector(graph_boxes(_graph(boxes)), PROPOSED), finder)


def _graph(network: LandmarkNetwork | EyeNetwork | PartNetwork | BoxNetwork) -> bytes:
    def make() -> "onnx.ModelProto":
        from torchface.onnx.network_graphs import network_model

        return network_model(network)

    return cached_graph("networks", make, ("onnx", "landmarks/images"), network=network)
