"""A registration for people to judge: scan, registered mesh and the distance between them, from three sides."""

from __future__ import annotations

from dataclasses import replace

import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.registration.scan_registration import Registration
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import from_figure, headed, heat_colors, sheet
from torchface.viz.figures.face_views import FRONT, PROFILE, THREE_QUARTER, frame_face
from torchface.viz.figures.wireframe import lines_on_clay

_NOT_MATCHED = (0.75, 0.75, 0.75)


def registration_sheet(
    scan: Mesh,
    registration: Registration,
    maximum: float = 1.0,
    width: int = 232,
    height: int = 290,
    clay: bool = False,
    yaws: tuple[float, ...] = (FRONT, THREE_QUARTER, PROFILE),
) -> Tensor:
    """A row a view: the scan, the registered mesh in the scan's colours, its distance to the scan, its lines; (3,H,W).

    All of it is turned upright as the template stands. Grey in the heat map is what the scan does not show.

    Args:
        scan: as it was registered.
        registration: to it.
        maximum: of the heat map, millimetres.
        width, height: of each picture, pixels.
        clay: without colours, which shows form.
        yaws: of the views, degrees.
    """
    upright = registration.pose.inverse()
    pictures = []
    own = _moved(registration.mesh, upright)
    there = _moved(scan, upright)
    if clay:
        own, there = (replace(mesh, colors=None, texture=None) for mesh in (own, there))
    heat = distance_colors(registration.distance.masked_fill(~registration.matched, torch.nan), maximum)
    for yaw in yaws:
        camera = frame_face(own, yaw, width=width, height=height)
        pictures += [render(there, camera), render(own, camera), render(own, camera, heat), lines_on_clay(own, camera)]
    titles = ("scan", "registered", "distance", "mesh")
    columns = [pictures[i :: len(titles)] for i in range(len(titles))]
    made = [headed(sheet(column, 1), title) for column, title in zip(columns, titles, strict=True)]
    figure = Figure(figsize=(0.9, made[0].shape[1] / 100), dpi=100)
    mappable = ScalarMappable(Normalize(0, maximum), "turbo")
    figure.colorbar(mappable, cax=figure.add_axes((0.12, 0.2, 0.2, 0.6)), label="mm")
    return sheet([*made, from_figure(figure)], len(made) + 1)


def distance_colors(distances: Tensor, maximum: float) -> Tensor:
    """Colours (V,3) of distances (V,), millimetres, 0 to ``maximum``; grey where they are NaN."""
    distances = distances.float().cpu()
    heat = heat_colors(distances.nan_to_num(0.0), maximum)
    heat[distances.isnan()] = torch.tensor(_NOT_MATCHED)
    return heat


def _moved(mesh: Mesh, pose: Similarity) -> Mesh:
    return mesh.with_vertices(pose.apply(mesh.vertices.double())[0].to(mesh.vertices))
