"""Landmarks on faces: in images, and on scans unwrapped into UV space."""

from torchface.landmarks.images.appearance.appearance_model import AppearanceFit, AppearanceModel, AppearanceSettings
from torchface.landmarks.images.box_landmarks import find_landmarks
from torchface.landmarks.images.boxes.box_network import BoxNetwork
from torchface.landmarks.images.boxes.box_training import BoxTrainingSettings, LabelledPicture
from torchface.landmarks.images.boxes.face_box import FaceBoxes, NoFaceError
from torchface.landmarks.images.boxes.network_detector import NetworkDetector
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.find_faces import find_faces
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.landmarks.images.networks.eye_network import EyeFindings, EyeNetwork
from torchface.landmarks.images.networks.landmark_network import LandmarkNetwork, NetworkLandmarks
from torchface.landmarks.images.networks.landmark_training import NetworkSettings
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.landmarks.images.tracking.video_landmarks import landmark_jitter, track_landmarks
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.images.trees.tree_finder import TreeFinder
from torchface.landmarks.images.trees.tree_training import TreeSettings
from torchface.landmarks.scans.contours import Contour, trace_contour
from torchface.landmarks.scans.cylinder import CylinderLayout, UnwrappedHead, unwrap
from torchface.landmarks.scans.detector_settings import DetectorSettings
from torchface.landmarks.scans.face_frame import FaceFrame
from torchface.landmarks.scans.landmark_pairs import AutomaticLandmarks, LandmarkPairs
from torchface.landmarks.scans.scan_annotations import ScanAnnotation, load_annotations
from torchface.landmarks.scans.scan_landmarks import (
    ScanLandmarks,
    appearance_image,
    curvature_image,
    line_image,
    scan_landmarks,
)
from torchface.landmarks.scans.uv_detector import LineExamples, UVLandmarkDetector, UVLandmarks
from torchface.landmarks.scans.uv_landmark_names import UV_LANDMARK_NAMES, uv_landmarks_from_ibug

__all__ = [
    "UV_LANDMARK_NAMES",
    "AppearanceFit",
    "AppearanceModel",
    "AppearanceSettings",
    "AutomaticLandmarks",
    "BoxNetwork",
    "BoxTrainingSettings",
    "Contour",
    "CylinderLayout",
    "DetectorSettings",
    "EyeFindings",
    "EyeNetwork",
    "FaceBoxes",
    "FaceFrame",
    "FaceReading",
    "LabelledPicture",
    "LandmarkFinder",
    "LandmarkNetwork",
    "LandmarkPairs",
    "LandmarkTracker",
    "LandmarkTrees",
    "LineExamples",
    "NetworkDetector",
    "NetworkLandmarks",
    "NetworkSettings",
    "NoFaceError",
    "ScanAnnotation",
    "ScanLandmarks",
    "TreeFinder",
    "TreeSettings",
    "UVLandmarkDetector",
    "UVLandmarks",
    "UnwrappedHead",
    "appearance_image",
    "curvature_image",
    "find_faces",
    "find_landmarks",
    "landmark_jitter",
    "line_image",
    "load_annotations",
    "scan_landmarks",
    "trace_contour",
    "track_landmarks",
    "unwrap",
    "uv_landmarks_from_ibug",
]
