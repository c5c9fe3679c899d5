"""Blendshape weights of somebody before a webcam, from the landmarks of their face alone."""

from torchface.capture.webcam.example_expressions import (
    ExampleExpression,
    character_matrix,
    head_angles,
    paper_expressions,
)
from torchface.capture.webcam.example_methods import AllAtOnce, Regional
from torchface.capture.webcam.example_shapes import ExampleShapes
from torchface.capture.webcam.example_solver import ExampleFit, ExampleSolver
from torchface.capture.webcam.landmark_model import LandmarkModel
from torchface.capture.webcam.landmark_objectives import Distances, SquaredDistances
from torchface.capture.webcam.landmark_placement import LandmarkBoxes, SolvedSimilarity
from torchface.capture.webcam.rig_examples import paper_examples, rig_examples

__all__ = [
    "AllAtOnce",
    "Distances",
    "ExampleExpression",
    "ExampleFit",
    "ExampleShapes",
    "ExampleSolver",
    "LandmarkBoxes",
    "LandmarkModel",
    "Regional",
    "SolvedSimilarity",
    "SquaredDistances",
    "character_matrix",
    "head_angles",
    "paper_examples",
    "paper_expressions",
    "rig_examples",
]
