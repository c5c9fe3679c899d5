"""Images put together: heat colours, captions, sheets of many, files."""

import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from torchface.escaped_text import visible
from torchface.files.whole_files import check_ending, make_folder, write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["caption", "heat_colors", "save_rendered_image", "sheet"]

_KINDS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
PICTURE_ENDINGS = tuple(_KINDS)  # of the files that save_rendered_image writes


def heat_colors(values: Tensor, maximum: float, colormap: str = "turbo") -> Tensor:
    """Colours (V,3) of non-negative values (V,), 0 to ``maximum``; beyond it the last colour.

    Example:
        >>> colors = heat_colors(torch.tensor([0.0, 2.0, 9.0]), maximum=2.0)
        >>> torch.equal(colors[1], colors[2])  # beyond the maximum
        True
    """
    from matplotlib import colormaps

    table = torch.tensor(np.asarray(colormaps[colormap].resampled(256)(np.arange(256)))[:, :3], dtype=torch.float32)
    return table[(values / maximum * 255).clamp(0, 255).long()]


def caption(image: Tensor, text: str, size: int = 16) -> Tensor:
    """The image (3,H,W) with a line of text under it.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> caption(image, "neutral").shape[1] > 40
        True
    """
    return torch.cat([image, _line(image.shape[2], text, size)], dim=1)


def headed(image: Tensor, text: str) -> Tensor:
    """The image (3,H,W) with a line of text over it.

    Example:
        >>> tuple(headed(torch.zeros(3, 40, 60), "black").shape)
        (3, 66, 60)
    """
    return torch.cat([_line(image.shape[2], text, 16), image], dim=1)


def _line(width: int, text: str, size: int) -> Tensor:
    strip = Image.new("RGB", (width, size + 10), "white")
    draw = ImageDraw.Draw(strip)
    draw.text((width / 2, (size + 10) / 2), text, fill="black", font=text_font(size), anchor="mm")
    return from_pillow(strip)


def text_font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib brings along: Pillow's own font has no letters beyond ASCII."""
    from matplotlib import get_data_path

    return ImageFont.truetype(Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


def sheet(images: Sequence[Tensor], columns: int, gap: int = 4) -> Tensor:
    """Images (3,H,W) in rows of ``columns``, on white; columns as wide, and rows as high, as their largest image.

    Example:
        >>> sheet([torch.zeros(3, 10, 20)] * 3, columns=2, gap=4).shape
        torch.Size([3, 24, 44])
    """
    rows = [images[i : i + columns] for i in range(0, len(images), columns)]
    heights = [max(image.shape[1] for image in row) for row in rows]
    widths = [max(image.shape[2] for image in images[i::columns]) for i in range(min(columns, len(images)))]
    page = torch.ones(3, sum(heights) + gap * (len(heights) - 1), sum(widths) + gap * (len(widths) - 1))
    for r, row in enumerate(rows):
        for c, image in enumerate(row):
            y, x = sum(heights[:r]) + gap * r, sum(widths[:c]) + gap * c
            page[:, y : y + image.shape[1], x : x + image.shape[2]] = image
    return page


def to_pillow(image: Tensor) -> Image.Image:
    """An 8-bit Pillow image of (3,H,W) in [0,1], which a notebook shows.

    Example:
        >>> to_pillow(torch.zeros(3, 40, 60)).size
        (60, 40)
    """
    return Image.fromarray((image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())


def from_pillow(image: Image.Image) -> Tensor:
    """(3,H,W) in [0,1] of a Pillow image."""
    return torch.from_numpy(np.asarray(image.convert("RGB")).copy()).permute(2, 0, 1).float() / 255


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = None) -> "Figure":
    """An empty figure, in hundreds of pixels. matplotlib is loaded here, so that other commands do not wait for it."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=100, layout=layout)


def from_figure(figure: "Figure") -> Tensor:
    """(3,H,W) in [0,1] of a matplotlib figure; its texts are taken for what they say, names with dollar signs too."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if text.get_text():  # those of ticks that have none yet are matplotlib's own
            text.set_text(visible(text.get_text()))
            text.set_parse_math(False)
    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a name's sign that the font lacks is drawn as a box
        canvas.draw()
    return torch.from_numpy(np.asarray(canvas.buffer_rgba())[..., :3].copy()).permute(2, 0, 1).float() / 255


def save_rendered_image(image: Tensor, path: str | Path) -> None:
    """Writes (3,H,W) as PNG or JPEG by the path's ending; the file appears only when it is complete.

    Raises:
        FileFormatError: another ending, or a folder that cannot be written to.

    Example:
        >>> from torchface.io import load_image
        >>> save_rendered_image(torch.zeros(3, 4, 6), "black.png")
        >>> load_image("black.png").max().item()
        0.0
    """
    path = Path(path)
    check_ending(path, *_KINDS)
    make_folder(path.parent)
    content = BytesIO()
    to_pillow(image).save(content, _KINDS[path.suffix.lower()], compress_level=3)  # a PNG of 6 takes twice the time
    write_file(path, content.getvalue())
