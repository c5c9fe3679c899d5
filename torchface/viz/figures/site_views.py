"""Views of markers' sites before and after a fit, and how their error fell."""

from __future__ import annotations

import math

import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from torchface.geometry.meshes.operators import corners
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import from_figure, sheet
from torchface.rendering.raycast import RayCaster
from torchface.viz.figures.curves import SOLVED, TRUE
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER, clay_colors, frame_face
from torchface.viz.figures.region_colors import drawn_triangles

_LIFT = 0.5


def site_views(mesh: Mesh, before: Tensor, after: Tensor) -> Tensor:
    """Sites before and after (M,3) on views of a face, joined by lines, those that face the viewer; (3,H,W)."""
    images = []
    for yaw in (FRONT, THREE_QUARTER):
        camera = frame_face(mesh, yaw, width=560, height=700)
        front = facing(mesh, after, yaw)
        old, new = camera.project(before[front].double()), camera.project(after[front].double())
        image = render(mesh, camera, clay_colors(mesh), samples=2)
        figure = Figure(figsize=(image.shape[2] / 100, image.shape[1] / 100), dpi=100)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.imshow(image.permute(1, 2, 0).numpy())
        pairs = torch.stack([old, new], 1).tolist()
        axes.add_collection(LineCollection(pairs, colors="#333333", linewidths=1))
        axes.scatter(old[:, 0], old[:, 1], s=16, color=TRUE, label="before")
        axes.scatter(new[:, 0], new[:, 1], s=16, color=SOLVED, label="after")
        axes.set(xlim=(0, image.shape[2]), ylim=(image.shape[1], 0))
        axes.axis("off")
        axes.legend(loc="upper right", frameon=False)
        images.append(from_figure(figure))
    return sheet(images, len(images))


def facing(mesh: Mesh, points: Tensor, yaw: float) -> Tensor:
    """Which points on a mesh, (M,3), a viewer sees who looks from ``yaw`` degrees, (M,) bool."""
    faces, vertices = mesh.faces[drawn_triangles(mesh)], mesh.vertices.double()
    a, b, c = corners(vertices, faces[SurfaceIndex(vertices, faces).nearest(points).triangle])
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    angle = math.radians(yaw)
    toward = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    lifted = points.double() + _LIFT * normals
    hidden = RayCaster(vertices, faces).occluded(lifted, toward.expand_as(lifted))
    return (normals @ toward > 0) & ~hidden


def errors_by_iteration(errors: Tensor) -> Tensor:
    """Each marker's error after each iteration (R,M), millimetres, with mean and worst; (3,H,W)."""
    figure = Figure(figsize=(10, 3), dpi=100, layout="constrained")
    axes = figure.subplots()
    iterations = range(1, len(errors) + 1)
    axes.plot(iterations, errors, color="grey", linewidth=0.4, alpha=0.5)
    axes.plot(iterations, errors.amax(1), color=TRUE, linewidth=1.2, label=f"worst, {float(errors[-1].max()):.2f} mm")
    axes.plot(iterations, errors.mean(1), color=SOLVED, linewidth=1.6, label=f"mean, {float(errors[-1].mean()):.2f} mm")
    axes.set(xlabel="iteration", ylabel="marker error (mm)", yscale="log", xlim=(1, len(errors)))
    axes.legend(loc="upper right", frameon=False)
    return from_figure(figure)
