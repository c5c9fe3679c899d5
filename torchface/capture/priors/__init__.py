"""Priors learned from takes: which weights faces have, and how they change."""

from torchface.capture.priors.adapted_dynamics import AdaptedDynamicsPrior, adapt_dynamics
from torchface.capture.priors.dynamics_prior import DynamicsPrior, DynamicsSettings
from torchface.capture.priors.motion_features import face_regions, windows_of
from torchface.capture.priors.name_translation import unlearned
from torchface.capture.priors.parzen_window import ParzenDensity, automatic_bandwidth
from torchface.capture.priors.shape_prior import ReciprocalPrior, ShapePrior, face_halves
from torchface.capture.priors.student_t import StudentDensity

__all__ = [
    "AdaptedDynamicsPrior",
    "DynamicsPrior",
    "DynamicsSettings",
    "ParzenDensity",
    "ReciprocalPrior",
    "ShapePrior",
    "StudentDensity",
    "adapt_dynamics",
    "automatic_bandwidth",
    "face_halves",
    "face_regions",
    "unlearned",
    "windows_of",
]
