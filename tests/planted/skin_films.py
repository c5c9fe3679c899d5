"""Films of the performer whose skin shows planted weights, and what takes whole pictures for one part."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.rendering.clay_shading import render
from torchface.rig import BlendshapeRig

FRAMES, WIDTH, HEIGHT = 12, 220, 260
MOVED = ("browInnerUp", "browOuterUpLeft", "mouthSmileRight", "noseSneerLeft")


@dataclass(frozen=True, eq=False)
class Film:
    """Pictures of the performer, who turns."""

    pictures: list[Tensor]
    poses: tuple[Tensor, Tensor]
    camera: CameraCalibration


def part_of(part: str) -> Callable[[Tensor, Tensor], FaceParts]:
    """What takes whole pictures for one part."""

    def find(image: Tensor, landmarks: Tensor) -> FaceParts:
        shares = torch.zeros(len(PARTS), 8, 8)
        shares[PARTS.index(part)] = 1
        return FaceParts(shares, torch.tensor([[8 / image.shape[-1], 0, 0], [0, 8 / image.shape[-2], 0]]).double())

    return find


def planted(names: Sequence[str]) -> Tensor:
    """Weights (T,N) of which each of ``MOVED`` rises and falls in its own time."""
    phase = torch.linspace(0, 2 * torch.pi, FRAMES + 1)[:-1]
    weights = torch.zeros(FRAMES, len(names))
    for number, name in enumerate(MOVED):
        weights[:, names.index(name)] = 0.25 + 0.25 * (phase * (1 + number // 2) + number).sin()
    return weights


def film_of(rig: BlendshapeRig, field_of_view: float = 18.0) -> Film:
    """The performer with ``planted`` weights; degrees."""
    middle = rig.vertices[rig.neutral.landmarks[17:]].detach().double().mean(0)
    cameras = [
        look_at(middle, 12.0 * math.sin(0.5 * frame), 4.0, 260.0, WIDTH, HEIGHT, field_of_view)
        for frame in range(FRAMES)
    ]
    pictures = [
        (255 * render(rig.neutral.with_vertices(vertices), camera)[:3]).byte()
        for vertices, camera in zip(rig(planted(rig.names)).detach(), cameras, strict=True)
    ]
    poses = (
        torch.stack([camera.rotation for camera in cameras]),
        torch.stack([camera.translation for camera in cameras]),
    )
    return Film(pictures, poses, CameraCalibration(cameras[0].intrinsics, torch.zeros(5).double(), WIDTH, HEIGHT))
