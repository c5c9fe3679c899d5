"""Landmarks of faces in images and videos: face box, network, regression trees, appearance model, tracking."""

from torchface.landmarks.images.appearance_model import AppearanceModel
from torchface.landmarks.images.appearance_training import learn_appearance
from torchface.landmarks.images.box_network import BoxNetwork
from torchface.landmarks.images.box_training import fit_boxes
from torchface.landmarks.images.landmark_trees import LandmarkTrees
from torchface.landmarks.images.network import LandmarkNetwork
from torchface.landmarks.images.network_training import fit_network
from torchface.landmarks.images.tree_training import fit_trees

# The training imports the model; the model gets its `fit` here.
AppearanceModel.fit = staticmethod(learn_appearance)
LandmarkNetwork.fit = staticmethod(fit_network)
BoxNetwork.fit = staticmethod(fit_boxes)
LandmarkTrees.fit = staticmethod(fit_trees)
