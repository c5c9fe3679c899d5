"""A registration for people to judge: scan, registered mesh and the distance between them, from three sides."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import corners, triangle_areas
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.registration.scan_registration import Registration
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import headed, sheet
from torchface.rendering.raycast import RayCaster
from torchface.viz.figures.error_maps import error_colors
from torchface.viz.figures.face_views import FRONT, PROFILE, THREE_QUARTER, color_bar, frame_face


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


_WIDTH = 0.12  # of a line, as a fraction of the mesh's median edge
_DARK = 0.75
_SAMPLES = 3


def lines_on_clay(mesh: Mesh, camera: Camera) -> Tensor:
    """The mesh as clay with the edges of its polygons (of its triangles, where it has none) drawn on it; (3,H,W)."""
    image = render(replace(mesh, colors=None, texture=None), camera, samples=2)
    vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    origins, directions = camera.rays(_SAMPLES)
    height, width = directions.shape[:2]
    hits = RayCaster(vertices, faces).cast(origins.reshape(-1, 3), directions.reshape(-1, 3))
    hit = hits.triangle >= 0
    a, b, c = corners(vertices, faces)
    lengths = torch.stack([(b - c).norm(dim=-1), (c - a).norm(dim=-1), (a - b).norm(dim=-1)], dim=-1)
    # A corner's barycentric coordinate times its height is the distance to the edge that lies opposite.
    heights = 2 * triangle_areas(vertices, faces)[:, None] / lengths.clamp(min=1e-9)
    heights = heights.masked_fill(~_drawn(mesh), torch.inf)
    triangle = hits.triangle[hit]
    gap = (hits.barycentric[hit].double().clamp(min=1e-12) * heights[triangle]).amin(-1)
    dark = torch.zeros(len(hit), dtype=torch.float64)
    dark[hit] = (gap < _WIDTH / 2 * float(lengths.median())).double()
    coverage = dark.view(height // _SAMPLES, _SAMPLES, width // _SAMPLES, _SAMPLES).mean((1, 3)).float()
    return image * (1 - _DARK * coverage)


def _drawn(mesh: Mesh) -> Tensor:
    """Which edges opposite each corner (F,3) are edges of a polygon, and not its diagonals."""
    faces = mesh.faces.cpu()
    if mesh.polygons is None:
        return torch.ones_like(faces, dtype=torch.bool)
    polygons = mesh.polygons.cpu()
    following = polygons.roll(-1, 1)
    last = (polygons >= 0).sum(1) - 1
    # Triangles among quads end in -1: their last corner goes on to the first.
    rows = torch.arange(len(polygons))
    following[rows, last] = polygons[:, 0]
    count = len(mesh.vertices)
    inside = polygons >= 0
    authored = _keys(polygons[inside], following[inside], count)
    opposite = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], dim=1)
    return torch.isin(_keys(opposite[..., 0], opposite[..., 1], count), authored)


def _keys(first: Tensor, second: Tensor, count: int) -> Tensor:
    return torch.minimum(first, second) * count + torch.maximum(first, second)
