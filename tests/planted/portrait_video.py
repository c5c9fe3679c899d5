"""A performer recorded by an ordinary camera indoors: grey frames with their 68 landmarks."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.rotations import rotation_matrix
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import Lighting, render
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

EXPRESSIONS: dict[str, dict[str, float]] = {
    "rest": {},
    "jaw open": {"jawOpen": 0.95},
    "pucker": {"mouthPucker": 1.0},
    "squint": {"eyeSquint": 1.0, "cheekSquint": 1.0, "browDown": 0.8, "noseSneer": 0.7, "mouthUpperUp": 0.4},
    "lips to the left": {"mouthLeft": 1.0, "jawLeft": 0.6},
    "lips to the right": {"mouthRight": 1.0, "jawRight": 0.6},
    "frown": {"mouthFrown": 1.0, "browDown": 1.0, "mouthShrugLower": 0.5},
    "smile": {"mouthSmile": 1.0, "cheekSquint": 0.6},
    "surprise": {"browInnerUp": 1.0, "browOuterUp": 1.0, "eyeWide": 1.0, "jawOpen": 0.5},
    "eyes shut": {"eyeBlink": 1.0},
    "teeth": {"mouthStretch": 0.9, "mouthLowerDown": 0.9, "mouthUpperUp": 0.8},
    "funnel": {"mouthFunnel": 1.0, "jawOpen": 0.4},
    "lips rolled in": {"mouthRollUpper": 1.0, "mouthRollLower": 1.0, "mouthPress": 0.6},
    "shout": {"jawOpen": 0.7, "mouthStretch": 0.7, "browDown": 1.0, "eyeSquint": 0.6},
    "one brow": {"browOuterUpLeft": 1.0, "browDownRight": 0.8, "eyeSquintRight": 0.6, "mouthSmileLeft": 0.6},
}
"""Fifteen faces that span what a face can do; a name without a side means both sides."""

_UPPER = ("brow", "eye", "cheekSquint", "noseSneer")


@dataclass(frozen=True)
class PortraitSettings:
    """How the video is taken."""

    # width, height: pixels
    width: int = 240
    height: int = 300
    turn: float = 8.0  # how far the head turns at most about each axis, degrees
    sway: float = 15.0  # how far it moves at most along each axis, millimetres
    blur: float = 0.6  # of the lens, standard deviation in pixels
    noise: float = 0.02  # of a grey value, standard deviation, of 1


@dataclass(frozen=True, eq=False)
class PortraitVideo:
    """Frames (T,H,W) uint8, the truth about their landmarks (T,68,2) pixels, and the weights (T,N) behind them."""

    frames: Tensor
    landmarks: Tensor
    weights: Tensor


def render_portrait_video(
    rig: BlendshapeRig,
    weights: Tensor,
    generator: torch.Generator,
    settings: PortraitSettings = PortraitSettings(),
    progress: Progress | None = None,
) -> PortraitVideo:
    """Records a performer whose head turns and sways from frame to frame, before a wall with spots.

    Args:
        rig: a performer with skin and annotated landmarks.
        weights: (T,N).
        generator: of poses, wall and noise.
        settings: how.
        progress: called with each step and how far it is.
    """
    progress = progress or silent
    ids = None if rig.neutral.annotations is None else rig.neutral.annotations.landmarks
    size = (settings.height, settings.width)
    middle = rig.vertices[ids].double().mean(0)
    camera = look_at(middle + torch.tensor([0.0, 12.0, -20.0]), 0.0, 0.0, 250.0, settings.width, settings.height, 24.0)
    wall = _wall(size, generator)
    frames, landmarks = [], []
    for number, row in enumerate(weights):  # an image at a time: each has a surface of its own
        turn, sway = 2 * torch.rand(2, 3, generator=generator, dtype=torch.float64) - 1
        rotation = rotation_matrix(math.radians(settings.turn) * turn)
        pivot = middle + torch.tensor([0.0, -40.0, -90.0])
        posed = (rig(row[None])[0].double() - pivot) @ rotation.T + pivot + settings.sway * sway
        mesh = rig.neutral.with_vertices(posed.float())
        image = render(mesh, camera, lighting=Lighting(occlusion_rays=0), samples=1).mean(0)
        origins, ways = camera.rays()
        hits = RayCaster(mesh.vertices, mesh.faces).cast(origins.reshape(-1, 3), ways.reshape(-1, 3))
        image = torch.where((hits.triangle >= 0).view(size), image, wall)
        image = gaussian_blur(image[None, None], settings.blur)[0, 0]
        image = image + settings.noise * torch.randn(size, generator=generator)
        frames.append((255 * image.clamp(0, 1)).round().to(torch.uint8))
        landmarks.append(camera.project(posed[ids]))
        progress("rendering the video", number + 1, len(weights))
    return PortraitVideo(torch.stack(frames), torch.stack(landmarks).float(), weights)


def expression_weights(names: tuple[str, ...], expressions: list[dict[str, float]]) -> Tensor:
    """Weights (M,N) of expressions by shape name; a name without ``Left`` or ``Right`` means both sides."""
    column = {name: i for i, name in enumerate(names)}
    weights = torch.zeros(len(expressions), len(names))
    for row, expression in enumerate(expressions):
        for name, value in expression.items():
            found = [one for one in (name, f"{name}Left", f"{name}Right") if one in column]
            weights[row, [column[one] for one in found]] = value
    return weights


def mixed_expressions(names: tuple[str, ...], count: int, generator: torch.Generator, least: float = 0.75) -> Tensor:
    """Weights (M,N): the upper face of one of ``EXPRESSIONS`` with the lower face of another, each nearly at its most.

    Args:
        names: of the rig's shapes.
        count: how many.
        generator: draws which, and how strong.
        least: the smallest strength, of 1.
    """
    poses = expression_weights(names, list(EXPRESSIONS.values()))
    upper = torch.tensor([name.startswith(_UPPER) for name in names])
    pick = torch.randint(len(poses), (2, count), generator=generator)
    strength = least + (1 - least) * torch.rand(2, count, 1, generator=generator)
    return torch.where(upper, strength[0] * poses[pick[0]], strength[1] * poses[pick[1]])


def _wall(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    spots = torch.rand(1, 1, 9, 7, generator=generator)
    wall = torch.nn.functional.interpolate(spots, size, mode="bicubic", align_corners=False)[0, 0]
    return 0.25 + 0.5 * wall.clamp(0, 1)
