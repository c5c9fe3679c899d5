"""The pictures of all items of a batch on one sheet."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from torchface.escaped_text import visible
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, from_pillow, sheet, text_font
from torchface.viz.figures.face_views import frame_face
from torchface.workflows.batch.batch_job import picture_path
from torchface.workflows.batch.outcomes import Outcome

CONTACT_SHEET = "contact_sheet.png"
MOST_PICTURES = 400  # on one sheet: more is not looked at, and a picture of 60 megapixels opens slowly
_LARGE = 100  # pictures that are shown in full size; more of them become smaller
_TEXT = 14
_LETTER = 9  # pixels a letter takes at most in a text of that size, on average
_SKIPPED = 217  # the grey of what has no picture, of 255
WIDTH, HEIGHT = 320, 400  # of one view of a face, pixels


def contact_sheet(outcomes: Sequence[Outcome], out: Path) -> Tensor:
    """The pictures of the first :data:`MOST_PICTURES` outcomes, with names, and headlines or errors; (3,H,W)."""
    pictured = outcomes[:MOST_PICTURES]
    share = min(1.0, (_LARGE / max(1, len(pictured))) ** 0.5)
    pictures = [_picture(outcome, out, share) for outcome in pictured]
    size = next((picture.shape[1:] for picture in pictures if picture is not None), torch.Size((HEIGHT, WIDTH)))
    cells = []
    for outcome, picture in zip(pictured, pictures, strict=True):
        name = outcome.name if len(outcome.name) <= 20 else f"{outcome.name[:9]}..{outcome.name[-9:]}"
        view = _blank(outcome, *size) if picture is None else picture
        cells.append(caption(caption(view, name, _TEXT), outcome.headline if outcome.done else "skipped", _TEXT))
    return sheet(cells, min(max(4, round((len(cells) * 1.8) ** 0.5)), len(cells)))


def face_picture(mesh: Mesh, colors: Tensor | None = None, framed_by: Mesh | None = None) -> Tensor:
    """A face from its front for the contact sheet, (3,H,W), as it is or with colours (V,3), framed as another pose."""
    return render(mesh, frame_face(framed_by or mesh, width=WIDTH, height=HEIGHT), colors, samples=1)


def small_picture(file: Path) -> Tensor:
    """An image file for the contact sheet, (3,H,W), no higher than a face and at most four times as wide."""
    with Image.open(file) as image:
        image.thumbnail((4 * WIDTH, HEIGHT))
        return from_pillow(image)


def _blank(outcome: Outcome, height: int, width: int) -> Tensor:
    """Why there is no picture, (3,H,W)."""
    view = Image.new("RGB", (width, height), (_SKIPPED,) * 3)
    reason = visible(outcome.error.removeprefix(f"{outcome.item.path}: "))
    lines = textwrap.wrap(reason, max(1, width // _LETTER), max_lines=height // (_TEXT + 4) - 1, placeholder="..")
    ImageDraw.Draw(view).multiline_text((6, 6), "\n".join(lines), fill="black", font=text_font(_TEXT))
    return from_pillow(view)


def _picture(outcome: Outcome, out: Path, share: float) -> Tensor | None:
    """An outcome's picture, (3,H,W), at a share of its size."""
    path = picture_path(out, outcome.item)
    if not outcome.done or not path.is_file():
        return None
    try:
        with Image.open(path) as image:
            image.thumbnail((round(share * image.width), round(share * image.height)))
            return from_pillow(image)
    except OSError:  # somebody has written something else there meanwhile
        return None
