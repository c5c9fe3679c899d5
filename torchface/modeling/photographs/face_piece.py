"""Piece of a photograph around its landmarks, and the camera that sees it."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.landmarks.images.face_crop import cut_crop

SIDE = 480
_MARGIN = 0.45  # of the landmarks' extent, on each side


@dataclass(frozen=True, eq=False)
class FacePiece:
    """A square of 480 pixels a side that shows a face."""

    image: Tensor  # (3,480,480) in [0,1]
    corner: Tensor  # of the photograph, left and top, (2,)
    scale: float  # pixels of the piece for one of the photograph

    @staticmethod
    def around(image: Tensor, marks: Tensor) -> "FacePiece":
        """That of a photograph (3,H,W) around landmarks (L,2); NaN for missing ones."""
        known = marks[torch.isfinite(marks).all(-1)].double()
        low, high = known.amin(0), known.amax(0)
        side = float((high - low).max()) * (1 + 2 * _MARGIN)
        corner, scale = (low + high) / 2 - side / 2, SIDE / side
        shift = scale * torch.cat([torch.eye(2, dtype=torch.float64), -corner[:, None]], dim=1)
        piece = cut_crop((255 * image[:3].clamp(0, 1)).round().byte(), shift, SIDE)
        return FacePiece(piece.float() / 255, corner, scale)

    def camera(self, camera: Camera) -> Camera:
        """Of the photograph's camera the one that sees the piece."""
        zoom = torch.diag(torch.tensor([self.scale, self.scale, 1.0], dtype=torch.float64))
        zoom[:2, 2] = -self.corner * self.scale
        return replace(camera, intrinsics=zoom @ camera.intrinsics.double(), width=SIDE, height=SIDE)

    def whole(self, camera: Camera, like: Camera) -> Camera:
        """Of a camera that sees the piece the one that sees the photograph, of the size of another."""
        back = torch.diag(torch.tensor([1 / self.scale, 1 / self.scale, 1.0], dtype=torch.float64))
        back[:2, 2] = self.corner
        return replace(camera, intrinsics=back @ camera.intrinsics, width=like.width, height=like.height)

    def to_photograph(self, pixels: Tensor) -> Tensor:
        """Pixels (...,2) of the piece as those of the photograph."""
        return pixels / self.scale + self.corner

    def from_photograph(self, pixels: Tensor) -> Tensor:
        """Pixels (...,2) of the photograph as those of the piece."""
        return (pixels - self.corner) * self.scale
