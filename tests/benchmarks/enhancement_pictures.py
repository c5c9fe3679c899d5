"""Pictures of what a comparison of enhanced animations measured; drawn where a folder for them is named."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rendering.clay_shading import Lighting
from torchface.rendering.compositing import caption, headed, heat_colors, save_rendered_image, sheet
from torchface.viz.figures.face_views import FRONT, PROFILE, THREE_QUARTER, color_bar, face_views

FOLDER = os.environ.get("TORCHFACE_ENHANCEMENT_PICTURES")
"""Where pictures go; none are drawn where it is not set, as they take minutes."""

_RAKING = Lighting(
    lights=(((-0.75, 0.62, 0.28), 0.85), ((0.85, 0.05, 0.35), 0.25)), ambient=0.25, occlusion_rays=0, gloss=0.12
)
"""Light from the side, in which wrinkles show."""


def compared(
    name: str,
    skin: Mesh,
    columns: Mapping[str, Tensor],
    errors: Mapping[str, Tensor] | None = None,
    maximum: float = 0.3,
    yaws: Sequence[float] = (FRONT, THREE_QUARTER, PROFILE),
) -> None:
    """One frame in several versions (V,3), a row each, beside the errors (V,) of some, millimetres."""
    if FOLDER is None:
        return
    rows = []
    for title, vertices in columns.items():
        shown = Mesh(vertices, skin.faces, annotations=skin.annotations)
        row = face_views(shown, yaws, width=360, height=450, samples=1, framed_by=skin, lighting=_RAKING)
        if errors is not None:
            painted = torch.ones_like(row) if title not in errors else face_views(
                shown, yaws[:1], heat_colors(errors[title], maximum), width=360, height=450, samples=1, framed_by=skin
            )  # fmt: skip
            row = sheet([row, painted[..., :360]], 2)
        rows.append(caption(row, title))
    page = sheet(rows, 1)
    if errors is not None:
        page = sheet([page, color_bar(maximum, "fine part's error, mm", page.shape[1])], 2)
    save(headed(page, name), name)


def save(image: Tensor, name: str) -> None:
    """Writes an image (3,H,W) under a name, where there is a folder."""
    if FOLDER is not None:
        path = Path(FOLDER) / f"{name.replace(' ', '_').replace(',', '')}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_rendered_image(image, path)
        print(f"drawn: {path}")
