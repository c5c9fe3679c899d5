"""Sites on a rig of the points that a landmark network finds: a head's places are carried over to another's."""

import torch
from scipy.interpolate import RBFInterpolator
from scipy.spatial import KDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ShapeError
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import sculpted_vertices
from torchface.synthetic.head.performer import performer

SHARED = [*range(4, 13), *range(27, 68)]  # landmarks that all heads mean alike

_SMOOTHING, _OTHER_SIZE, _TURNED = 1.0, 0.2, 20.0  # the second a logarithm, the third in degrees
_JAW, _LIDS = 8.0, 6.0  # millimetres that a whole motion of the jaw and of the lids counts when points are compared
_AHEAD = -0.8  # z of a normal: what faces further back lies inside a mouth; edges of lids do less


def sites_on_rig(rig: BlendshapeRig, places: Tensor) -> Attachment:
    """Where points of the embedded performer's sculpture lie on a rig, as sites on its neutral mesh.

    The rig's head is bent onto the performer's by their landmarks, and each point goes to the vertex of the skin that
    lies nearest and moves alike with the jaw and the lids: so networks were taught where their points are on other
    heads. On a rig of the performer's own topology the points are known.
    """
    actor = performer(texture=False)
    template = actor.neutral.with_vertices(sculpted_vertices().float())
    own = _attached(template, places)
    neutral = rig.neutral
    if torch.equal(neutral.faces[: len(template.faces)].cpu(), template.faces):  # a character's come first
        return Attachment(own.triangles, own.barycentric).made_for(neutral)
    marks = neutral.landmarks
    if marks is None:
        raise ShapeError("rig: found no landmarks, expected the 68 of iBUG's order; see torchface annotate")
    theirs = head_annotations().landmarks
    assert theirs is not None
    vertices, faces = neutral.vertices.detach().cpu().double(), neutral.faces.cpu()
    canonical = bent_onto(vertices, marks, sculpted_vertices().double()[theirs])
    part = components(faces, len(vertices))
    skin = torch.isin(part, part[marks]) & (vertex_normals(canonical, faces)[:, 2] > _AHEAD)
    motions = jaw_and_lids(rig, marks), jaw_and_lids(actor, theirs)
    moved = None
    if motions[0] is not None and motions[1] is not None:
        wanted = own.on(template.faces, torch.stack([*motions[1], motions[1][0]], dim=1))[:, :2]
        moved = torch.stack(motions[0], dim=1), wanted
    return Attachment.from_vertices(neutral, alike_vertices(canonical, skin, places, moved)).made_for(neutral)


def bent_onto(vertices: Tensor, landmarks: Tensor, target: Tensor) -> Tensor:
    """Vertices (V,3) of a head moved smoothly so that its landmarks (68,) lie at others, (68,3)."""
    marks, goal = vertices[landmarks[SHARED]], target[SHARED]
    place = similarity_transform(marks[None], goal[None])
    turn = torch.rad2deg(torch.arccos(((place.rotation[0].trace() - 1) / 2).clamp(-1, 1)))
    # The heads that networks learned from were moved alone; one of another size or bearing is brought there first.
    if abs(float(place.scale[0].log())) > _OTHER_SIZE or float(turn) > _TURNED:
        placed = place.apply(vertices[None])[0]
    else:
        placed = vertices + (goal - marks).mean(0)
    at = placed[landmarks[SHARED]].numpy()
    # The motion is interpolated, not the place: far from all landmarks it fades to their mean.
    warp = RBFInterpolator(at, goal.numpy() - at, kernel="linear", smoothing=_SMOOTHING)
    return placed + torch.from_numpy(warp(placed.numpy()))


def alike_vertices(
    canonical: Tensor, skin: Tensor, places: Tensor, motions: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Vertices of another topology that are points of the sculpture, (P,).

    Lids and lips of two topologies lie a few millimetres apart there, and their upper and lower ones close together:
    so motions are compared beside places.

    Args:
        canonical: each vertex on the performer's sculpture, (V,3).
        skin: which vertices may be points, (V,) bool.
        places: of the points, (P,3).
        motions: how far the jaw and both lids move each vertex, (V,2), and each point, (P,2); see ``jaw_and_lids``.
    """
    rows, unit = skin.nonzero()[:, 0], torch.tensor([_JAW, _LIDS], dtype=torch.float64)
    own, wanted = canonical[rows].double(), places.double()
    if motions is not None:
        own = torch.cat([own, unit * motions[0][rows].double()], dim=1)
        wanted = torch.cat([wanted, unit * motions[1].double()], dim=1)
    return rows[torch.from_numpy(KDTree(own.numpy()).query(wanted.numpy())[1])]


def jaw_and_lids(rig: BlendshapeRig, landmarks: Tensor) -> tuple[Tensor, Tensor] | None:
    """How far the jaw and the lids move each vertex down, (V,), of the chin's and the lids' motion; None without
    them."""
    shapes = mapping(ARKIT, rig.names)
    rows = [shapes[:, ARKIT.index(name)] for name in ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight")]
    if any(float(row.amax()) <= 0 for row in rows):
        return None
    open_jaw, left, right = (rig.deltas[int(row.argmax()), :, 1].detach().cpu().double() for row in rows)
    lids = left + right
    return open_jaw / open_jaw[landmarks[8]].abs(), lids / lids[landmarks[[37, 38, 43, 44]]].abs().mean()


def _attached(mesh: Mesh, points: Tensor) -> Attachment:
    found = SurfaceIndex(mesh.vertices, mesh.faces).nearest(points)
    return Attachment(found.triangle, found.barycentric.float())
