"""The webcam's solver, and its graph from a picture to weights: made once of the zoo's models, then cached."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import onnx
import onnxruntime

from torchface import zoo
from torchface.capture.anybody import WebcamSettings, WebcamSolver
from torchface.capture.anybody.skin_follower import SkinFollower
from torchface.errors import NameMismatchError
from torchface.landmarks import BoxNetwork, LandmarkNetwork
from torchface.landmarks.images.frame_reader.face_reader import FaceReader, WebcamNetworks
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.modeling import HeadModel
from torchface.onnx.runtime_format import in_runtime_format
from torchface.onnx.webcam.webcam_model import (
    WebcamGraph,
    WebcamSolverGraph,
    reading_model,
    reading_parts,
    solving_model,
    webcam_model,
)
from torchface.progress import Progress, silent
from torchface.synthetic.head.performer import performer
from torchface.workflows.cached_graph import cached_file, cached_graph, kept_file
from torchface.workflows.named_finders import part_finder
from torchface.workflows.named_priors import DEFAULT_PRIOR, load_priors

__all__ = ["default_webcam_solver"]

HEADS = "head"
"""The model of the zoo that says which heads there are."""

NETWORKS = ("face_boxes", "landmark_network", "eye_network")
MODELS = (*NETWORKS, HEADS, DEFAULT_PRIOR)
"""Of the zoo: what the graph is made of."""

_STEP, _PARTS = "making the webcam's graph, once; a minute on a quiet machine", 4
_INTERVAL = 5.0  # seconds
_READING = ("onnx", "landmarks/images")
_CODE = ("onnx", "capture", "landmarks/images", "synthetic/head")  # whose code says what becomes of the models


def webcam_networks() -> WebcamNetworks:
    """The zoo's."""
    boxes, landmarks, eyes = NETWORKS
    return WebcamNetworks(
        zoo.get_model(boxes, BoxNetwork), zoo.get_model(landmarks, LandmarkNetwork), zoo.get_model(eyes, EyeNetwork)
    )


def webcam_module() -> WebcamGraph:
    """What the graph is exported from."""
    return WebcamGraph(FaceReader(webcam_networks()), WebcamSolverGraph(default_webcam_solver()))


def webcam_graph(progress: Progress | None = None) -> bytes:
    """The graph's file: from the cache where it is there and whole, else made, which takes about a minute. Parts that
    an interrupted start has made are taken.
    """

    progress = progress or silent
    models = _models()
    networks = {name: models[name] for name in NETWORKS}

    def make() -> onnx.ModelProto:
        with _told(progress, 0):
            solver = WebcamSolverGraph(default_webcam_solver())
            solving = cached_graph("webcam_solving", lambda: solving_model(solver), _CODE, models=models)
        reader, parts = FaceReader(webcam_networks()), dict[str, onnx.ModelProto]()
        for name, make_part in reading_parts(reader).items():
            with _told(progress, 1 + len(parts)):
                part = cached_graph(f"webcam_{name}", make_part, _READING, models=networks)
            parts[name] = onnx.ModelProto.FromString(part)
        with _told(progress, 1 + len(parts)):
            reading = reading_model(reader, solver.state_size, parts)
        licences = {name: zoo.describe(name).licence for name in MODELS}
        solved = onnx.ModelProto.FromString(solving)
        return webcam_model(reading, solved, {"licence": "MIT", "licences": licences})

    return cached_graph("webcam", make, _CODE, models=models)


def prepared_webcam_graph(progress: Progress | None = None) -> bytes:
    """The graph as :class:`~torchface.onnx.webcam.webcam_session.WebcamSession` begins with it soonest; see
    :func:`webcam_graph`."""
    make = lambda: in_runtime_format(webcam_graph(progress))[0]  # noqa: E731
    return cached_file("webcam_prepared", ".ort", make, _CODE, models=_models(), runtime=onnxruntime.__version__)


def kept_webcam_graph() -> bytes | None:
    """That of :func:`prepared_webcam_graph`, if it has been made."""
    return kept_file("webcam_prepared", ".ort", _CODE, models=_models(), runtime=onnxruntime.__version__)


def _models() -> dict[str, Path]:
    return {name: zoo.find(name) for name in MODELS}


@contextmanager
def _told(progress: Progress, done: int) -> Iterator[None]:
    """Says again and again that a part is being made: its share cannot be known."""
    ended = threading.Event()

    def tell() -> None:
        progress(_STEP, done, _PARTS)
        while not ended.wait(_INTERVAL):
            progress(_STEP, done, _PARTS)

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def default_webcam_solver(settings: WebcamSettings | None = None) -> WebcamSolver:
    """The solver of the embedded performer's mean head, with the zoo's model of heads and prior of weights.

    Raises:
        NameMismatchError: the zoo's model of heads is another kind of model.

    Example:
        >>> default_webcam_solver().names[:2]
        ('eyeBlinkLeft', 'eyeLookDownLeft')
    """
    return webcam_solver(zoo.get_model(NETWORKS[1], LandmarkNetwork).points > 0, settings)


def webcam_solver(expects: bool, settings: WebcamSettings | None = None) -> WebcamSolver:
    """The same, without the prior where a finder reads which weights are to be expected."""
    rig = performer(texture=False)
    heads = zoo.get_model(HEADS, HeadModel)
    if heads.landmarks is None:
        raise NameMismatchError(f"{HEADS}: found a HeadModel without landmarks, expected one with them")
    settings, prior = settings or WebcamSettings(), load_priors(rig, DEFAULT_PRIOR, None).shapes
    if expects:
        prior, settings = None, replace(settings, sparsity=0.0)
    return WebcamSolver(rig, heads.shape.modes[:, heads.landmarks], prior, settings)


def skin_follower() -> SkinFollower:
    """What follows the skin in frames that the solver solved."""
    return SkinFollower(performer(texture=False), part_finder())
