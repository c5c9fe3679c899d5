"""Views of a face as a modeller would want them: front, three-quarter, profile, with an error as a heat map."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import DEFAULT_LIGHTING, Lighting, render
from torchface.rendering.compositing import caption, from_figure, heat_colors, new_figure, sheet
from torchface.rendering.part_colors import CLAY
from torchface.rig import BlendshapeRig
from torchface.viz.figures.region_colors import as_seen

__all__ = ["face_views", "frame_face", "heat_map"]

FRONT, THREE_QUARTER, PROFILE = 0.0, 35.0, 90.0
PICTURE_HEIGHTS = (16, 4096)  # least and largest height that a command draws a view in, pixels

_OVER_HAIR = 0.02  # of the picture, free above hair
_COLUMNS, _MOST, _WIDTH, _HEIGHT = 6, 24, 200, 250


def framing(mesh: Mesh, aspect: float = 0.8) -> tuple[Tensor, float]:
    """What to look at, (3,), and how many millimetres an image of ``aspect`` (width over height) is to be high.

    Round the landmarks or the ``face`` region where annotated, with the hair above it, else the whole mesh.
    """
    points, margin, offset = mesh.vertices, 1.15, (0.0, 0.0, 0.0)
    if mesh.annotations is not None and mesh.annotations.landmarks is not None:
        # Landmarks end at the brows: leave margin for the forehead, and rotate about a point inside the head.
        points, margin, offset = mesh.vertices[mesh.annotations.landmarks], 1.9, (0.0, 0.12, -0.35)
    elif "face" in mesh.regions:
        points, margin = mesh.vertices[mesh.regions["face"]], 1.2
    low, high = points.amin(0), points.amax(0)
    centre = (low + high) / 2 + torch.tensor(offset).to(low) * float(high[1] - low[1])
    across = high[0] - low[0]
    if len(points) == len(mesh.vertices):  # seen from any side
        across = 2 * (points - centre)[:, [0, 2]].norm(dim=1).max()
    span = margin * float(torch.maximum(high[1] - low[1], across / aspect))
    hair = [mask for name, mask in mesh.regions.items() if name.startswith("hair") and bool(mask.any())]
    if hair and len(points) < len(mesh.vertices):
        above = float(mesh.vertices[torch.stack(hair).any(0), 1].max() - centre[1]) + _OVER_HAIR * span - span / 2
        if above > 0:
            centre, span = centre + torch.tensor([0.0, above / 2, 0.0]).to(centre), span + above
    return centre, span


def frame_face(mesh: Mesh, yaw: float = FRONT, width: int = 400, height: int = 500) -> Camera:
    """A camera that frames the face: round its landmarks or ``face`` region where annotated, else the whole mesh.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> pixels = frame_face(head, width=40, height=50).project(head.vertices[head.landmarks].double())
        >>> bool((pixels > 0).all() and (pixels < 50).all())
        True
    """
    centre, span = framing(mesh, width / height)
    return look_at(centre, yaw, 0.0, span=span, width=width, height=height)


def face_views(
    mesh: Mesh,
    yaws: Sequence[float] = (FRONT, THREE_QUARTER, PROFILE),
    colors: Tensor | None = None,
    width: int = 400,
    height: int = 500,
    samples: int = 2,
    framed_by: Mesh | None = None,
    lighting: Lighting = DEFAULT_LIGHTING,
) -> Tensor:
    """The mesh from several sides in one row, (3,H,W); ``framed_by`` keeps the framing of another pose.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> views = face_views(neutral_head(texture=False), yaws=(0.0, 90.0), width=32, height=40, samples=1)
        >>> views.shape[2] > 2 * 32 - 1
        True
    """
    cameras = [frame_face(framed_by or mesh, yaw, width=width, height=height) for yaw in yaws]
    drawn = as_seen(mesh)
    return sheet([render(drawn, camera, colors, lighting, samples=samples) for camera in cameras], len(cameras))


def heat_map(mesh: Mesh, values: Tensor, maximum: float, label: str, width: int = 400, height: int = 500) -> Tensor:
    """Per-vertex values (V,) painted on three views, with a colour bar from 0 to ``maximum``; (3,H,W).

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> picture = heat_map(head, head.vertices[:, 2].clamp(min=0), 100.0, "depth (mm)", width=32, height=40)
        >>> picture.shape[2] > 3 * 32  # three views and the scale
        True
    """
    row = face_views(mesh, colors=heat_colors(values, maximum), width=width, height=height)
    return sheet([row, color_bar(maximum, label, row.shape[1])], 2)


def color_bar(
    maximum: float,
    label: str,
    height: int,
    bar: tuple[float, float, float, float] = (0.12, 0.08, 0.2, 0.84),
    colormap: str = "turbo",
    extend: str = "neither",
) -> Tensor:
    """The scale of a heat map from 0 to ``maximum``, (3,H,110); ``bar`` is left, bottom, width, height in [0,1]."""
    figure = new_figure(1.1, height / 100)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mappable = ScalarMappable(Normalize(0, maximum), colormap)
    figure.colorbar(mappable, cax=figure.add_axes(bar), label=label, extend=extend)
    return from_figure(figure)


def clay_colors(mesh: Mesh) -> Tensor:
    """One plain colour (V,3) in [0,1], which shows form where texture would hide it.

    Example:
        >>> clay_colors(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))).unique(dim=0).shape
        torch.Size([1, 3])
    """
    return torch.tensor(CLAY).expand(len(mesh.vertices), 3)


def pose_pairs(rig: BlendshapeRig, names: Sequence[str], wanted: Tensor, found: Tensor) -> Tensor:
    """A column a pose: as an animator set it above, as the rules give it below; (3,H,W), 24 poses at most."""
    colors = clay_colors(rig.neutral)

    def view(weights: Tensor, text: str) -> Tensor:
        with torch.no_grad():
            mesh = rig.neutral.with_vertices(rig(weights[None])[0])
        drawn = face_views(mesh, (FRONT,), colors, _WIDTH, _HEIGHT, samples=1, framed_by=rig.neutral)
        return caption(drawn, text, 13)

    pairs = []
    for name, given, learned in zip(names[:_MOST], wanted, found, strict=False):
        off = float((given - learned).abs().max())
        pairs.append(sheet([view(given, name[:26]), view(learned, f"learned, off by {off:.2f}")], 1))
    return sheet(pairs, min(_COLUMNS, len(pairs)))
