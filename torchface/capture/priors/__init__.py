"""What faces do, learned from takes: which weights, and how they go on."""

from torchface.capture.priors.adapted_dynamics import AdaptedDynamicsPrior, adapt_dynamics
from torchface.capture.priors.dynamics import DynamicsPrior, DynamicsSettings
from torchface.capture.priors.gaussian_mixture import GaussianMixture
from torchface.capture.priors.learned_names import unlearned
from torchface.capture.priors.motion import face_regions, resampled, windows_of
from torchface.capture.priors.parzen import ParzenDensity, automatic_bandwidth
from torchface.capture.priors.shape_prior import ReciprocalPrior, ShapePrior, face_halves
from torchface.capture.priors.student import StudentDensity

__all__ = [
    "AdaptedDynamicsPrior",
    "DynamicsPrior",
    "DynamicsSettings",
    "GaussianMixture",
    "ParzenDensity",
    "ReciprocalPrior",
    "ShapePrior",
    "StudentDensity",
    "adapt_dynamics",
    "automatic_bandwidth",
    "face_halves",
    "face_regions",
    "resampled",
    "unlearned",
    "windows_of",
]
