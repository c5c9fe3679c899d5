"""Sites on a rig of the points that a landmark network finds: the embedded performer is registered to it, once."""

from __future__ import annotations

from contextlib import suppress

import torch
from torch import Tensor

from torchface import zoo
from torchface.attachment import Attachment
from torchface.capture.own_rig.face_points import JAW
from torchface.errors import FileFormatError, ShapeError
from torchface.files.cache_folder import cache_folder
from torchface.files.content_keys import content_key
from torchface.geometry.meshes.operators import components
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Mesh
from torchface.modeling import HeadModel
from torchface.progress import Progress, silent
from torchface.registration.scan_registration import register
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import mean_vertices
from torchface.synthetic.head.performer import performer

HEADS = "head"
"""The model of the zoo by which the performer takes on another head's form."""

COUNTED = False
"""Whether ``track`` and ``live`` count a network's points. On four films of other people, with the expression read too,
they take errors of weights from 0.125 to 0.126 and from 0.142 to 0.148, correlations from 0.74 to 0.55 and from 0.48 to
0.45: their errors are those of the landmarks and of the head."""

_METHOD = "surface sites/1"


def counted_sites(rig: BlendshapeRig, places: Tensor) -> Attachment | None:
    """The sites of the points that solves count, see ``COUNTED``; none where a network finds no points."""
    return sites_on_rig(rig, places) if COUNTED and len(places) else None


def sites_on_rig(rig: BlendshapeRig, places: Tensor, progress: Progress | None = None) -> Attachment:
    """Where points of the embedded performer's mean head lie on a rig, as sites on its neutral mesh.

    The performer is registered to the rig by its landmarks, and each point goes to the nearest place of the skin that
    the landmarks lie on, past eyeballs and teeth. That takes a minute, and is kept in the cache; on a rig of the
    performer's own topology the points are known.

    Args:
        rig: with the 68 landmarks annotated.
        places: of the points on the mean head, (P,3), millimetres; see ``LandmarkNetwork.places``.
        progress: called with each step.

    Raises:
        ShapeError: the rig has no landmarks.
        AlignmentError: the performer cannot be registered to it.
    """
    template = performer(texture=False).neutral.with_vertices(mean_vertices().float())
    own = _attached(template, places)
    neutral = rig.neutral
    if neutral.faces.shape == template.faces.shape and torch.equal(neutral.faces.cpu(), template.faces):
        return Attachment(own.triangles, own.barycentric).made_for(neutral)
    if neutral.landmarks is None:
        raise ShapeError("rig: found no landmarks, expected the 68 of iBUG's order; see torchface annotate")
    key = content_key(_METHOD, neutral=neutral, places=places, heads=zoo.find(HEADS))[:32]
    with suppress(FileFormatError):  # not there, or damaged
        return Attachment.load(cache_folder("surface_sites") / f"{key}.json")
    (progress or silent)("finding the points' places on the rig, once")
    marks, inner = head_annotations().landmarks, slice(JAW, None)  # a contour is where a head is seen to end
    assert marks is not None
    landmarks = marks[inner], neutral.vertices[neutral.landmarks[inner]]
    fitted = register(
        template, neutral, landmarks, model=zoo.get_model(HEADS, HeadModel), texture_size=0, progress=progress
    )
    skin = components(neutral.faces, len(neutral.vertices))
    on_skin = torch.isin(skin[neutral.faces[:, 0]], skin[neutral.landmarks]).nonzero()[:, 0]
    found = SurfaceIndex(neutral.vertices, neutral.faces[on_skin]).nearest(own.on(template.faces, fitted.mesh.vertices))
    sites = Attachment(on_skin[found.triangle], found.barycentric.float()).made_for(neutral)
    with suppress(FileFormatError):
        sites.save(cache_folder("surface_sites") / f"{key}.json")
    return sites


def _attached(mesh: Mesh, points: Tensor) -> Attachment:
    found = SurfaceIndex(mesh.vertices, mesh.faces).nearest(points)
    return Attachment(found.triangle, found.barycentric.float())
