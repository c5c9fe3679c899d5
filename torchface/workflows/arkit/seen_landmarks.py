"""Landmarks of a head that has none of its own: seen in pictures from around."""

from __future__ import annotations

import torch

from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.surfaces.face_on_surface import FaceSearch, NoFaceOnSurfaceError, ReferencePoints
from torchface.mesh import Mesh
from torchface.progress import Progress
from torchface.registration.scan_preparation import Landmarks
from torchface.rendering.textured_surface import Material, TexturedSurface
from torchface.synthetic import neutral_head
from torchface.workflows.named_finders import load_finder

_SKIN = (0.8, 0.62, 0.53, 1.0)
_ASTRAY, _LEAST_ASTRAY, _LEAST = 4.0, 15.0, 12


def seen_landmarks(head: Mesh, template: Mesh, progress: Progress) -> Landmarks | None:
    """Vertices of a template and where they lie on a head in any pose and unit; None where no face is seen.

    Args:
        head: at rest.
        template: with 68 landmarks; of the embedded performer's topology the finder's other points count, of others the
            68 without their contour.
        progress: called with each picture.
    """
    reference, finder = neutral_head(texture=False), load_finder()
    points = ReferencePoints(reference.vertices[reference.landmarks], finder.places)
    search = FaceSearch(shipped_detector(), finder.finder, points)
    plain = torch.zeros(len(head.faces), dtype=torch.int64)
    no_uvs = torch.zeros(len(head.vertices), 2)
    surface = TexturedSurface(head.vertices.double(), head.faces, no_uvs, plain, (Material(torch.tensor(_SKIN)),))
    try:
        found = search.find(surface, None, progress)
    except NoFaceOnSurfaceError:
        return None
    placed = found.pose.inverse().apply(found.points)[0]
    apart = (placed - points.all).norm(dim=-1)
    usable = torch.isfinite(apart)
    usable &= apart < max(_LEAST_ASTRAY, _ASTRAY * float(apart[usable].median()))
    if len(points.points) and torch.equal(template.faces, reference.faces):
        usable[:COUNT] = False
        ids = torch.cdist(points.all, reference.vertices.double()).argmin(1)
    else:
        usable[:17] = usable[COUNT:] = False
        ids = torch.cat([template.landmarks, torch.zeros(len(points.points), dtype=torch.int64)])
    return (ids[usable], found.points[usable]) if int(usable.sum()) >= _LEAST else None
