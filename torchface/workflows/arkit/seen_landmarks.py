"""Landmarks of a head that has none of its own: seen in pictures from around."""

import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.surfaces.face_on_surface import NoFaceOnSurfaceError
from torchface.mesh import Mesh
from torchface.modeling.rigging.eyelid_closure import SkinOfHead
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.progress import Progress
from torchface.registration.scan_preparation import Landmarks
from torchface.workflows.rig.character_face import character_search, find_skin, mesh_surface, with_edges

_ASTRAY, _LEAST_ASTRAY, _LEAST = 4.0, 15.0, 12
_FLAT, _TOP = 0.4, 0.18  # of its height: how deep a body is at most, and how much of it the head is


def seen_landmarks(head: Mesh, template: Mesh, progress: Progress) -> Landmarks | None:
    """Vertices of a template and where they lie on a head in any pose and unit; None where no face is seen.

    On the embedded performer's topology the finder's other points count, on others the 68 without their contour.
    """
    reference, search = character_search()
    points = search.reference
    surface = mesh_surface(head)
    try:
        found = search.find(surface, uppermost(surface.vertices), progress)
    except NoFaceOnSurfaceError:
        return None
    placed = found.pose.inverse().apply(found.points)[0]
    apart = (placed - points.all).norm(dim=-1)
    usable = torch.isfinite(apart)
    usable &= apart < max(_LEAST_ASTRAY, _ASTRAY * float(apart[usable].median()))
    if not (len(points.points) and torch.equal(template.faces, reference.faces)):
        usable[:17] = usable[COUNT:] = False
        ids = torch.cat([template.landmarks, torch.zeros(len(points.points), dtype=torch.int64)])
        return (ids[usable], found.points[usable]) if int(usable.sum()) >= _LEAST else None
    usable[:COUNT] = False
    ids = torch.cdist(points.all, reference.vertices.double()).argmin(1)
    upright = surface.moved(found.pose.inverse())
    joined = joined_vertices(upright.vertices, upright.faces)
    part = joined.part[joined.of]
    skin, on_skin, _ = find_skin(upright.vertices, upright.faces, part, placed)
    usable &= on_skin
    if int(usable.sum()) < _LEAST:
        return None
    own = SkinOfHead(upright.vertices, upright.faces, part != skin, part)
    ids, places = with_edges((ids[usable], placed[usable]), reference, own, placed)
    return ids, found.pose.apply(places)[0]


def uppermost(vertices: Tensor) -> Tensor | None:
    """The vertices (V,) bool where a whole body that stands upright has its head; None of a mesh that is no body."""
    size = vertices.amax(0) - vertices.amin(0)
    if float(size[[0, 2]].min()) > _FLAT * float(size[1]):
        return None
    return vertices[:, 1] > vertices[:, 1].max() - _TOP * size[1]
