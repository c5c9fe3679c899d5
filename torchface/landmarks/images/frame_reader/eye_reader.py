"""Reading of a face's two eyes in a picture: ``EyeFinder`` without a choice by values."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.frame_reader.picture_pieces import AROUND, sampled
from torchface.landmarks.images.networks.eye_crop import eye_transforms, moved, picture_transforms
from torchface.landmarks.images.networks.eye_finder import LEAST, merged_lids
from torchface.landmarks.images.networks.eye_network import EyeNetwork


def read_eyes(image: Tensor, face: FaceReading, network: EyeNetwork) -> FaceReading:
    """A face with its eyes, and its lids where both networks together put them.

    Args:
        image: uint8 (H,W,C), red first.
        face: with finite landmarks.
        network: is shown both eyes, the left in a mirror.

    Returns:
        Eyes that are too small have irises and openness of NaN and a visibility of 0.
    """
    width, height = network.width, network.height
    back = picture_transforms(eye_transforms(face.landmarks, width, height))
    across, down = torch.arange(width).float(), torch.arange(height).float()
    grid = torch.stack(torch.meshgrid(across, down, indexing="xy"), -1).reshape(-1, 2)
    spacing = back[0, :, 0].square().sum().sqrt()  # pixels of the picture a pixel of the crop
    points = moved(grid, back).flatten(0, 1).nan_to_num()
    colors = sampled(image, points, spacing, spacing.new_full((), AROUND))
    eyes = network(colors.view(3, 2, height, width).transpose(0, 1))
    placed = moved(torch.cat([eyes.landmarks, eyes.iris[:, None]], 1), back)
    large = spacing * width >= LEAST
    visibility = torch.where(large, eyes.visibility, 0.0)
    landmarks, deviation = merged_lids(
        face.landmarks, face.deviation, placed[:, :6], eyes.deviation[:, :6] * spacing, visibility
    )
    iris, openness, closed = (torch.where(large, one, torch.nan) for one in (placed[:, 6], eyes.openness, eyes.closed))
    return replace(
        face, landmarks=landmarks, deviation=deviation, iris=iris, openness=openness, closed=closed,
        eye_visibility=visibility,
    )  # fmt: skip
