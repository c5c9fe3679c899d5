"""The graph from a webcam's picture to weights: made once of the zoo's models, then taken from the cache."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

import torchface
from torchface import zoo
from torchface.errors import FileFormatError
from torchface.files.cache_folder import cache_folder
from torchface.files.content_keys import content_key
from torchface.files.whole_files import all_or_none, read_file, write_file
from torchface.landmarks import BoxNetwork, LandmarkNetwork
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.onnx.webcam.webcam_model import WebcamNetworks, webcam_model
from torchface.onnx.webcam.webcam_solver_graph import webcam_solver_model
from torchface.progress import Progress, silent
from torchface.workflows.track.track_models import DEFAULT_PRIOR
from torchface.workflows.webcam.default_solver import HEADS, default_webcam_solver

NETWORKS = ("face_boxes", "landmark_network", "eye_network")
MODELS = (*NETWORKS, HEADS, DEFAULT_PRIOR)
"""Of the zoo: what the graph is made of."""

_METHOD = "webcam graph 1"
_SOURCES = ("onnx", "capture", "landmarks/images", "synthetic/head")  # whose code says what becomes of the models


def webcam_networks() -> WebcamNetworks:
    """The zoo's.

    Raises:
        NameMismatchError: one of them is another kind of model.
    """
    boxes, landmarks, eyes = NETWORKS
    return WebcamNetworks(
        zoo.get_model(boxes, BoxNetwork), zoo.get_model(landmarks, LandmarkNetwork), zoo.get_model(eyes, EyeNetwork)
    )


def webcam_graph(progress: Progress | None = None) -> bytes:
    """The graph's file: from the cache where it is there and whole, else made, which takes a minute.

    Raises:
        NameMismatchError: a model of the zoo is of another kind.
        FileFormatError: the cache's folder cannot be made or written to.
    """
    progress = progress or silent
    package = Path(torchface.__file__).parent
    sources = {one: sorted((package / one).rglob("*.py")) for one in _SOURCES}
    key = content_key(_METHOD, models={name: zoo.find(name) for name in MODELS}, **sources)[:32]
    folder = cache_folder("webcam")
    path, mark = folder / f"{key}.onnx", folder / f"{key}.sha256"
    with suppress(FileFormatError):  # not there, or damaged
        content = read_file(path)
        if read_file(mark).decode("ascii", "replace") == hashlib.sha256(content).hexdigest():
            return content
    progress("making the webcam's graph, once")
    licences = {name: zoo.describe(name).licence for name in MODELS}
    solver = webcam_solver_model(default_webcam_solver())
    model = webcam_model(webcam_networks(), solver, facts={"licence": "MIT", "licences": licences})
    content = model.SerializeToString()
    with all_or_none():
        write_file(path, content)
        write_file(mark, hashlib.sha256(content).hexdigest().encode())
    return content
