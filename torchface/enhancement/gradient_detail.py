"""Detail as the turn and stretch of every triangle against the smooth surface."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.enhancement.polar_parts import decode_gradients, encode_gradients, polar_parts
from torchface.enhancement.reconstruction import SurfaceReconstruction
from torchface.enhancement.surface_frames import TurnedFrames
from torchface.geometry.meshes.deformation import degenerate_triangles, triangle_frames


class GradientDetail:
    r"""Encodes what a frame has beyond its smooth part by triangles, and puts it on another smooth part.

    With :math:`F_\ell = R_\ell S_\ell` the gradient of a triangle from the neutral to the smooth part and F that to
    the frame, the detail is :math:`G = R_\ell^\top F S_\ell^{-1}`, as rotation vector and stretch: the paper's, in
    axes that turn with the smooth part. On another smooth part it becomes :math:`F = R_\ell G S_\ell`, and one solve
    finds the surface. Numbers of a frame are ordered by part, (9,F).

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, sections 4.2, 5.4 and 5.5.
    """

    def __init__(self, neutral: Tensor, faces: Tensor) -> None:
        self._faces = faces
        flat = degenerate_triangles(neutral, faces)
        frames = triangle_frames(neutral.detach().double(), faces)
        frames[flat] = torch.eye(3).to(frames)
        self._inverse = torch.linalg.inv(frames)
        self._flat = flat
        self._reconstruction = SurfaceReconstruction(neutral, faces)

    def encode(self, low: Tensor, frames: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """The detail of frames.

        Args:
            low: their smooth parts, (B,V,3), millimetres.
            frames: (B,V,3).
            turned: not used; triangles have rotations of their own.

        Returns:
            (B,9F).
        """
        rotation, stretch = polar_parts(self._gradients(low))
        G = rotation.transpose(-1, -2) @ self._gradients(frames) @ torch.linalg.inv(stretch)
        return encode_gradients(G).transpose(1, 2).flatten(1)

    def compose(self, low: Tensor, details: Tensor, turned: TurnedFrames | None = None) -> Tensor:
        """Frames (B,V,3) of smooth parts (B,V,3) and details (B,9F); ``turned`` as for :meth:`encode`."""
        rotation, stretch = polar_parts(self._gradients(low))
        G = decode_gradients(details.unflatten(1, (9, -1)).transpose(1, 2))
        changes = rotation @ (G - torch.eye(3).to(G)) @ stretch
        return self._reconstruction(low, changes)

    def site_weights(self, vertex_weights: Tensor) -> Tensor:
        """Weights of regions where this detail is: at the triangles, (R,F)."""
        return vertex_weights[:, self._faces].mean(2)

    def _gradients(self, vertices: Tensor) -> Tensor:
        gradients = triangle_frames(vertices, self._faces) @ self._inverse.to(vertices)
        return torch.where(self._flat[:, None, None], torch.eye(3).to(gradients), gradients)
