"""A coarse animation gets a captured actor's fine detail and timing."""

from torchface.enhancement.captured_performance import CapturedPerformance
from torchface.enhancement.enhancement_model import Enhancement, EnhancementModel
from torchface.enhancement.enhancement_settings import EnhancementSettings, EnhancementSizes

__all__ = ["CapturedPerformance", "Enhancement", "EnhancementModel", "EnhancementSettings", "EnhancementSizes"]
