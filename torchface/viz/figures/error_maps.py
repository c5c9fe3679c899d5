"""Errors as the thesis shows them: green where a face is right, red where it is not, beside the face itself."""

import math

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rendering.compositing import headed, heat_colors, sheet
from torchface.viz.figures.face_views import clay_colors, color_bar, face_views

__all__ = ["compared_views", "error_colors", "error_views"]

GREEN_TO_RED = "RdYlGn_r"  # the colour map, as matplotlib calls it
NOT_COMPARED = (0.75, 0.75, 0.75)

_STEPS = (1.0, 2.0, 5.0, 10.0)


def error_colors(errors: Tensor, maximum: float, colormap: str = GREEN_TO_RED) -> Tensor:
    """Colours (V,3) of errors (V,), the colour map's ends at 0 and ``maximum``; grey where the error is NaN.

    Example:
        >>> colors = error_colors(torch.tensor([0.0, 1.0, torch.nan]), maximum=1.0)
        >>> bool(colors[0, 1] > colors[0, 0]), bool(colors[1, 0] > colors[1, 1])  # green is good, red is bad
        (True, True)
    """
    errors = errors.cpu().float()
    colors = heat_colors(errors.nan_to_num(0.0), maximum, colormap)
    colors[errors.isnan()] = torch.tensor(NOT_COMPARED)
    return colors


def round_maximum(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten, for the end of a scale.

    Example:
        >>> round_maximum(0.31), round_maximum(5.0)
        (0.5, 5.0)
    """
    if not value > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in _STEPS if step * power >= value * (1 - 1e-9))


def error_views(mesh: Mesh, errors: Tensor, maximum: float, title: str, height: int = 400) -> Tensor:
    """Errors (V,), millimetres, on a mesh from front, three quarters and profile, with the scale beside; (3,H,W).

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> picture = error_views(head, torch.zeros(len(head.vertices)), 1.0, "no error", height=60)
        >>> middle = picture[:, picture.shape[1] // 2]
        >>> bool((middle[1] > middle[0] + 0.1).any())  # a green face
        True
    """
    row = face_views(mesh, colors=error_colors(errors, maximum), width=height * 4 // 5, height=height)
    return headed(sheet([row, _scale(maximum, row.shape[1])], 2), title)


def compared_views(result: Mesh, true: Mesh, errors: Tensor, maximum: float, title: str, height: int = 290) -> Tensor:
    """One frame: what came back, what was, and the error between them, a row each, from three sides; (3,H,W).

    Args:
        found, true: of one topology.
        errors: (V,), millimetres; NaN is grey.
        maximum: of the scale, millimetres.
        title: over it all.
        height: of each image, pixels.

    Source: thesis, figures 81 to 94.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> picture = compared_views(head, head, torch.zeros(len(head.vertices)), 1.0, "the same", height=60)
        >>> picture.shape[1] > 3 * 60  # three rows
        True
    """
    width = height * 4 // 5
    rows = [
        headed(face_views(true, colors=clay_colors(true), width=width, height=height, framed_by=true), "truth"),
        headed(face_views(result, colors=clay_colors(result), width=width, height=height, framed_by=true), "result"),
        headed(
            face_views(result, colors=error_colors(errors, maximum), width=width, height=height, framed_by=true),
            "error",
        ),
    ]
    page = sheet(rows, 1)
    return headed(sheet([page, _scale(maximum, page.shape[1])], 2), title)


def _scale(maximum: float, height: int) -> Tensor:
    part = min(0.84, 3.4 / (height / 100))
    bar = (0.12, 0.5 - part / 2, 0.2, part)
    return color_bar(maximum, "mm", height, bar, GREEN_TO_RED, "max")
