"""Classes of models by kind."""

from __future__ import annotations

from torch import nn

from torchface.capture.action_units.classifier import ActionUnitClassifier
from torchface.capture.anybody.examples.example_solver import ExampleSolver
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.capture.priors import DynamicsPrior, ReciprocalPrior, ShapePrior
from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.boxes.box_network import BoxNetwork
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.landmark_network import LandmarkNetwork
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.scans.uv_detector import UVLandmarkDetector
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.rigging.expression_regression import ExpressionRegression

KINDS: dict[str, type[nn.Module]] = {
    "action_units": ActionUnitClassifier,
    "appearance": AppearanceModel,
    "dynamics_prior": DynamicsPrior,
    "enhancement": EnhancementModel,
    "example_solver": ExampleSolver,
    "expression_regression": ExpressionRegression,
    "eye_network": EyeNetwork,
    "face_boxes": BoxNetwork,
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
