"""Markers on a face: their errors, their regions, and their sites before and after a fit."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.operators import corners
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import DEFAULT_LIGHTING, render
from torchface.rendering.compositing import from_figure, heat_colors, new_figure, sheet
from torchface.rendering.part_colors import clear_triangles
from torchface.rendering.raycast import RayCaster
from torchface.viz.figures.curves import SOLVED, TRUE, plain_log_ticks
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER, clay_colors, color_bar, frame_face
from torchface.viz.figures.region_colors import as_seen

_NAMED = 8

__all__ = ["marker_map"]

SIDE = 55.0
_WIDTH, _HEIGHT = 520, 650
_NOT_KNOWN = (0.55, 0.55, 0.55)
_LIFT = 0.5
_LETTER, _DOT = (6.5, 13.0), 4.0  # pixels: a letter of a label; a marker's half
_REACHES, _TURNS = (6.0, 14.0, 26.0, 40.0), 12  # pixels from a marker at which its label is tried


def marker_map(mesh: Mesh, points: Tensor, errors: Tensor, maximum: float, labels: Sequence[str]) -> Tensor:
    """Errors of markers (M,), millimetres, at their points (M,3) on a mesh, the worst by name; (3,H,W).

    Grey is a marker without an error (NaN), for which none was seen.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> points = head.vertices[head.landmarks[:3]]
        >>> picture = marker_map(head, points, torch.tensor([0.1, 0.2, 0.9]), 1.0, ["a", "b", "c"])
        >>> bool(picture.min() < 0.5 and picture.max() == 1)  # drawn on white
        True
    """
    colors = heat_colors(errors.nan_to_num(0.0), maximum).numpy()
    colors[errors.isnan().numpy()] = _NOT_KNOWN
    worst = set(errors.nan_to_num(-1.0).argsort(descending=True)[:_NAMED].tolist())
    named_labels = ["" if i not in worst or errors.isnan()[i] else label for i, label in enumerate(labels)]
    views = _views(mesh, points, colors, named_labels)
    scale = color_bar(maximum, "mm, root mean square", _HEIGHT, (0.12, 0.2, 0.2, 0.6), extend="max")
    return sheet([*views, scale], len(views) + 1)


def marker_regions(mesh: Mesh, points: Tensor, regions: Sequence[str]) -> Tensor:
    """Markers at points (M,3) of a mesh, a colour a region, with a legend; (3,H,W)."""
    names = list(dict.fromkeys(regions))
    from matplotlib import colormaps

    table = np.asarray(colormaps["tab20"](np.arange(20)))[:, :3]
    colors = np.stack([table[names.index(region) % 20] for region in regions])
    views = _views(mesh, points, colors, [""] * len(regions))
    figure = new_figure(1.7, _HEIGHT / 100)
    for i, name in enumerate(names):
        figure.text(0.12, 0.78 - 0.05 * i, "●", color=table[i % 20], fontsize=14, va="center")
        figure.text(0.26, 0.78 - 0.05 * i, f"{name}, {regions.count(name)}", fontsize=10, va="center")
    return sheet([*views, from_figure(figure)], len(views) + 1)


def _paint(mesh: Mesh) -> Tensor | None:
    """Clay where a texture or colours would hide the markers; regions of a bare mesh keep theirs."""
    return None if mesh.texture is None and mesh.colors is None else clay_colors(mesh)


def _views(mesh: Mesh, points: Tensor, colors: np.ndarray, labels: Sequence[str]) -> list[Tensor]:
    return [_view(mesh, points, colors, labels, yaw) for yaw in (FRONT, SIDE)]


def _view(mesh: Mesh, points: Tensor, colors: np.ndarray, labels: Sequence[str], yaw: float) -> Tensor:
    camera = frame_face(mesh, yaw, width=_WIDTH, height=_HEIGHT)
    image = render(as_seen(mesh), camera, _paint(mesh), replace(DEFAULT_LIGHTING, occlusion_rays=0))
    figure = new_figure(_WIDTH / 100, _HEIGHT / 100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(image.permute(1, 2, 0).numpy())
    front = facing(mesh, points, yaw)
    at = camera.project(points.double())
    x, y = at[front].T
    axes.scatter(x, y, s=34, c=colors[front.numpy()], edgecolors="black", linewidths=0.6)
    taken = [at[front].float()]
    for i in front.nonzero()[:, 0].tolist():
        if labels[i]:
            place, covered = _free_place(at[i].float(), labels[i], torch.cat(taken))
            taken.append(covered)
            axes.annotate(
                labels[i],
                tuple(at[i].tolist()),
                xytext=tuple(place.tolist()),
                ha="center",
                va="center",
                fontsize=7.5,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
                arrowprops={"arrowstyle": "-", "color": "black", "linewidth": 0.5},
            )
    axes.set(xlim=(0, _WIDTH), ylim=(_HEIGHT, 0))
    axes.axis("off")
    return from_figure(figure)


def _free_place(at: Tensor, label: str, taken: Tensor) -> tuple[Tensor, Tensor]:
    """Where round a point (2,) a label's middle covers the fewest of other points (P,2), and what it then covers."""
    half = torch.tensor([0.5 * _LETTER[0] * len(label), 0.5 * _LETTER[1]])
    best: tuple[int, Tensor] | None = None
    for reach in _REACHES:
        for turn in range(_TURNS):
            angle = 2 * math.pi * turn / _TURNS
            place = at + torch.tensor([math.cos(angle), math.sin(angle)]) * (half + reach)
            place = place.clamp(min=half, max=torch.tensor([_WIDTH, _HEIGHT]) - half)
            count = int(((taken - place).abs() < half + _DOT).all(1).sum())
            if best is None or count < best[0]:
                best = count, place
    assert best is not None
    across = torch.linspace(-1, 1, max(2, len(label) // 2))[:, None] * torch.tensor([1.0, 0.0])
    return best[1], best[1] + across * half


def marker_views(markers: Tensor, on_mesh: Tensor, title: str = "") -> Tensor:
    """One frame: seen markers (M,3), NaN where not seen, joined to their points on the mesh (M,3); (3,H,W)."""
    from matplotlib.collections import LineCollection

    figure = new_figure(10, 5, layout="constrained")
    known = markers.isfinite().all(-1)
    error = (markers - on_mesh)[known].norm(dim=-1)
    for axes, (name, across) in zip(figure.subplots(1, 2), (("front", 0), ("side", 2)), strict=True):
        columns = [across, 1]
        pairs = torch.stack([markers[known], on_mesh[known]], 1)[..., columns].tolist()
        axes.add_collection(LineCollection(pairs, colors="grey", linewidths=1))
        axes.scatter(*on_mesh[:, columns].T, marker="x", s=22, color="#1f5fa8", label="mesh", linewidths=1)
        axes.scatter(*markers[known][:, columns].T, marker="+", s=28, color="#c8321e", label="marker", linewidths=1)
        axes.set(title=name, xlabel="mm", aspect="equal")
        if name == "side":  # the face looks to the left, as in a profile from the viewer's right
            axes.invert_xaxis()
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.suptitle(f"{title} mean distance {float(error.mean()):.2f} mm, {int((~known).sum())} not seen".strip())
    return from_figure(figure)


def site_views(mesh: Mesh, before: Tensor, after: Tensor) -> Tensor:
    """Sites before and after (M,3) on views of a face, joined by lines, those that face the viewer; (3,H,W)."""
    from matplotlib.collections import LineCollection

    images = []
    for yaw in (FRONT, THREE_QUARTER):
        camera = frame_face(mesh, yaw, width=560, height=700)
        front = facing(mesh, after, yaw)
        old, new = camera.project(before[front].double()), camera.project(after[front].double())
        image = render(mesh, camera, clay_colors(mesh), samples=2)
        figure = new_figure(image.shape[2] / 100, image.shape[1] / 100)
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
    faces, vertices = mesh.faces[~clear_triangles(mesh)], mesh.vertices.double()
    a, b, c = corners(vertices, faces[SurfaceIndex(vertices, faces).nearest(points).triangle])
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    angle = math.radians(yaw)
    toward = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    lifted = points.double() + _LIFT * normals
    hidden = RayCaster(vertices, faces).occluded(lifted, toward.expand_as(lifted))
    return (normals @ toward > 0) & ~hidden


def errors_by_iteration(errors: Tensor) -> Tensor:
    """Each marker's error after each iteration (R,M), millimetres, with mean and worst; (3,H,W)."""
    figure = new_figure(10, 3, layout="constrained")
    axes = figure.subplots()
    iterations = range(1, len(errors) + 1)
    axes.plot(iterations, errors, color="grey", linewidth=0.4, alpha=0.5)
    axes.plot(iterations, errors.amax(1), color=TRUE, linewidth=1.2, label=f"worst, {float(errors[-1].max()):.2f} mm")
    axes.plot(iterations, errors.mean(1), color=SOLVED, linewidth=1.6, label=f"mean, {float(errors[-1].mean()):.2f} mm")
    axes.set(xlabel="iteration", ylabel="marker error (mm)", yscale="log", xlim=(1, len(errors)))
    axes.locator_params("x", integer=True)
    plain_log_ticks(axes.yaxis)
    figure.legend(loc="outside upper right", frameon=False, ncols=2, fontsize=9)
    return from_figure(figure)
