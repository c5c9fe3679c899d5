"""The motion of a head's loose parts (eyes, teeth, gums, tongue, lashes) in shapes that its skin has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.landmarks.surfaces.eye_openings import Opening
from torchface.modeling.rigging.eye_motion import eyeballs, slid, turned
from torchface.modeling.rigging.eyelid_closure import stands_before
from torchface.modeling.rigging.joined_vertices import JoinedHead
from torchface.modeling.rigging.mouth_parts import in_the_mouth, jaw_motions
from torchface.optim.sparse import SparseCholesky
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

_ROOT, _LYING, _STIFF = 0.3, 2.0, 0.01
_WIDE, _OVER = 60.0, 15.0  # millimetres: parts that cover skin are so wide; and how far they stand off it
_SHELL, _CLEAR = 6.0, 0.2  # millimetres before an eye: where shells lie at most, how near they come at least


@dataclass(frozen=True, eq=False)
class LooseParts:
    """How a head moves with its loose parts."""

    deltas: Tensor  # (N,J,3), millimetres
    bones: Tensor  # vertices of eyeballs and of what lies in the mouth, (J,) bool
    tongue: Tensor  # how much each vertex is of the tongue, (J,) in [0,1]


def moved_parts(
    template: BlendshapeRig,
    vertices: Tensor,
    faces: Tensor,
    part: Tensor,
    loose: Tensor,
    deltas: Tensor,
    openings: Sequence[Opening | None] = (None, None),
) -> LooseParts:
    """Deltas of a head's loose parts beside those of its skin.

    What lies within a template's eyeball turns as it does, about its own middle; plates on which an eye is drawn slide
    behind its lids. What lies in the mouth is bone: above
    the line of the lips it stays, below it goes with the jaw. The rest goes with the nearest skin.

    Args:
        template: the template's rig on this head's face, with iBUG's 68 landmarks; without landmarks or eyeballs all
            parts go with the skin.
        vertices: of the head, (J,3) float64, in the template's place.
        part: connected part of each vertex, (J,).
        loose: vertices of parts that are no skin, (J,) bool.
        deltas: of the skin, (N,J,3).
        openings: of the right and left eye, where they are seen.
    """
    deltas, tongue = deltas.clone(), torch.zeros(len(vertices), dtype=torch.float64)
    loose = loose & (torch.bincount(faces.flatten(), minlength=len(vertices)) > 0)
    if not loose.any():
        return LooseParts(deltas, tongue > 0, tongue)
    head = JoinedHead(vertices, part, loose, deltas)
    left = loose.clone()
    for eyeball, opening in zip(eyeballs(template), reversed(openings), strict=False):  # the left one first
        ball = turned(head, template, eyeball, left)
        left &= ~(ball if ball.any() else slid(head, template, eyeball, opening, left))
    eyes = loose & ~left
    notes = template.neutral.annotations
    if notes is not None and notes.landmarks is not None and len(notes.landmarks) == 68:
        mouth = template.vertices.double().cpu()[notes.landmarks.cpu()[48:68]]
        inside, share, tongue = in_the_mouth(head, faces, left, mouth)
        jaw = jaw_motions(template)
        ids = inside.nonzero()[:, 0]
        if len(ids):
            deltas[:, ids] = share[ids, None] * (jaw.apply(vertices[ids]) - vertices[ids])
        left &= ~inside
    if left.any():
        _attached(head, faces, left)
        _before_eyes(head, faces[eyes[faces].all(1)], left)
    return LooseParts(deltas, loose & ~left, tongue)


def _attached(head: JoinedHead, faces: Tensor, left: Tensor) -> None:
    """Lets parts go with the skin where they touch it, and the rest of each with that: lashes stay straight.

    Wide parts, such as beards, go with the skin under them, the less the further they stand off.
    """
    ids = left.nonzero()[:, 0]
    row = torch.full((len(left),), -1)
    row[ids] = torch.arange(len(ids))
    own = row[faces[left[faces].all(1)]]
    points = head.vertices[ids]
    place = SurfaceIndex(head.vertices, faces[~head.loose[faces].any(1)]).nearest(points)
    corner, distance = faces[~head.loose[faces].any(1)][place.triangle], place.distance
    part = head.part[ids].unique(return_inverse=True)[1]
    near = torch.stack([_root_reach(distance[part == one]) for one in range(int(part.max()) + 1)])
    weight = torch.where(distance <= near[part], 1.0, 1e-9).double()
    wide = torch.stack([(points[part == one].amax(0) - points[part == one].amin(0)).max() for one in range(len(near))])
    wide = wide[part] > _WIDE
    weight[wide] = torch.exp(-((distance[wide] / _OVER) ** 2)).clamp(min=1e-9)
    beside = torch.einsum("njkc,jk->njc", head.deltas[:, corner], place.barycentric)
    guess = (beside * weight[:, None]).permute(1, 0, 2).flatten(1)
    matrix = sparse.diags_array(weight.numpy()) + _STIFF * stretching_energy(points, own)
    solved = SparseCholesky(matrix).solve(guess)
    head.deltas[:, ids] = solved.unflatten(1, (-1, 3)).permute(1, 0, 2)


def _before_eyes(head: JoinedHead, eyes: Tensor, left: Tensor) -> None:
    """Keeps shells of the eye, such as a tear film, before the triangles of the eyeballs that they cover at rest."""
    if not len(eyes):
        return
    caster, ids = RayCaster(head.vertices, eyes), left.nonzero()[:, 0]
    before = -stands_before(caster, head.vertices[ids])
    shell = (before > 0) & (before < _SHELL)
    ids, least = ids[shell], before[shell].clamp(max=_CLEAR)
    for delta in head.deltas:
        if bool(delta[ids].any()):
            lacking = stands_before(caster, head.vertices[ids] + delta[ids]) + least
            delta[ids, 2] += lacking.clamp(0, _SHELL)


def _root_reach(distance: Tensor) -> Tensor:
    """How near the skin a part's vertices are that go with it: as far as the nearest, or those of its nearer half."""
    return torch.maximum(distance.min() + _ROOT, distance.median().clamp(max=_LYING))
