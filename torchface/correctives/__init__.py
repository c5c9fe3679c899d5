"""Correctives of a blendshape rig: what is added where shapes act together, or half-way along one of them."""

from torchface.correctives.corrective_shapes import Corrective, Correctives

__all__ = ["Corrective", "Correctives"]
