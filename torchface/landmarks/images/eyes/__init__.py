"""What is read off crops of eyes: lids, irises, how far each eye is open, and whether it is shut or hidden."""

from torchface.landmarks.images.eyes.eye_crop import eye_transforms
from torchface.landmarks.images.eyes.eye_network import EyeNetwork

__all__ = ["EyeNetwork", "eye_transforms"]
