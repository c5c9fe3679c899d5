"""Kinds of heads that pictures are rendered of, all described in the coordinates of the embedded performer's sculpture.

Paint, hair and beards are functions of a point on that sculpture. Another topology takes them over through a smooth map
of its own mean head onto it, by their common landmarks.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from torchface.errors import ShapeError
from torchface.io.rigs.ict_facekit import IdentityModes
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic.head.drawn_identities import draw_identities
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import IDENTITY, sculpted_vertices
from torchface.synthetic.head.performer import SHAPES, performer
from torchface.synthetic.head.skin_texture import vertex_marks
from torchface.workflows.surface_sites import SHARED, alike_vertices, bent_onto, jaw_and_lids

from .dense_points import dense_vertices

_WAVES = 10
SKIN, TEETH, GUMS, EYEBALL, SOCKET = range(5)
"""What a triangle is made of."""
# Clear shells over the eyes, and lashes on cards that an image would have to cut out.
_HIDDEN = ("lacrimal_fluid", "eye_blend", "eye_occlusion", "eyelashes")
_LUMP = 1.5  # millimetres; standard deviation of what no mode of identity knows


@dataclass(frozen=True, eq=False)
class DrawnHead:
    """Someone: the head at rest (V,3) in millimetres, where the mean performer stands, and what shapes add (N,V,3)."""

    rest: Tensor
    deltas: Tensor

    def posed(self, weights: Tensor) -> Tensor:
        """The head (V,3) at weights (N,)."""
        return self.rest + torch.tensordot(weights, self.deltas, dims=1)


@dataclass(frozen=True, eq=False)
class HeadKind:
    """A topology, and how people of it are drawn."""

    faces: Tensor  # (F,3)
    material: Tensor  # of each face, (F,)
    landmarks: Tensor  # vertices of iBUG's 68, (68,)
    canonical: Tensor  # each vertex on the performer's sculpture, (V,3)
    marks: Tensor  # what skin is painted by, (V,8); see skin_texture
    outer: Tensor  # vertices of the skin that can be a contour, (V,) bool
    shapes: Tensor  # from ARKit's 52 weights to the rig's, (N,52)
    dense: Tensor  # vertices of the points of dense_points, (P,)
    brow_lift: float  # how much higher brows lie than on the performer, millimetres
    draw: Callable[[torch.Generator], DrawnHead]  # someone new


@lru_cache(maxsize=1)
def performer_kind() -> HeadKind:
    """Embedded performers."""
    notes = head_annotations()
    rig = performer(texture=False)
    faces, regions = rig.neutral.faces, notes.regions
    assert notes.landmarks is not None
    ball = regions["eyeball_left"] | regions["eyeball_right"]
    material = torch.where(ball[faces].all(1), EYEBALL, SKIN)
    hidden = ("mouth_interior", "nostrils", "eye_sockets", "eyeball_left", "eyeball_right", "ear_left", "ear_right")

    def draw(generator: torch.Generator) -> DrawnHead:
        identity = draw_identities(1, generator, 1.2)[0]
        leaning = torch.tensor([0.8 if parameter.name == "face_width" else 0.0 for parameter in IDENTITY])
        someone = performer(identity + leaning, texture=False)
        return DrawnHead(_lumpy(someone.vertices, sculpted_vertices(), generator), someone.deltas)

    outer = ~torch.stack([regions[name] for name in hidden]).any(0)
    dense, _ = dense_vertices()
    return HeadKind(
        faces,
        material,
        notes.landmarks,
        sculpted_vertices(),
        vertex_marks(),
        outer,
        mapping(ARKIT, SHAPES),
        dense,
        0.0,
        draw,
    )


def people_kind(rig: BlendshapeRig, modes: IdentityModes) -> HeadKind:
    """ICT-FaceKit's heads: identity modes of people and the expressions of the whole head."""
    notes = rig.neutral.annotations
    if notes is None or notes.landmarks is None or "eyeball_left" not in notes.regions:
        raise ShapeError("rig: found no 68 landmarks with parts, expected ICT-FaceKit's whole head")
    regions, mean = notes.regions, rig.vertices.double()
    marks68 = head_annotations().landmarks
    assert marks68 is not None
    target = sculpted_vertices()[marks68]
    shift = (target[SHARED] - mean[notes.landmarks[SHARED]]).mean(0)
    placed = mean + shift
    canonical = bent_onto(mean, notes.landmarks, target)
    inner = torch.zeros(len(mean), dtype=torch.bool)
    for name in ("mouth_socket", "gums_and_tongue", "teeth", "eye_socket_left", "eye_socket_right"):
        inner |= regions[name]
    clear = torch.stack([mask for name, mask in regions.items() if name.startswith(_HIDDEN)]).any(0)
    balls = regions["eyeball_left"] | regions["eyeball_right"]
    own = _marks_of(canonical, regions, placed, inner | balls | clear)
    faces = rig.neutral.faces
    faces = faces[~clear[faces].any(1)]
    faces = faces[~_inner_shell(faces, balls, placed)]
    material = torch.full((len(faces),), SKIN)
    for mask, number in (
        (regions["teeth"], TEETH),
        (regions["gums_and_tongue"], GUMS),
        (balls, EYEBALL),
        (regions["mouth_socket"], SOCKET),
    ):
        material[mask[faces].all(1)] = number
    # Eyeballs are painted about their own centres, wherever the mean performer's eyes are.
    canonical = torch.where(balls[:, None], _eye_canonical(placed, regions, canonical), canonical)
    rest = (modes.neutral.vertices.double() + shift).float()

    def draw(generator: torch.Generator) -> DrawnHead:
        coefficients = torch.randn(len(modes.names), generator=generator).clamp(-2.5, 2.5)
        head = rest + torch.tensordot(coefficients, modes.deltas, dims=1)
        middle = head[notes.landmarks].mean(0)
        stretch = 1 + torch.tensor([0.045, 0.04, 0.04]) * torch.randn(3, generator=generator).clamp(-2, 2)
        return DrawnHead(_lumpy((head - middle) * stretch + middle, canonical, generator), rig.deltas * stretch)

    outer = (regions["face"] | regions["head_and_neck"]) & ~(own[:, 7] > 0.5)
    points = dense_vertices()[0]
    motions, theirs = jaw_and_lids(rig, notes.landmarks), jaw_and_lids(performer(texture=False), marks68)
    assert motions is not None
    assert theirs is not None
    moved = torch.stack(motions, dim=1), torch.stack(theirs, dim=1)[points]
    dense = alike_vertices(canonical, outer, sculpted_vertices()[points], moved)
    shapes = mapping(ARKIT, rig.names)
    return HeadKind(faces, material, notes.landmarks, canonical, own, outer, shapes, dense, 1.0, draw)


def _marks_of(canonical: Tensor, regions: dict[str, Tensor], placed: Tensor, inner: Tensor) -> Tensor:
    """The performer's marks at the nearest places of its skin, and those of the parts that the head has itself."""
    theirs, notes = vertex_marks(), head_annotations()
    hidden = ("mouth_interior", "eye_sockets", "eyeball_left", "eyeball_right")
    skin = (~torch.stack([notes.regions[name] for name in hidden]).any(0)).nonzero()[:, 0]
    nearest = torch.from_numpy(KDTree(sculpted_vertices()[skin].numpy()).query(canonical.numpy())[1])
    marks = theirs[skin[nearest]].clone()
    marks[:, 1:6] = 0.0
    marks[inner] = 0.0
    marks[regions["mouth_socket"], 1:3] = 1.0
    marks[regions["eye_socket_left"] | regions["eye_socket_right"], 3] = 1.0
    marks[regions["eyeball_left"] | regions["eyeball_right"], 5] = 1.0
    face = regions["face"].nonzero()[:, 0]
    for side in ("left", "right"):  # the lids' rims are where the face meets the sockets
        socket = placed[regions[f"eye_socket_{side}"]].numpy()
        distance = torch.from_numpy(KDTree(socket).query(placed[face].numpy())[0])
        marks[face, 4] = torch.maximum(marks[face, 4], (1 - distance / 0.9).clamp(0, 1).float())
    return marks


def _inner_shell(faces: Tensor, balls: Tensor, placed: Tensor) -> Tensor:
    """Triangles of the shell behind an eyeball's outer one: what paint shows lies on the outer one."""
    inner = torch.zeros(len(faces), dtype=torch.bool)
    of_ball = balls[faces].all(1).nonzero()[:, 0]
    for sign in (-1, 1):
        rows = of_ball[sign * placed[faces[of_ball, 0], 0] > 0]
        points = placed[faces[rows]].mean(1)
        back = points[points[:, 2] < points[:, 2].quantile(0.5)]
        middle = (placed[faces[rows]].reshape(-1, 3).amax(0) + placed[faces[rows]].reshape(-1, 3).amin(0)) / 2
        radius = (back - middle).norm(dim=1).median()
        inner[rows] = (points - middle).norm(dim=1) < 0.93 * radius
    return inner


def _eye_canonical(placed: Tensor, regions: dict[str, Tensor], canonical: Tensor) -> Tensor:
    """Eyeballs (V,3) moved and scaled onto the mean performer's."""
    moved, notes, mean = canonical.clone(), head_annotations(), sculpted_vertices()
    for side in ("left", "right"):
        own, theirs = regions[f"eyeball_{side}"], notes.regions[f"eyeball_{side}"]
        a, b = placed[own], mean[theirs]
        size = (b.amax(0) - b.amin(0))[0] / (a.amax(0) - a.amin(0))[0]
        middle = (a.amax(0) + a.amin(0)) / 2
        moved[own] = (a - middle) * size + (b.amax(0) + b.amin(0)) / 2
    return moved


def _lumpy(vertices: Tensor, canonical: Tensor, generator: torch.Generator) -> Tensor:
    """A head moved by a smooth random field of 60 to 150 mm, nearly the same on both sides."""
    folded = canonical.clone().float()
    folded[:, 0] = folded[:, 0].abs() + 0.15 * folded[:, 0]
    heading = torch.nn.functional.normalize(torch.randn(_WAVES, 3, generator=generator), dim=-1)
    length = 60 + 90 * torch.rand(_WAVES, 1, generator=generator)
    phase = folded @ (heading * (2 * math.pi / length)).T + 2 * math.pi * torch.rand(_WAVES, generator=generator)
    field = phase.sin() @ torch.randn(_WAVES, 3, generator=generator) * (_LUMP * math.sqrt(2 / _WAVES))
    field[:, 0] = (
        field[:, 0] * torch.from_numpy(np.sign(canonical[:, 0].numpy())).float() * (folded[:, 0] / 25).clamp(max=1)
    )
    return vertices + field
