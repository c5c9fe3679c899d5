"""What is read off crops of eyes: lids, irises, how far each eye is open, and whether it is shut or hidden."""

from torchface.landmarks.images.eyes.eye_crop import eye_transforms
from torchface.landmarks.images.eyes.eye_network import EyeFindings, EyeNetwork
from torchface.landmarks.images.eyes.eye_training import fit_eyes

# The training imports the model; the model gets its `fit` here.
EyeNetwork.fit = staticmethod(fit_eyes)

__all__ = ["EyeFindings", "EyeNetwork", "eye_transforms"]
