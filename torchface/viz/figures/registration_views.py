"""A registration for people to judge: scan, registered mesh and the distance between them, from three sides."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.registration.scan_registration import Registration
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import headed, sheet
from torchface.viz.figures.face_views import FRONT, PROFILE, THREE_QUARTER, color_bar, frame_face
from torchface.viz.figures.heat_maps import error_colors
from torchface.viz.figures.wireframe import lines_on_clay


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
        width, height: of each image, pixels.
        clay: without colours, which shows form.
        yaws: of the views, degrees.
    """
    upright = registration.pose.inverse()
    images = []
    registered = _moved(registration.mesh, upright)
    scanned = _moved(scan, upright)
    if clay:
        registered, scanned = (replace(mesh, colors=None, texture=None) for mesh in (registered, scanned))
    heat = error_colors(registration.distance.masked_fill(~registration.matched, torch.nan), maximum, "turbo")
    for yaw in yaws:
        camera = frame_face(registered, yaw, width=width, height=height)
        images += [
            render(scanned, camera),
            render(registered, camera),
            render(registered, camera, heat),
            lines_on_clay(registered, camera),
        ]
    titles = ("scan", "registered", "distance", "mesh")
    columns = [images[i :: len(titles)] for i in range(len(titles))]
    made = [headed(sheet(column, 1), title) for column, title in zip(columns, titles, strict=True)]
    scale = color_bar(maximum, "mm", made[0].shape[1], (0.12, 0.2, 0.2, 0.6))
    return sheet([*made, scale], len(made) + 1)


def _moved(mesh: Mesh, pose: Similarity) -> Mesh:
    return mesh.with_vertices(pose.apply(mesh.vertices.double())[0].to(mesh.vertices))
