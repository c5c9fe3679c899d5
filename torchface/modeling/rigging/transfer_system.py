"""One template and one target, and how each shape's gradients become vertices: pins, ties between parts, contacts."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.correctives.corrective_shapes import Correctives
from torchface.errors import ValueRangeError
from torchface.geometry.meshes.contact import ContactPairs
from torchface.geometry.meshes.deformation import degenerate_triangles, triangle_frames
from torchface.geometry.meshes.gradient_reconstruction import (
    GradientReconstruction,
    PreparedReconstruction,
    SoftConstraints,
    offset_constraints,
)
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.modeling.rigging.lid_and_lip_closing import Seams, find_seams
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig

STILL = 0.01
"""A vertex that a shape moves by less, in millimetres, is pinned in the transferred shape: it moves as much."""

_LINK_WEIGHT = 100.0
_LINK_TOLERANCE = 0.02
_CONTACT_DECAY = 4.0
_TOUCHING = 0.3  # millimetres between lips that touch at rest, and by which they close at most
_NEAREST = 16  # vertices


class ShapeTransfer:
    """One source and one target, the latter brought to the source's place and size.

    Args:
        target: the new neutral, of the same topology.
        contact_weight: how firmly lids and lips keep their gap; 0 leaves that out.
    """

    def __init__(self, source: BlendshapeRig, target: Mesh, contact_weight: float) -> None:
        self.rest = source.neutral.vertices.detach().double().cpu()
        self.deltas = source.deltas.detach().double().cpu()
        self.faces = source.neutral.faces.cpu()
        self.contact_weight = contact_weight
        goal = target.vertices.detach().double().cpu()
        self.similarity = _similarity(self.rest, goal)
        self.goal = self.similarity.inverse().apply(goal[None])[0]
        self.moving = self.deltas.norm(dim=-1) > STILL
        self.flat = degenerate_triangles(self.rest, self.faces)
        self.flat_target = degenerate_triangles(self.goal, self.faces)
        identity = torch.eye(3, dtype=torch.float64)
        frames = torch.where(self.flat[:, None, None], identity, triangle_frames(self.rest, self.faces))
        self.inverse_frames = torch.linalg.inv(frames)
        self.reconstruction = GradientReconstruction(self.goal, self.faces, (~self.flat).double())
        self.links: PartLinks = part_links(source.neutral)
        self.seams = find_seams(source, self.moving) if contact_weight > 0 else _no_seams(len(self.deltas))
        self.closed_gaps = _closed_gaps(self.rest, self.goal, self.faces, self.seams.closed)
        self.contacts = [0] * len(self.deltas)
        self.flat_shapes: list[Tensor] = [torch.zeros(0, dtype=torch.int64)] * len(self.deltas)

    def groups(self) -> list[list[int]]:
        """Shapes that can share a factorisation: the same pins and no ties or contacts of their own."""
        tied = torch.cat([self.links.pairs, self.seams.closed])
        together: dict[object, list[int]] = {}
        # A shape that undoes another is solved on top of the other's result, hence later.
        for shape in sorted(range(len(self.deltas)), key=lambda shape: shape in self.seams.undoes):
            moving = self.moving[shape]
            alone = bool(moving[tied].any()) or len(self.seams.closing[shape].pairs) > 0
            together.setdefault(shape if alone else moving.numpy().tobytes(), []).append(shape)
        return list(together.values())

    def transfer(self, progress: Progress | None = None) -> Tensor:
        """How far each vertex goes in every shape, (N,V,3), in the source's frame."""
        progress = progress or silent
        moved = torch.zeros_like(self.deltas)
        done = 0
        for group in self.groups():  # a loop over factorisations: shapes that move other vertices need another
            moved[group] = self._solve(group, moved)
            done += len(group)
            progress("copying the template's expressions to the head", done, len(moved))
        return moved

    def follower(self, shape: int) -> "Follower":
        """What lets this shape, and those that share its group, go further than the transfer took them."""
        below = self.seams.undoes.get(shape)
        pose = self.rest + self.deltas[shape] + (0 if below is None else self.deltas[below])
        asked = [*self._link_constraints(shape, self.goal), *self._contact_constraints(shape, pose, below)]
        return Follower(
            [constraint.matrix for constraint in asked], self.reconstruction.prepare(~self.moving[shape], asked)
        )

    def correctives(self, source: BlendshapeRig, progress: Progress | None = None) -> Correctives | None:
        r"""The source's correctives on the target, in the source's frame.

        A corrective is transferred as what it adds to the gradients of the pose in which its drivers are fully on,
        :math:`S_t(P + D) - S_t(P)`, with the source's shapes and other correctives in the pose P. So it stays as local
        as it is, and one of no effect has none.
        """
        correctives, activation = source.correctives, source.activation
        if correctives is None or activation is None:
            return None
        progress = progress or silent
        added = correctives.deltas.detach().double().cpu()
        row = {name: i for i, name in enumerate(source.names)}
        weights = torch.zeros(len(added), len(row), dtype=torch.float64)
        for i, definition in enumerate(correctives.definitions):
            weights[i, [row[driver] for driver in definition.drivers]] = definition.peak or 1.0
        on = copy.deepcopy(activation).cpu()(weights)
        moved = torch.zeros_like(added)
        for i, delta in enumerate(added):  # each moves other vertices, hence is a system of its own
            pose = self.rest + torch.tensordot(weights[i], self.deltas, 1) + torch.tensordot(on[i], added, 1) - delta
            moved[i] = self._added(pose, delta)
            progress("copying the template's correctives to the head", i + 1, len(added))
        return correctives.with_deltas(moved)

    def rig(
        self, source: BlendshapeRig, target: Mesh, moved: Tensor, correctives: Correctives | None = None
    ) -> BlendshapeRig:
        """The target's rig with deltas (N,V,3), and correctives, that were solved in the source's frame."""
        neutral = target.to(source.deltas.device)
        if correctives is not None:
            placed = self.similarity.apply_vectors(correctives.deltas).to(neutral.vertices)
            correctives = correctives.with_deltas(placed)
        deltas = self.similarity.apply_vectors(moved).to(neutral.vertices)
        return BlendshapeRig(neutral, deltas, source.names, correctives)

    def _added(self, pose: Tensor, delta: Tensor) -> Tensor:
        """What a displacement (V,3) of a pose of the source (V,3) becomes on the target, (V,3)."""
        moving = delta.norm(dim=-1) > STILL
        active = moving[self.faces].any(1) & ~self.flat
        faces = self.faces[active]
        gradients = torch.zeros(1, len(self.faces), 3, 3, dtype=torch.float64)
        change = triangle_frames(pose + delta, faces) - triangle_frames(pose, faces)
        gradients[0, active] = change @ self.inverse_frames[active]
        strengths = self.links.strength(delta, _LINK_TOLERANCE), torch.ones(len(self.seams.closed), dtype=torch.float64)
        constraints = []
        for pairs, weight, strength in zip(
            (self.links.pairs, self.seams.closed), (_LINK_WEIGHT, self.contact_weight), strengths, strict=True
        ):
            moves = moving[pairs].any(1)
            if bool(moves.any()):
                first, second = pairs[moves].T
                offsets = delta[first] - delta[second]
                constraints.append(offset_constraints(pairs[moves], offsets, weight * strength[moves], len(delta)))
        return self.reconstruction.solve(gradients, delta[None], ~moving, constraints)[0]

    def _solve(self, group: list[int], moved: Tensor) -> Tensor:
        """How far each vertex goes in the shapes of a group, (G,V,3), in the source's frame."""
        first = group[0]
        below = self.seams.undoes.get(first)
        source_base = self.rest if below is None else self.rest + self.deltas[below]
        base = self.goal if below is None else self.goal + moved[below]
        poses = source_base + self.deltas[group]
        gradients = torch.stack([self._gradients(shape, pose) for shape, pose in zip(group, poses, strict=True)])
        constraints = [*self._link_constraints(first, base), *self._contact_constraints(first, poses[0], below)]
        positions = base + self.deltas[group]
        return self.reconstruction.solve(gradients, positions, ~self.moving[first], constraints) - base

    def _gradients(self, shape: int, pose: Tensor) -> Tensor:
        """The source's gradients (F,3,3); triangles of which no corner moves are not looked at."""
        active = self.moving[shape][self.faces].any(1) & ~self.flat
        faces = self.faces[active]
        self.flat_shapes[shape] = active.nonzero()[:, 0][degenerate_triangles(pose, faces)]
        gradients = torch.eye(3, dtype=torch.float64).repeat(len(self.faces), 1, 1)
        gradients[active] = triangle_frames(pose, faces) @ self.inverse_frames[active]
        return gradients

    def _link_constraints(self, shape: int, base: Tensor) -> list[SoftConstraints]:
        delta = self.deltas[shape]
        moves = self.moving[shape][self.links.pairs].any(1)
        pairs = self.links.pairs[moves]
        if len(pairs) == 0:
            return []
        part, host = pairs.T
        strength = self.links.strength(delta, _LINK_TOLERANCE)[moves]
        offsets = base[part] - base[host] + delta[part] - delta[host]
        return [offset_constraints(pairs, offsets, _LINK_WEIGHT * strength, len(base))]

    def _contact_constraints(self, shape: int, pose: Tensor, below: int | None) -> list[SoftConstraints]:
        constraints = []
        moving = self.moving[shape]
        moves = moving[self.seams.closed].any(1)
        pairs = self.seams.closed[moves]
        if len(pairs):
            first, second = pairs.T
            moved = pose - self.rest
            change = moved[first] - moved[second]
            # Lips that go far apart are no longer in contact: how far is the target's own affair.
            decay = 1 / (1 + change.square().sum(-1) / _CONTACT_DECAY**2) if below is None else torch.ones(len(pairs))
            offsets = self.goal[first] - self.goal[second] + change + self.closed_gaps.extra(moves, change)
            constraints.append(offset_constraints(pairs, offsets, self.contact_weight * decay, len(pose)))
        closing = self.seams.closing[shape]
        if len(closing.pairs) and below is None:
            first, second = closing.pairs.T
            at_rest, in_pose = self.rest[first] - self.rest[second], pose[first] - pose[second]
            own = self.goal[first] - self.goal[second]
            # What hardly closes keeps the target's own gap; what closes takes the source's.
            open_share = (in_pose.norm(dim=-1) / at_rest.norm(dim=-1).clamp(min=1e-9)).clamp(max=1) ** 3
            offsets = in_pose + open_share[:, None] * (own - at_rest)
            weights = self.contact_weight * closing.closeness
            constraints.append(offset_constraints(closing.pairs, offsets, weights, len(pose)))
        self.contacts[shape] = sum(len(constraint.values) for constraint in constraints)
        return constraints


@dataclass(frozen=True, eq=False)
class Follower:
    """How far vertices go beyond their transferred places where gradients ask for more.

    The transfer's energy is quadratic: what is added to its gradients adds to its solution. Pins stay.
    """

    matrices: list[sparse.csr_array]  # of ties and contacts, each (K,V): what they measure may change too
    system: PreparedReconstruction  # factored once, for the iterations to come

    def follow(self, gradients: Tensor, values: Sequence[Tensor]) -> Tensor:
        """Displacements (G,V,3), mm, where ``gradients`` (G,F,3,3) are added to the target's and ``values`` (G,K,3)
        to what the matrices measure."""
        none = torch.zeros(len(gradients), self.system.vertex_count, 3, dtype=torch.float64)
        return self.system.solve(gradients, none, values)


@dataclass(frozen=True, eq=False)
class _ClosedGaps:
    """Gaps at rest along closed seams: the source's (K,), how much wider the target's is (K,), and normals (K,3)."""

    gap: Tensor
    wider: Tensor
    source_across: Tensor
    target_across: Tensor

    def extra(self, rows: Tensor, change: Tensor) -> Tensor:
        """How much more the target has to close, (K,3), by the share of the source's gap that a change closes.

        Where lips touch at rest the target's close by a little at most, however they press: lips apart stay apart.
        """
        closed = ((change * self.source_across[rows]).sum(-1) / self.gap[rows].clamp(min=_TOUCHING)).clamp(0, 1)
        wider = self.wider[rows]
        wider = torch.where(self.gap[rows] < _TOUCHING, wider.clamp(max=_TOUCHING), wider)
        return self.target_across[rows] * (closed * wider)[:, None]


def _closed_gaps(rest: Tensor, goal: Tensor, faces: Tensor, pairs: Tensor) -> _ClosedGaps:
    first, second = pairs.T
    across, gaps = [], []
    for vertices in (rest, goal):
        normals = vertex_normals(vertices, faces)
        across.append(torch.nn.functional.normalize(normals[first] - normals[second], dim=-1))
        gaps.append(((vertices[second] - vertices[first]) * across[-1]).sum(-1))
    return _ClosedGaps(gaps[0], (gaps[1] - gaps[0]).clamp(min=0), across[0], across[1])


def _no_seams(count: int) -> Seams:
    none = torch.zeros(0, 2, dtype=torch.int64)
    return Seams(none, [ContactPairs(none, torch.zeros(0, dtype=torch.float64))] * count, {})


def _similarity(source: Tensor, target: Tensor) -> Similarity:
    size = float((target - target.mean(0)).square().sum(-1).mean().sqrt())
    similarity = similarity_transform(source[None], target[None]) if size > 0 else None
    if similarity is None or not float(similarity.scale[0]) > 1e-6:
        raise ValueRangeError(f"transfer_deformation: the target measures {size:.3g} mm across; expected a face")
    return similarity


@dataclass(frozen=True, eq=False)
class PartLinks:
    """Ties between a mesh's connected parts."""

    pairs: Tensor  # a vertex of a part and one that it may hang on, (K,2) int64
    part: Tensor  # the connected part of every vertex, (V,) int64

    def strength(self, deltas: Tensor, tolerance: float) -> Tensor:
        r"""How firmly each tie holds in a shape, (K,), from 1 (the offset is kept) toward 0 (it changes).

        .. math:: 1 / (1 + \lVert \delta_a - \delta_b \rVert^2 / \tau^2)

        It never gets to 0: a part that follows nothing exactly still follows what it follows best.

        Args:
            deltas: the shape's deltas, (V,3), millimetres.
            tolerance: :math:`\tau`, millimetres.
        """
        change = deltas[self.pairs[:, 0]] - deltas[self.pairs[:, 1]]
        return 1 / (1 + change.square().sum(-1) / tolerance**2)


def part_links(mesh: Mesh) -> PartLinks:
    """Ties every vertex outside the largest part to its nearest vertex there, and to its nearest in any other part."""
    part = components(mesh.faces.cpu(), len(mesh.vertices))
    labels, points = part.numpy(), mesh.vertices.detach().double().cpu().numpy()
    sizes = np.bincount(labels)
    if len(sizes) == 1:
        return PartLinks(torch.zeros(0, 2, dtype=torch.int64), part)
    body = np.flatnonzero(labels == sizes.argmax())
    rest = np.flatnonzero(labels != sizes.argmax())
    pairs = [np.stack([rest, body[cKDTree(points[body]).query(points[rest])[1]]], axis=1)]
    # Lashes and hair are hundreds of small parts, whose vertices have others among the nearest few.
    near = rest[cKDTree(points[rest]).query(points[rest], range(1, min(_NEAREST, len(rest)) + 1))[1]]
    other = labels[near] != labels[rest, None]
    found = other.any(1)
    pairs.append(np.stack([rest[found], near[found, other[found].argmax(1)]], axis=1))
    left = rest[~found]
    for label in np.unique(labels[left]):  # a large part, with a tree of its own to leave out
        own, others = left[labels[left] == label], rest[labels[rest] != label]
        if len(others) == 0:
            continue
        distance, nearest = cKDTree(points[others]).query(points[own])
        pairs.append(np.stack([own, others[nearest]], axis=1)[np.isfinite(distance)])
    return PartLinks(torch.from_numpy(np.concatenate(pairs)), part)
