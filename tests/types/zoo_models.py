"""What checkers of types know of models; `make lint` checks this file, and nothing runs it."""

from pathlib import Path
from typing import assert_type

from torch import nn

from torchface import zoo
from torchface.capture import MarkerSolver
from torchface.landmarks.images.networks.landmark_network import LandmarkNetwork
from torchface.modeling import HeadModel

assert_type(zoo.get_model("marker_solver"), MarkerSolver)
assert_type(zoo.get_model("landmark_network", device="cuda"), LandmarkNetwork)
assert_type(zoo.get_model("./mine", HeadModel), HeadModel)
assert_type(zoo.get_model(Path("mine"), kind=HeadModel), HeadModel)
assert_type(zoo.get_model("mine"), nn.Module)
wrong: HeadModel = zoo.get_model("marker_solver")  # type: ignore[assignment]  # needed, or mypy fails
