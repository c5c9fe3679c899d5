"""Detail as displacements from the smooth surface, in axes that turn with it."""

from __future__ import annotations

from torch import Tensor

from torchface.enhancement.surface_frames import SurfaceFrames, TurnedFrames


class DisplacementDetail:
    r"""Encodes what a frame has beyond its smooth part, and adds it to another smooth part.

    :math:`d = R_v^\top (x_v - \ell_v)`, with :math:`R_v` the turn of the smooth part's surface at the vertex. Nothing
    is solved for. Numbers of a frame are ordered by axis, (3,V): two tangents, then the normal.

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.
        frames: those of the mesh, where they are known.
    """

    def __init__(self, neutral: Tensor, faces: Tensor, frames: SurfaceFrames | None = None) -> None:
        self._frames = SurfaceFrames(neutral, faces) if frames is None else frames
        self._neutral = neutral

    def encode(self, low: Tensor, frames: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """The detail of frames.

        Args:
            low: their smooth parts, (B,V,3), millimetres.
            frames: (B,V,3).
            turned: how the smooth parts' surface is turned, where that is known.

        Returns:
            (B,3V), millimetres.
        """
        turned = self._frames.turned(low - self._neutral.to(low)) if turned is None else turned
        return turned.to_local(frames - low).reshape(len(low), -1)

    def compose(self, low: Tensor, details: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """Frames (B,V,3) of smooth parts (B,V,3) and details (B,3V); ``turned`` as for :meth:`encode`."""
        turned = self._frames.turned(low - self._neutral.to(low)) if turned is None else turned
        return low + turned.to_world(details.unflatten(1, (3, -1)))

    def site_weights(self, vertex_weights: Tensor) -> Tensor:
        """Weights of regions where this detail is: at the vertices, (R,V)."""
        return vertex_weights
