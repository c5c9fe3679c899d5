"""Blendshape weights of somebody before a webcam, from the landmarks of their face alone."""

from torchface.capture.anybody.examples.example_expressions import (
    ExampleExpression,
    character_matrix,
    paper_expressions,
)
from torchface.capture.anybody.examples.example_methods import AllAtOnce, ExampleMethod, Regional, SquaredDistances
from torchface.capture.anybody.examples.example_shapes import ExampleShapes
from torchface.capture.anybody.examples.example_solver import ExampleFit, ExampleSolver, landmark_observability
from torchface.capture.anybody.examples.landmark_model import LandmarkModel
from torchface.capture.anybody.examples.landmark_placement import LandmarkBoxes, SolvedSimilarity
from torchface.capture.anybody.examples.rig_examples import paper_examples, rig_examples
from torchface.capture.anybody.examples.shown_examples import example_remarks, shown_examples
from torchface.capture.anybody.webcam_components import WebcamSettings
from torchface.capture.anybody.webcam_solver import WebcamSolver
from torchface.capture.anybody.webcam_state import WebcamControls, WebcamState

__all__ = [
    "AllAtOnce",
    "ExampleExpression",
    "ExampleFit",
    "ExampleMethod",
    "ExampleShapes",
    "ExampleSolver",
    "LandmarkBoxes",
    "LandmarkModel",
    "Regional",
    "SolvedSimilarity",
    "SquaredDistances",
    "WebcamControls",
    "WebcamSettings",
    "WebcamSolver",
    "WebcamState",
    "character_matrix",
    "example_remarks",
    "landmark_observability",
    "paper_examples",
    "paper_expressions",
    "rig_examples",
    "shown_examples",
]
