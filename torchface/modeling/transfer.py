"""A template's blendshapes on a new face, by deformation transfer."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import TopologyError, ValueRangeError
from torchface.geometry.alignment import Similarity, similarity_transform
from torchface.geometry.deformation import degenerate_triangles, triangle_frames
from torchface.geometry.operators import vertex_normals
from torchface.geometry.reconstruction import GradientReconstruction, SoftConstraints, offset_constraints
from torchface.mesh import Mesh
from torchface.modeling.contact import ContactPairs
from torchface.modeling.parts import PartLinks, part_links
from torchface.modeling.seams import Seams, find_seams
from torchface.rig import BlendshapeRig

STILL = 0.01
"""A vertex that a shape moves by less, in millimetres, is pinned in the transferred shape: it moves as much."""

CONTACT_WEIGHT = 30.0
"""Weight of a contact pair beside the squared gradient error of one triangle, a square millimetre."""

_LINK_WEIGHT = 100.0
_LINK_TOLERANCE = 0.02
_CONTACT_FADE = 4.0


@dataclass(frozen=True, eq=False)
class TransferReport:
    """What a transfer found on its way.

    Args:
        similarity: the global similarity from the source's neutral to the target, taken out first and put back.
        flat_source: triangles without area in the source's neutral, (K,); they prescribe nothing.
        flat_target: triangles without area in the target, (K,); they are prescribed nothing.
        flat_shapes: by shape name, triangles that lose their area in the source's shape; their edges still count.
        contacts: by shape name, how many contact pairs were asked to keep their gap.
        undoes: by the name of a shape that only makes sense on top of another, the name of that other.
    """

    similarity: Similarity
    flat_source: Tensor
    flat_target: Tensor
    flat_shapes: dict[str, Tensor]
    contacts: dict[str, int]
    undoes: dict[str, str]

    def summary(self) -> str:
        """One line on triangles without area; empty where there are none."""
        found = [
            f"{len(ids)} in the {what}"
            for what, ids in (("source's neutral", self.flat_source), ("target", self.flat_target))
            if len(ids)
        ]
        found += [f"{len(ids)} in {name}" for name, ids in self.flat_shapes.items()]
        return f"triangles without area: {', '.join(found)}" if found else ""


@dataclass(frozen=True, eq=False)
class TransferredRig:
    """A transferred rig and the report of how it came about."""

    rig: BlendshapeRig
    report: TransferReport


def transfer_deformation(
    source: BlendshapeRig,
    target: Mesh,
    contact_weight: float = CONTACT_WEIGHT,
    progress: Callable[[int, int], None] | None = None,
) -> BlendshapeRig:
    r"""Gives a new face the shapes of a template rig.

    .. math:: \min_{\tilde x} \sum_t \lVert S_t - T_t(\tilde x) \rVert_F^2

    for each shape, with the source's gradients S. The global similarity between the faces is removed first and carried
    by the deltas, so that a turned or scaled target has turned or scaled shapes. Vertices that a shape leaves still
    are pinned. Parts of a head that are not connected to the face (teeth, eyes, lashes) keep what offset to it they
    keep in the source. Lids close and lips meet as the source's do.

    Args:
        source: the template: N shapes, V vertices, millimetres.
        target: the new neutral, of the same topology, millimetres.
        contact_weight: how firmly lids and lips keep their gap; 0 leaves that out.
        progress: called with (shapes done, N).

    Returns:
        A rig of ``target`` with the source's names; solved in float64 on the CPU. Triangles without area are
        survived with a warning; ``transfer_with_report`` gives the details.

    Raises:
        TopologyError: source and target have other triangles, or none.
        ValueRangeError: the source has no shapes, the target has collapsed, or the weight is negative.

    Source: thesis 3.3.1; Sumner and Popovic 2004.
    """
    transferred = transfer_with_report(source, target, contact_weight, progress)
    if summary := transferred.report.summary():
        warnings.warn(f"transfer_deformation: {summary}", stacklevel=2)
    return transferred.rig


def transfer_with_report(
    source: BlendshapeRig,
    target: Mesh,
    contact_weight: float = CONTACT_WEIGHT,
    progress: Callable[[int, int], None] | None = None,
) -> TransferredRig:
    """The same as ``transfer_deformation``, with a report in place of a warning."""
    _check(source, target, contact_weight)
    job = _Transfer(source, target, contact_weight)
    moved = torch.zeros_like(job.deltas)
    done = 0
    for group in job.groups():  # a loop over factorisations: shapes that move other vertices need another
        moved[group] = job.solve(group, moved)
        done += len(group)
        if progress is not None:
            progress(done, len(moved))
    neutral = target.to(source.deltas.device)
    deltas = job.similarity.apply_vectors(moved).to(neutral.vertices)
    return TransferredRig(BlendshapeRig(neutral, deltas, source.names), job.report(source.names))


class _Transfer:
    """One source and one target, the latter brought to the source's place and size."""

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

    def solve(self, group: list[int], moved: Tensor) -> Tensor:
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
            fade = 1 / (1 + change.square().sum(-1) / _CONTACT_FADE**2) if below is None else torch.ones(len(pairs))
            offsets = self.goal[first] - self.goal[second] + change + self.closed_gaps.extra(moves, change)
            constraints.append(offset_constraints(pairs, offsets, self.contact_weight * fade, len(pose)))
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

    def report(self, names: tuple[str, ...]) -> TransferReport:
        return TransferReport(
            self.similarity,
            self.flat.nonzero()[:, 0],
            self.flat_target.nonzero()[:, 0],
            {name: ids for name, ids in zip(names, self.flat_shapes, strict=True) if len(ids)},
            dict(zip(names, self.contacts, strict=True)),
            {names[shape]: names[other] for shape, other in self.seams.undoes.items()},
        )


@dataclass(frozen=True, eq=False)
class _ClosedGaps:
    """Gaps at rest along closed seams: the source's (K,), how much wider the target's is (K,), and normals (K,3)."""

    gap: Tensor
    wider: Tensor
    source_across: Tensor
    target_across: Tensor

    def extra(self, rows: Tensor, change: Tensor) -> Tensor:
        """How much more the target has to close, (K,3), by the share of the source's gap that a change closes."""
        closed = ((change * self.source_across[rows]).sum(-1) / self.gap[rows].clamp(min=0.1)).clamp(0, 1)
        return self.target_across[rows] * (closed * self.wider[rows])[:, None]


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
    similarity = similarity_transform(source[None], target[None])
    size = float((target - target.mean(0)).square().sum(-1).mean().sqrt())
    if not size > 0 or not float(similarity.scale[0]) > 1e-6:
        raise ValueRangeError(f"transfer_deformation: the target measures {size:.3g} mm across; expected a face")
    return similarity


def _check(source: BlendshapeRig, target: Mesh, contact_weight: float) -> None:
    if len(source.names) == 0:
        raise ValueRangeError("transfer_deformation: the source rig has 0 shapes; expected at least one")
    if len(source.neutral.faces) == 0:
        raise TopologyError("transfer_deformation: the source rig has no triangles; expected a mesh")
    if source.neutral.fingerprint() != target.fingerprint():
        raise TopologyError(
            f"transfer_deformation: found a target of {len(target.vertices)} vertices and {len(target.faces)} "
            f"triangles ({target.fingerprint()}), expected the source's topology of {len(source.neutral.vertices)} "
            f"vertices and {len(source.neutral.faces)} triangles ({source.neutral.fingerprint()})"
        )
    for what, vertices in (("source", source.vertices), ("target", target.vertices)):
        if not torch.isfinite(vertices).all():
            raise ValueRangeError(f"transfer_deformation: found NaN or infinite vertices in the {what}; expected none")
    if not 0 <= contact_weight < float("inf"):
        raise ValueRangeError(f"contact_weight: found {contact_weight}, expected a finite number of at least 0")
