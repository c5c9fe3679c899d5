"""Eyeballs as engines want them: where they rotate, and an iris painted on those that bring no image.

An eyeball of one shell has sclera, iris and pupil. Of two, as in ICT-FaceKit, the outer one is sclera with a hole
under a clear cornea, and the inner one, which the hole shows, the iris round the pupil.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.spheres import nearest_sphere
from torchface.mesh import Mesh
from torchface.part_materials import CORNEA, EYEBALL, IRIS, SCLERA, PartMaterial

_IRIS, _PUPIL, _LIMBUS = 5.9, 1.9, 0.5
"""Millimetres: radii of iris and pupil in daylight, half the width of the limbus, where sclera turns into cornea."""
_MAX_IRIS_FRACTION = 0.6  # of an eyeball's radius; a cartoon eye has no larger iris
_FRONT, _DEPTH = 0.6, 1.5  # millimetres behind the inner shell's front: round the pupil; where the iris ends
_RIM, _DARK, _VEINS = (0.07, 0.05, 0.04), (0.012, 0.010, 0.010), (0.80, 0.60, 0.56)
_OUTLIER, _MAX_ITERATIONS = 2.5, 6
_INNER = (0.50, 0.36, 0.20)  # round the pupil of a brown iris
_MAX_COLOR_DIFFERENCE = 0.02
_SIDE = 512


def stands_alone(faces: Tensor, inside: Tensor) -> bool:
    """Whether triangles (F,) bool share no vertex with the others, so that they can rotate by themselves."""
    return not bool(torch.isin(faces[inside], faces[~inside]).any())


def eye_centre(mesh: Mesh, triangles: Tensor) -> Tensor:
    """The point (3,) about which an eyeball, rows (K,) of the faces, rotates: the centre of most of its outer shell."""
    return _sphere(_shells(mesh, triangles)[0].unique(), mesh)[0]


def painted_eye(mesh: Mesh, triangles: Tensor) -> "list[tuple[Tensor, PartMaterial, Paint | None]]":
    """The layers of an eyeball that looks along z, or where its pupil is: rows of faces, material, paint of each."""
    outer, inner = _shells(mesh, triangles)
    centre, radius = _sphere(outer.unique(), mesh)
    points = mesh.vertices.detach().double() - centre
    if len(inner):  # its front lies round the pupil, which need not be straight ahead
        ahead = points[inner.unique()]
        points = _looking_along(ahead[ahead[:, 2] > ahead[:, 2].max() - _FRONT].mean(0), points)
    iris = min(_IRIS, _MAX_IRIS_FRACTION * radius)
    iris_color = _given_iris_color(mesh, triangles, points, iris)
    is_outer = torch.isin(mesh.faces[triangles, 0], outer)
    if len(inner) == 0:
        return [(triangles, EYEBALL, painted(mesh, triangles, points, lambda at: _one_shell(at, iris, iris_color)))]
    rows, behind = triangles[is_outer], triangles[~is_outer]
    inside = (_axis_distance(points) < iris) & (points[:, 2] > 0)
    clear = inside[mesh.faces[rows]].all(1)
    shell = painted(mesh, rows[~clear], points, lambda at: _outer_shell(at, iris))
    depth = float(points[inner.unique(), 2].max()) - _DEPTH
    inner_paint = painted(mesh, behind, points, lambda at: _inner_shell(at, iris, depth, iris_color))
    return [(rows[~clear], SCLERA, shell), (behind, IRIS, inner_paint), (rows[clear], CORNEA, None)]


def _shells(mesh: Mesh, triangles: Tensor) -> tuple[Tensor, Tensor]:
    """The corners (K',3) of the outmost connected part of an eyeball, and those of the rest."""
    faces = mesh.faces[triangles]
    ids, local = faces.unique(return_inverse=True)
    label = components(local.reshape(-1, 3), len(ids))
    points = mesh.vertices[ids].double()
    reach = (points - (points.amax(0) + points.amin(0)) / 2).norm(dim=1)
    parts = int(label.max()) + 1
    size = torch.zeros(parts, dtype=torch.float64).scatter_reduce_(0, label, reach, "mean", include_self=False)
    outmost = label[local.reshape(-1, 3)[:, 0]] == size.argmax()
    return faces[outmost], faces[~outmost]


def _sphere(ids: Tensor, mesh: Mesh) -> tuple[Tensor, float]:
    """Centre (3,) and radius of the sphere most of the vertices lie on; a cornea that bulges is an outlier."""
    points = mesh.vertices[ids].double()
    inliers = torch.ones(len(points), dtype=torch.bool)
    centre, radius = points.mean(0), 0.0
    for _ in range(_MAX_ITERATIONS):  # fit and outliers in turn
        centre, radius = nearest_sphere(points[inliers])
        residual = ((points - centre).norm(dim=1) - radius).abs()
        inliers = residual <= max(float(_OUTLIER * residual.median()), 1e-9)
    return centre, radius


def _looking_along(axis: Tensor, points: Tensor) -> Tensor:
    """The points (V,3) in a frame whose z is the axis (3,) and whose y is up."""
    z = torch.nn.functional.normalize(axis, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=z.dtype), z), dim=0)
    return points @ torch.stack([x, torch.linalg.cross(z, x), z]).T


def _one_shell(at: Tensor, iris: float, iris_color: Tensor | None) -> Tensor:
    sclera, colored = _sclera(at), _iris(at, iris, iris_color)
    inside = (1 - _ramp(_axis_distance(at), iris - _LIMBUS, iris + _LIMBUS)) * (at[:, 2] > 0)
    color = torch.lerp(sclera, colored, inside[:, None])
    color = _mix(color, _DARK, (1 - _ramp(_axis_distance(at), _PUPIL - 0.1, _PUPIL + 0.1)) * (at[:, 2] > 0))
    return torch.cat([color, torch.ones(len(at), 1, dtype=at.dtype)], dim=1)


def _outer_shell(at: Tensor, iris: float) -> Tensor:
    """Sclera that darkens toward a hole in front of the iris."""
    front, distance = at[:, 2] > 0, _axis_distance(at)
    color = _mix(_sclera(at), _RIM, (1 - _ramp(distance, iris, iris + _LIMBUS)) * front)
    return torch.cat([color, torch.where(front, _ramp(distance, iris - 0.1, iris + 0.1), 1.0)[:, None]], dim=1)


def _inner_shell(at: Tensor, iris: float, depth: float, iris_color: Tensor | None) -> Tensor:
    outside_pupil = torch.where(at[:, 2] > depth, _ramp(_axis_distance(at), _PUPIL - 0.1, _PUPIL + 0.1), 0.0)
    color = _mix(torch.tensor(_DARK, dtype=at.dtype).expand(len(at), 3), (1.0, 1.0, 1.0), outside_pupil) * _iris(
        at, iris, iris_color
    )
    return torch.cat([color, torch.ones(len(at), 1, dtype=at.dtype)], dim=1)


def _sclera(at: Tensor) -> Tensor:
    """White that reddens with the angle from the iris."""
    white = torch.tensor(EYEBALL.color, dtype=at.dtype).expand(len(at), 3)
    angle = torch.atan2(_axis_distance(at), at[:, 2])
    return _mix(white, _VEINS, 0.8 * _ramp(angle, 0.6, 1.4))


def _given_iris_color(mesh: Mesh, triangles: Tensor, points: Tensor, iris: float) -> Tensor | None:
    """The mean colour (3,) of an eyeball's front, where its back has the default white."""
    if mesh.colors is None:
        return None
    ids = mesh.faces[triangles].unique()
    colors, at = mesh.colors[ids].detach().cpu().double(), points[ids]
    front, back = (_axis_distance(at) < 0.9 * iris) & (at[:, 2] > 0), at[:, 2] < 0
    white = torch.tensor(EYEBALL.color, dtype=torch.float64)
    if not front.any() or not back.any() or float((colors[back] - white).abs().max()) > _MAX_COLOR_DIFFERENCE:
        return None
    return colors[front].median(0).values


def _iris(at: Tensor, iris: float, iris_color: Tensor | None) -> Tensor:
    """Fibres that run out from the pupil, lighter inside, with a dark border."""
    distance, angle = _axis_distance(at), torch.atan2(at[:, 1], at[:, 0])
    fibres = sum(torch.cos(angle * waves + phase) for waves, phase in ((29, 0.3), (43, 1.9), (61, 4.0), (17, 2.2))) / 4
    mean = torch.tensor(IRIS.color) if iris_color is None else iris_color
    color = mean.to(at.dtype) * (1 + 0.5 * torch.as_tensor(fibres))[:, None]
    inner = _INNER if iris_color is None else tuple((1.4 * iris_color).clamp(max=1).tolist())
    color = _mix(color, inner, 0.6 * (1 - _ramp(distance, 0.3 * iris, 0.62 * iris)))
    return _mix(color, _RIM, _ramp(distance, 0.80 * iris, iris)).clamp(0, 1)


def _axis_distance(at: Tensor) -> Tensor:
    return at[:, :2].norm(dim=1)


def _mix(color: Tensor, other: tuple[float, float, float], weight: Tensor) -> Tensor:
    return torch.lerp(color, torch.tensor(other, dtype=color.dtype).expand_as(color), weight[:, None].to(color))


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    """0 below ``low``, 1 above ``high``, smooth between."""
    weight = ((value - low) / (high - low)).clamp(0, 1)
    return weight * weight * (3 - 2 * weight)


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of a part, sRGB and opacity."""

    image: Tensor | None  # in the mesh's own layout, (4,S,S); or
    colors: Tensor | None  # of its vertices, (V,4), where it has none


def painted(mesh: Mesh, rows: Tensor, values: Tensor, color: Callable[[Tensor], Tensor], side: int = _SIDE) -> Paint:
    """Colours, sRGB and opacity, by values (V,C) at triangles (K,), as an image where one tile holds their layout."""
    if mesh.uvs is None or mesh.uv_faces is None:
        return Paint(None, color(values).float())
    corners = mesh.uvs[mesh.uv_faces[rows]].double()
    tile = corners.reshape(-1, 2).mean(0).floor()
    if not bool(((corners >= tile) & (corners <= tile + 1)).all()):
        return Paint(None, color(values).float())
    texels = rasterise_uvs(mesh.uvs.double() - tile, mesh.uv_faces[rows], side, side)
    return Paint(texels.image(color(texels.interpolate(values, mesh.faces[rows]))), None)
