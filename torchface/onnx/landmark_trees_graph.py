"""Landmark trees as ONNX: one grey image and boxes of faces in it to landmarks."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees, initial_shapes
from torchface.onnx.checked_export import ExportReport, export_checked

_PARITY = 0.1  # pixels; a rounding error may read the pixel beside, which moves a face by some hundredths


def export_landmark_trees(
    model: LandmarkTrees, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes landmark trees as ONNX, and checks them.

    The graph takes ``image`` (height,width), grey, 0 to 255, and ``boxes`` (B,4) of faces in it: x, y, width, height.
    Boxes are in pixels.
    It gives ``landmarks`` (B,L,2), pixels, x right and y down; a box that is not finite gives NaN.
    """
    generator = torch.Generator().manual_seed(0)
    cases = []
    for faces, height, width in ((1, 120, 100), (3, 90, 140)):
        coarse = torch.rand(1, 1, height // 12, width // 12, generator=generator)
        cloudy = nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)
        stored = (255 * cloudy).round()
        boxes = torch.tensor([25.0, 20, 50, 50]) + 10 * torch.rand(faces, 4, generator=generator)
        expected = model((stored / 255).expand(faces, 1, height, width), boxes)
        cases.append(({"image": stored[0, 0].to(torch.uint8), "boxes": boxes}, {"landmarks": expected}))
    count = len(model.mean)
    metadata = {
        "task": "face_landmarks",
        "landmarks": "iBUG 68" if count == 68 else str(count),
        "image": "grey, 0 to 255",
        "boxes": "x, y, width, height in pixels, as OpenCV's face detector gives them",
        "units": "pixels",
        **(facts or {}),
    }
    sizes = {"image": ("height", "width"), "boxes": ("faces",)}
    parity, units = {"landmarks": _PARITY}, {"landmarks": "pixels"}
    return export_checked(_TreesOnImage(model), path, cases, parity, units, metadata, sizes)


class _TreesOnImage(nn.Module):
    """Landmark trees on the faces of one grey image, 0 to 255."""

    def __init__(self, trees: LandmarkTrees) -> None:
        super().__init__()
        self.trees = trees

    def forward(self, image: Tensor, boxes: Tensor) -> Tensor:
        return self.trees.refined(image[None, None].float() / 255, initial_shapes(self.trees.mean, boxes))
