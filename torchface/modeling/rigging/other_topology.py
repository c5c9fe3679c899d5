"""A template's blendshapes on a head of another topology, whose vertices keep their number and order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import (
    border_vertices,
    corners,
    edges,
    triangle_normals,
    vertex_areas,
    vertex_normals,
)
from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.geometry.meshes.surface_index import triangle_coordinates
from torchface.mesh import Mesh
from torchface.modeling.rigging.deformation_transfer import transfer_with_report
from torchface.modeling.rigging.eyelid_closure import SkinOfHead, eyes_seen, lids_looking_down, shut_blinks
from torchface.modeling.rigging.loose_parts import moved_parts
from torchface.modeling.rigging.part_clearance import clear_parts
from torchface.modeling.rigging.part_placement import place_parts
from torchface.modeling.rigging.penetration import InnerParts, inner_parts
from torchface.optim.sparse import SparseCholesky
from torchface.progress import Progress, silent
from torchface.registration import Registration, hidden_parts, register, with_template_skin
from torchface.registration.scan_preparation import Landmarks
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping

_NORMAL_REACH = 6.0
"""A normal that points the other way counts as far as twice these millimetres: lips that touch stay apart."""
_CANDIDATES = 12
_NEAR, _FAR = 2.0, 20.0
_BLIND = 1e-3
"""How much the guess counts for a vertex that has no place on the template, beside one that has."""
_SMOOTH = 0.4
_SKIN_SHARE, _BODY_SHARE = 0.3, 0.15
_OPEN = 0.1  # of an eye: what a blink that shuts it leaves at most
_JAW, _LIP, _DRAWN, _LEAST_DRAWN = "jawOpen", 10.0, 4.0, 3  # millimetres round the lips' line, times their length
_MOUTH, _STRETCHED = (75.0, 25.0), 2.0  # millimetres behind the lips and over them; times an edge's length
_SAME_PLACE = 1e-4
_AT_LIPS = 1.5  # millimetres from the edge of lips that were cut
_ALIKE = 0.2


@dataclass(frozen=True, eq=False)
class CarriedShapes:
    """A head of its own topology with a template's shapes.

    Args:
        rig: the head, every vertex where it was, with the template's names.
        registration: of the template with the head, in the head's space.
        template: the template's rig on the head's face, in the template's topology, place and size.
        distance: of each of the head's vertices to that face, (V,), millimetres of the template's size.
        places: which vertices have a place on it, (V,) bool; the others follow by smoothness or as loose parts.
        tongue: how much each vertex is of the head's own tongue, (V,) in [0,1]; all zero where it has none.
        open_lids: what the blinks of the right and left eye leave open, as a share of the opening; None where its lids
            cannot be told from the eye, as of painted or welded eyes, and its blink is the template's.
    """

    rig: BlendshapeRig
    registration: Registration
    template: BlendshapeRig
    distance: Tensor
    places: Tensor
    tongue: Tensor
    open_lids: tuple[float | None, ...]

    def notes(self, lips_cut: bool = False, shut: tuple[bool, bool] = (False, False)) -> list[str]:
        """Of eyes that may not shut and lips that do not part, if nobody has cut them, for people to read.

        Args:
            shut: whether the right and left eye are modelled shut.
        """
        named = list(zip(("right", "left"), self.open_lids, strict=True))
        at_rest = [side for (side, _), yes in zip(named, shut, strict=True) if yes]
        unseen = [side for side, left in named if left is None and side not in at_rest]
        notes = [
            f"warning: {side} eye: its blink leaves {left:.0%} of it open"
            for side, left in named
            if (left or 0) > _OPEN
        ]
        if at_rest:
            notes.append(
                f"warning: {' and '.join(at_rest)} eye: modelled shut: eyeBlink moves nothing and eyeWide opens it; "
                "ARKit's shapes expect open eyes at rest"
            )
        if unseen:
            notes.append(
                f"warning: {' and '.join(unseen)} eye: the lids cannot be told from the eye (painted, shut or "
                "one piece with the skin): look whether it shuts"
            )
        if not lips_cut and self._lips_in_one_piece():
            notes.append(
                "warning: the lips are one piece: jawOpen stretches the skin between them; cut the mesh along the lips"
            )
        if between := self._edges_between_jaws():
            notes.append(
                f"warning: {between} edges inside the mouth join both jaws where more than two triangles share an "
                "edge, as in reduced meshes: jawOpen stretches them across the mouth; separate the two rows of teeth"
            )
        return notes

    def _opened(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """The inner lips, and the head at rest and with its jaw open, in the template's place."""
        marks, jaw = _marks(self.template), mapping(self.rig.names, [_JAW])[0] > 0.5
        if not bool(jaw.any()) or bool(marks.isnan().any()):
            return None
        back = self.registration.pose.inverse()
        rest = back.apply(self.rig.vertices.detach().cpu().double())[0]
        return marks[60:68], rest, rest + back.apply_vectors(self.rig.deltas[jaw][:1].detach().cpu().double())[0]

    def _lips_in_one_piece(self) -> bool:
        """Whether opening the jaw draws edges out from one lip to the other."""
        if (opened := self._opened()) is None:
            return False
        lips, rest, posed = opened
        beside = (rest - lips.mean(0)).abs() < torch.tensor([float(lips[4, 0] - lips[0, 0]) / 3, _LIP, _LIP])
        ends = edges(self.rig.neutral.faces.cpu())
        ends = ends[beside.all(1)[ends].all(1)]
        return int(_drawn(ends, rest, posed, _DRAWN).sum()) >= _LEAST_DRAWN

    def _edges_between_jaws(self) -> int:
        """How many edges behind the lips opening the jaw draws out beside those that more than two triangles share.

        Cheeks and the wall of a mouth are drawn out as far, but there two triangles share an edge.
        """
        if (opened := self._opened()) is None:
            return 0
        lips, rest, posed = opened
        joined = joined_vertices(rest, self.rig.neutral.faces.cpu())
        away = joined.vertices - lips.mean(0)
        inside = (away[:, 2] < 0) & (away.norm(dim=-1) < _MOUTH[0]) & (away[:, 1].abs() < _MOUTH[1])
        # A face of two sides counts once.
        faces = joined.faces[inside[joined.faces].all(1)].sort(1).values.unique(dim=0)
        faces = faces[(faces[:, :2] != faces[:, 1:]).all(1)]
        pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [0, 2]]])
        ends, count = pairs.unique(dim=0, return_counts=True)
        after = torch.zeros_like(joined.vertices)
        after[joined.of] = posed
        shared = torch.isin(ends, ends[count > 2]).any(1)
        found = int((_drawn(ends, joined.vertices, after, _STRETCHED) & shared).sum())
        return found if found >= _LEAST_DRAWN else 0


def _drawn(ends: Tensor, rest: Tensor, posed: Tensor, times: float) -> Tensor:
    """Which edges (E,) a pose makes longer by so many times and by more than a lip."""
    before, after = ((one[ends[:, 0]] - one[ends[:, 1]]).norm(dim=-1) for one in (rest, posed))
    return (after > times * before) & (after - before > _LIP)


@dataclass(frozen=True, eq=False)
class TemplatePlaces:
    """Vertices of a head that follow known places of the template.

    Args:
        rows: of the head, (n,).
        corner: two vertices of the template for each, (n,2).
        share: how much of each, (n,2).
    """

    rows: Tensor
    corner: Tensor
    share: Tensor

    @staticmethod
    def at(rows: Tensor, ids: Tensor) -> TemplatePlaces:
        """At vertices ids (n,) of the template."""
        return TemplatePlaces(rows, ids[:, None].expand(-1, 2), torch.tensor([1.0, 0.0]).double().repeat(len(ids), 1))


def shapes_on(
    template: BlendshapeRig,
    target: Mesh,
    landmarks: Landmarks | None = None,
    *,
    registration: Registration | None = None,
    movable: Tensor | None = None,
    followed: TemplatePlaces | None = None,
    progress: Progress | None = None,
) -> CarriedShapes:
    r"""Gives a head of any topology a template's shapes on its own vertices.

    The template is registered to the head and its shapes are transferred to what it became. The head's vertices take
    the motion :math:`\hat u` of the nearest place there whose normal agrees, as smoothly as they have no such place:

    .. math:: \min_u \sum_v c_v a_v \lVert u_v - \hat u_v \rVert^2 + \ell^2 \int \lVert \nabla u \rVert^2

    with areas a and confidences c that fall with the distance and the normals' angle. Eyeballs turn about their own
    middle, teeth and tongue go with the jaw, other loose parts with the skin nearest to them; far from the template
    nothing moves.

    Args:
        template: a rig, millimetres.
        target: the head: any vertices, order, size and pose, parts apart or not, split at seams or not.
        landmarks: template vertex ids (L,) and points in the target's space (L,3), as ``register`` takes them.
        registration: of the template's neutral with the target, where it is there already.
        movable: which of the target's vertices may move, (V,) bool; all if absent.
        followed: places of the template that are known; the others are found by distance and normal.
        progress: called with each step and how far it is.

    Raises:
        AlignmentError, ValueRangeError, TopologyError: as of ``register`` and ``transfer_deformation``.

    Source: Sumner and Popovic 2004 between topologies, with displacements in place of gradients.

    Example:
        >>> from torchface.mesh import submesh
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False).select(["jawOpen"])
        >>> face = submesh(actor.neutral, actor.neutral.annotations.regions["face"]).mesh  # other vertices
        >>> carried = shapes_on(actor, face, (actor.neutral.landmarks, face.vertices[face.landmarks].double()))
        >>> carried.rig.names, len(carried.rig.vertices) == len(face.vertices)
        (('jawOpen',), True)
    """
    progress = progress or silent
    if movable is not None and movable.shape != target.vertices.shape[:1]:
        raise ValueRangeError(f"movable: found {tuple(movable.shape)}, expected ({len(target.vertices)},)")
    template = template.linear("shapes_on")
    if registration is None:
        registration = register(template.neutral, target, landmarks, texture_size=0, progress=progress)
    to_template = registration.pose.inverse()
    goal = to_template.apply(target.vertices.detach().cpu().double())[0]
    fitted = fitted_template(template, registration)
    moved = transfer_with_report(template, fitted, progress=progress).rig
    progress("carrying the shapes over")
    joined = joined_vertices(goal, target.faces.cpu())
    skin = _Skin.of(moved, registration, joined, followed)
    deltas = skin.carried(moved.deltas.double())
    head = SkinOfHead(joined.vertices, joined.faces, skin.loose, joined.part)
    openings, down = eyes_seen(head, _marks(moved)), lids_looking_down(template)
    deltas, left = shut_blinks(head, deltas, moved.names, openings, skin.distance, down)
    parts = moved_parts(moved, joined.vertices, joined.faces, joined.part, skin.loose, deltas)
    deltas = parts.deltas
    still = torch.zeros(len(joined.vertices), dtype=torch.bool)
    if movable is not None:
        still[joined.of] = ~movable.cpu()
        deltas[:, still] = 0.0
    own = BlendshapeRig(Mesh(joined.vertices, joined.faces), deltas, moved.names)
    own = clear_parts(own, _among(inner_parts(own), parts.bones))
    deltas = own.deltas.double().masked_fill(still[:, None], 0.0)[:, joined.of]
    placed = registration.pose.apply_vectors(deltas).to(target.vertices)
    rig = BlendshapeRig(target, placed, moved.names)
    return CarriedShapes(
        rig, registration, moved, skin.distance[joined.of], skin.known[joined.of], parts.tongue[joined.of], left
    )


def _marks(rig: BlendshapeRig) -> Tensor:
    """iBUG's 68 of a rig, (68,3); NaN where it does not know them."""
    notes = rig.neutral.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != 68:
        return torch.full((68, 3), torch.nan, dtype=torch.float64)
    return rig.vertices.detach().cpu().double()[notes.landmarks.cpu()]


def _among(parts: InnerParts, bones: Tensor) -> InnerParts:
    """Those parts that are bone: lashes and shells of the eye stand before the skin by nature."""
    kept = bones[parts.vertices]
    group = parts.group[kept].unique(return_inverse=True)[1]
    return replace(parts, vertices=parts.vertices[kept], group=group, hard=parts.hard[kept])


def fitted_template(template: BlendshapeRig, registration: Registration) -> Mesh:
    """A registered template in its own place and size, its inner parts where they belong in this head."""
    vertices = registration.pose.inverse().apply(registration.mesh.vertices.detach().cpu().double())[0]
    fitted = template.neutral.with_vertices(vertices.to(template.vertices))
    fitted = place_parts(template, fitted, inner_parts(template))
    return with_template_skin(fitted, template.neutral, hidden_parts(template.neutral, registration.matched))


@dataclass(frozen=True, eq=False)
class JoinedMesh:
    """A mesh whose vertices in one place are one, unless they face apart.

    Args:
        vertices: (J,3) float64.
        faces: (F,3) of them.
        of: the joined vertex of each of the mesh's, (V,).
        part: connected part of each, (J,).
    """

    vertices: Tensor
    faces: Tensor
    of: Tensor
    part: Tensor


def joined_vertices(vertices: Tensor, faces: Tensor) -> JoinedMesh:
    """Joins the vertices that a file has split at seams; lips that touch, and lashes on a lid, stay apart.

    Args:
        vertices: (V,3), millimetres.
    """
    normals, seam = vertex_normals(vertices, faces), border_vertices(faces, len(vertices)).nonzero()[:, 0]
    near = cKDTree(vertices[seam].numpy()).query_pairs(_SAME_PLACE, output_type="ndarray")
    first, second = seam[torch.from_numpy(near)].T
    alike = (normals[first] * normals[second]).sum(-1) > _ALIKE
    pairs = torch.stack([first[alike], second[alike]])
    of = torch.from_numpy(_labels(pairs, len(vertices)))
    count = int(of.max()) + 1
    kept = torch.zeros(count, dtype=torch.int64)
    kept[of.flip(0)] = torch.arange(len(of)).flip(0)
    own = of[faces]
    along = torch.cat([own[:, [0, 1]], own[:, [1, 2]]]).T
    return JoinedMesh(vertices[kept], own, of, torch.from_numpy(_labels(along, count)))


def _labels(pairs: Tensor, count: int) -> np.ndarray:
    graph = sparse.coo_array((np.ones(pairs.shape[1]), (pairs[0].numpy(), pairs[1].numpy())), (count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Skin:
    """Where a head's vertices lie on the fitted template.

    Args:
        corner: template vertices around each place, (J,3).
        share: of each corner, (J,3).
        confidence: (J,).
        distance: (J,), millimetres.
        known: (J,) bool.
        loose: vertices of parts that are no skin, (J,) bool.
    """

    joined: JoinedMesh
    corner: Tensor
    share: Tensor
    confidence: Tensor
    distance: Tensor
    known: Tensor
    loose: Tensor

    @staticmethod
    def of(
        rig: BlendshapeRig, registration: Registration, joined: JoinedMesh, followed: TemplatePlaces | None = None
    ) -> _Skin:
        faces = rig.neutral.faces.cpu()
        label = torch.from_numpy(_labels(torch.cat([faces[:, [0, 1]], faces[:, [1, 2]]]).T, len(rig.vertices)))
        faces = faces[(label == label.bincount().argmax())[faces[:, 0]]]
        surface = rig.vertices.detach().cpu().double()
        normals = vertex_normals(joined.vertices, joined.faces)
        corner, share, distance, cosine = nearest_alike(surface, faces, joined.vertices, normals)
        beyond = (border_vertices(faces, len(surface))[corner] | (share < 1e-6)).all(1) & (distance > _NEAR / 4)
        seen = registration.matched.cpu().double().clamp(min=0.15)[corner]
        confidence = torch.exp(-((distance / _NEAR) ** 2)) * cosine.clamp(min=0) ** 2 * (seen * share).sum(1)
        confidence[beyond] *= _BLIND
        known = (confidence > 0.1) & ~beyond
        if followed is not None:
            rows = joined.of[followed.rows]
            near = cKDTree(joined.vertices[rows].numpy()).query(joined.vertices.numpy())[0] < _AT_LIPS
            confidence[torch.from_numpy(near)] *= _BLIND  # which of lips that touch it is, its place does not tell
            corner[rows, :2], share[rows, :2], share[rows, 2] = followed.corner, followed.share, 0.0
            confidence[rows], distance[rows], known[rows] = 1.0, 0.0, True
        part, area = joined.part, vertex_areas(joined.vertices, joined.faces)
        size = torch.zeros(int(part.max()) + 1, dtype=torch.float64).index_add_(0, part, area)
        near = torch.zeros_like(size).index_add_(0, part, area * known)
        body = (near > _SKIN_SHARE * size) & (near > _BODY_SHARE * near.max())
        body[near.argmax()] = True
        return _Skin(joined, corner, share, confidence, distance, known, ~body[part])

    def carried(self, deltas: Tensor) -> Tensor:
        """The template's deltas (N,T,3) at the head's vertices, (N,J,3); zero for loose parts."""
        vertices, faces = self.joined.vertices, self.joined.faces
        weight = vertex_areas(vertices, faces).clamp(min=1e-9) * self.confidence.clamp(min=_BLIND)
        guess = torch.einsum("njkc,jk->njc", deltas[:, self.corner], self.share)
        guess[:, self.distance > _FAR] = 0.0
        matrix = sparse.diags_array(weight.numpy()) + _SMOOTH**2 * stretching_energy(vertices, faces)
        rows = (guess * weight[:, None]).permute(1, 0, 2).flatten(1)
        moving = rows.abs().amax(0) > 0
        solved = torch.zeros_like(rows)
        if moving.any():
            solved[:, moving] = SparseCholesky(matrix).solve(rows[:, moving])
        solved[self.loose] = 0.0
        return solved.unflatten(1, (-1, 3)).permute(1, 0, 2).contiguous()


def nearest_alike(
    surface: Tensor, faces: Tensor, points: Tensor, normals: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The place on a surface nearest to each point in position and normal together.

    Args:
        surface: vertices (V,3), millimetres.
        points: (Q,3).
        normals: unit, (Q,3).

    Returns:
        The vertices around each place (Q,3) and their shares (Q,3), its distance (Q,) and the cosine of the normals.
    """
    a, b, c = corners(surface, faces)
    across = triangle_normals(surface, faces)
    samples = torch.cat([(a + b + c) / 3, _NORMAL_REACH * across], 1)
    tree = cKDTree(samples.numpy())
    count = min(_CANDIDATES, len(faces))
    found = torch.from_numpy(tree.query(torch.cat([points, _NORMAL_REACH * normals], 1).numpy(), count)[1])
    found = found.reshape(len(points), count)
    ab, ac, ap = (b - a)[found], (c - a)[found], points[:, None] - a[found]
    v, w = triangle_coordinates(
        ab.square().sum(-1), ac.square().sum(-1), (ab * ac).sum(-1), (ab * ap).sum(-1), (ac * ap).sum(-1)
    )
    offset = ap - v[..., None] * ab - w[..., None] * ac
    turned = (across[found] - normals[:, None]).square().sum(-1)
    best = (offset.square().sum(-1) + _NORMAL_REACH**2 * turned).argmin(1)
    row = torch.arange(len(points))
    v, w, triangle = v[row, best], w[row, best], found[row, best]
    smooth = vertex_normals(surface, faces)[faces[triangle]]
    share = torch.stack([1 - v - w, v, w], 1)
    cosine = (torch.nn.functional.normalize((smooth * share[..., None]).sum(1), dim=-1) * normals).sum(-1)
    return faces[triangle], share, offset[row, best].norm(dim=-1), cosine
