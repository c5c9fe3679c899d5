"""A coarse animation gets a captured actor's fine detail and timing."""

from torchface.enhancement.enhancement_model import Enhancement, EnhancementModel

__all__ = ["Enhancement", "EnhancementModel"]
