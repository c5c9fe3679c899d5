"""Colours of eyes, teeth and mouth on a mesh that brings none, by the names of its regions; clear shells stay away."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.part_materials import EYEBALL, IRIS, part_material

CLAY = (0.80, 0.72, 0.66)  # the colour of a mesh that brings none
_PUPIL = (0.05, 0.04, 0.04)
_IRIS_ANGLE, _PUPIL_ANGLE = 26.0, 10.0  # degrees from the way the eye looks
_SOFT, _HARD = 4.0, 1e-6  # how wide their edges are: between rows of vertices hard ones are jagged


def region_colors(mesh: Mesh) -> Tensor:
    """Colours (V,3) of vertices; eyes look ahead with iris and pupil, so that a glance shows."""
    return _colors(mesh, mesh.vertices.cpu(), lambda mask: mask, _SOFT)


def triangle_colors(mesh: Mesh) -> Tensor:
    """The same of triangles, (F,3)."""
    faces = mesh.faces.cpu()
    return _colors(mesh, mesh.vertices.cpu()[faces].mean(1), lambda mask: mask[faces].all(1), _HARD)


def clear_triangles(mesh: Mesh) -> Tensor:
    """The triangles (F,) bool, on the CPU, of lashes and of shells over eyes that viewers blend with what is behind."""
    clear = torch.zeros(len(mesh.faces), dtype=torch.bool)
    for name, mask in mesh.regions.items():
        material = part_material(name)
        if material is not None and material.alpha == "BLEND":
            clear |= mask[mesh.faces].all(1).cpu()
    return clear


def without_clear_shells(mesh: Mesh) -> Mesh:
    """A mesh without those triangles, which drawn as opaque would hide the eyes; the same where it has none."""
    kept = ~clear_triangles(mesh).to(mesh.faces.device)
    if bool(kept.all()):
        return mesh
    uv_faces = None if mesh.uv_faces is None else mesh.uv_faces[kept]
    return replace(mesh, faces=mesh.faces[kept], uv_faces=uv_faces, polygons=None)


def _colors(mesh: Mesh, points: Tensor, inside: Callable[[Tensor], Tensor], soft: float) -> Tensor:
    """Colours of points (N,3), of which those of a region, a mask of the vertices, are found so, (N,) bool."""
    colors = torch.tensor(CLAY).repeat(len(points), 1)
    for name, mask in mesh.regions.items():
        material, members = part_material(name), inside(mask.cpu())
        if material is None or material.alpha == "BLEND" or not bool(members.any()):
            continue
        colors[members] = torch.tensor(material.color)
        if material is EYEBALL:
            angle = _off_axis(mesh.vertices[mask].cpu(), points[members])[:, None]
            for edge, color in ((_IRIS_ANGLE, IRIS.color), (_PUPIL_ANGLE, _PUPIL)):
                beyond = ((angle - edge) / soft + 0.5).clamp(0, 1).to(colors)
                colors[members] = torch.lerp(torch.tensor(color), colors[members], beyond)
    return colors


def _off_axis(eyeball: Tensor, points: Tensor) -> Tensor:
    """Degrees between z and the way from an eyeball's centre, of its vertices (K,3), to points (N,3): (N,)."""
    low, high = eyeball.amin(0), eyeball.amax(0)
    middle = (low + high) / 2
    middle[2] = high[2] - (high[:2] - low[:2]).amax() / 2  # what is seen is a ball, behind it may be a nerve
    way = points - middle
    return torch.rad2deg(torch.acos((way[:, 2] / way.norm(dim=1)).nan_to_num(-1.0).clamp(-1, 1)))
