"""A template's blendshapes on a head of another topology, whose vertices keep their number and order."""

from dataclasses import dataclass, replace

import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import border_vertices, corners, triangle_normals, vertex_areas, vertex_normals
from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.geometry.meshes.surface_index import triangle_coordinates
from torchface.mesh import Mesh
from torchface.modeling.rigging.carried_shapes import CarriedShapes, marks_of
from torchface.modeling.rigging.deformation_transfer import transfer_with_report
from torchface.modeling.rigging.eyelid_closure import SkinOfHead, eyes_seen, lids_looking_down, shut_blinks
from torchface.modeling.rigging.joined_vertices import JoinedMesh, connected_labels, joined_vertices
from torchface.modeling.rigging.loose_parts import moved_parts
from torchface.modeling.rigging.part_clearance import clear_parts
from torchface.modeling.rigging.part_placement import place_parts
from torchface.modeling.rigging.penetration import InnerParts, inner_parts
from torchface.number_checks import checked_type
from torchface.optim.sparse import SparseCholesky
from torchface.progress import Progress, silent
from torchface.registration import Registration, hidden_parts, register, with_template_skin
from torchface.registration.scan_preparation import Landmarks
from torchface.rig import BlendshapeRig

_NORMAL_REACH = 6.0
"""A normal that points the other way counts as far as twice these millimetres: lips that touch stay apart."""
_CANDIDATES = 12
_NEAR, _FAR = 2.0, 20.0
_BLIND = 1e-3
"""How much the guess counts for a vertex that has no place on the template, beside one that has."""
_SMOOTH = 0.4
_SKIN_SHARE, _BODY_SHARE = 0.3, 0.15
_AT_LIPS = 1.5  # millimetres from the edge of lips that were cut


@dataclass(frozen=True, eq=False)
class TemplatePlaces:
    """Vertices of a head that follow known places of the template."""

    rows: Tensor  # of the head, (n,)
    corner: Tensor  # two vertices of the template for each, (n,2)
    share: Tensor  # how much of each, (n,2)

    @staticmethod
    def at(rows: Tensor, ids: Tensor) -> "TemplatePlaces":
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
    checked_type("template", template, BlendshapeRig)
    checked_type("target", target, Mesh)
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
    openings, down = eyes_seen(head, marks_of(moved)), lids_looking_down(template)
    deltas, left = shut_blinks(head, deltas, moved.names, openings, skin.distance, down)
    parts = moved_parts(moved, joined.vertices, joined.faces, joined.part, skin.loose, deltas, openings)
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
class _Skin:
    """Where a head's vertices lie on the fitted template."""

    joined: JoinedMesh
    corner: Tensor  # template vertices around each place, (J,3)
    share: Tensor  # of each corner, (J,3)
    confidence: Tensor  # (J,)
    distance: Tensor  # (J,), millimetres
    known: Tensor  # (J,) bool
    loose: Tensor  # vertices of parts that are no skin, (J,) bool

    @staticmethod
    def of(
        rig: BlendshapeRig, registration: Registration, joined: JoinedMesh, followed: TemplatePlaces | None = None
    ) -> "_Skin":
        faces = rig.neutral.faces.cpu()
        label = torch.from_numpy(connected_labels(torch.cat([faces[:, [0, 1]], faces[:, [1, 2]]]).T, len(rig.vertices)))
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
