"""A character's face at rest and with shapes on, from the front and from three quarters, in its own materials."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import look_at
from torchface.rendering.compositing import headed, sheet
from torchface.rendering.textured_surface import TexturedSurface
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER

_INTO_THE_HEAD, _NEARER = 0.25, 1.12  # of the span; how much larger the face is for it

SHOWN = {
    "neutral": (),
    "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
    "smile": ("mouthSmileLeft", "mouthSmileRight"),
    "jaw": ("jawOpen",),
    "pucker": ("mouthPucker",),
}
"""The poses of the sheet, and the shapes that are fully on in each."""


def character_sheet(
    surface: TexturedSurface, shapes: Mapping[str, Tensor], middle: Tensor, span: float, side: int = 300
) -> Tensor:
    """A column a pose of :data:`SHOWN`, a row a view; (3,H,W). By ARKit's names ``shapes`` say how far vertices go,
    (V,3)."""
    # Turned about a point of the face alone, the back of the head leaves the picture.
    inside = middle - torch.tensor([0.0, 0.0, _INTO_THE_HEAD * span]).to(middle)
    columns = []
    for pose, names in SHOWN.items():
        moved = surface.vertices + sum((shapes[name] for name in names if name in shapes), torch.zeros(1, 3))
        posed = replace(surface, vertices=moved)
        views = [
            posed.draw(look_at(place, yaw, 0.0, high, 2 * side, 2 * side)).picture
            for yaw, place, high in ((FRONT, middle, span), (THREE_QUARTER, inside, _NEARER * span))
        ]
        small = [torch.nn.functional.avg_pool2d(view[None], 2)[0] for view in views]
        columns.append(headed(sheet(small, 1), pose))
    return sheet(columns, len(columns))
