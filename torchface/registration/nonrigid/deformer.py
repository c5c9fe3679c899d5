"""The template as it deforms: its stiffness, its levels, and one stage of Algorithm 1 after the other."""

import time
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import edges, triangle_areas
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.registration.nonrigid.correspondence import (
    Correspondences,
    correspondences,
    evenly_spread,
    exposed_vertices,
)
from torchface.registration.nonrigid.landmark_pull import LandmarkPull
from torchface.registration.nonrigid.linear_step import Contacts, Data, LinearStep
from torchface.registration.nonrigid.lip_contact import ContactPull
from torchface.registration.nonrigid.registration_record import StageRecord
from torchface.registration.nonrigid.schedule import Level, Schedule, Stage
from torchface.registration.nonrigid.subspace import Subspace, all_maps, graph, translations
from torchface.registration.nonrigid.unfolding import grown, turned_over, unfolded
from torchface.rendering.raycast import RayCaster

_AREA_OF_ONE = 10.0
_MAX_ATTEMPTS = 8
_SLIVER = 0.1


class Deformer:
    """A template on its way to a scan; vertices in ``hidden`` (V,) have no place there, and follow the others."""

    def __init__(
        self,
        vertices: Tensor,
        faces: Tensor,
        scan: SurfaceIndex,
        landmarks: LandmarkPull,
        contacts: ContactPull,
        schedule: Schedule,
    ) -> None:
        self.rest, self.faces, self._scan, self._landmarks = vertices, faces, scan, landmarks
        self._contacts, self._schedule = contacts, schedule
        self.maps = identity_maps(vertices)
        self.outward = exposed_vertices(vertices, faces, schedule.opening)
        self.exposed = self.outward.nonzero()[:, 0]
        area = triangle_areas(vertices, faces)
        self._sliver = area < _SLIVER * area.mean()
        # A correspondence stands for its share of the surface, so that the stiffness means the same at any resolution.
        self._area = float(area.sum())
        self._folded = torch.zeros(len(vertices), dtype=torch.bool)
        self.hidden = torch.zeros(len(vertices), dtype=torch.bool)

    @property
    def current(self) -> Tensor:
        """Where the vertices are, (V,3) float64."""
        return positions(self.maps)

    @cached_property
    def _stiffness(self) -> sparse.csr_array:
        return stiffness_rows(self.rest, self.faces, self._schedule.gradient_length)

    @cached_property
    def _graph(self) -> Subspace:
        pairs = linked_edges(self.rest, self.faces)
        return graph(self.rest.numpy(), pairs, self._stiffness, self._schedule.nodes)

    @cached_property
    def _spaces(self) -> dict[Level, Subspace]:
        return {Level.TRANSLATIONS: translations(self._stiffness), Level.VERTICES: all_maps(self._stiffness)}

    def run(self, stage: Stage, number: int) -> StageRecord:
        """One stage: correspondences and linear steps in turn, until ‖ΔX‖ < ε.

        Where triangles turn over, as in an ear that hair covers, the correspondences and landmarks around them are
        dropped from here on and the stage starts again. Slivers, which turn at the least motion, are left to
        ``unfold``.
        """
        begin, start = time.perf_counter(), self.maps
        space = self._graph if stage.level is Level.GRAPH else self._spaces[stage.level]
        vertices = self.exposed
        if stage.samples is not None:
            vertices = evenly_spread(self.rest, vertices, stage.samples)
        record = self._attempt(stage, number, space, vertices)
        for circle in range(1, _MAX_ATTEMPTS):  # in widening circles, until nothing turns over
            folded = self.folded_triangles() & ~self._sliver
            if not folded.any():
                break
            around = torch.zeros(len(self.rest), dtype=torch.bool)
            around[self.faces[folded].flatten()] = True
            self._folded |= grown(around, self.faces, circle)
            self.maps = start
            record = self._attempt(stage, number, space, vertices)
        return replace(record, seconds=time.perf_counter() - begin)

    def _attempt(self, stage: Stage, number: int, space: Subspace, vertices: Tensor) -> StageRecord:
        held = ~self._folded[self._landmarks.vertices]
        pull = self._landmarks.subset(held)
        step = LinearStep(
            space,
            vertices.numpy(),
            pull.vertices.numpy(),
            stage.stiffness,
            stage.landmark_weight,
            self._schedule.sliding,
            self._held_together(stage),
            pull.weights(self.current, stage.level is Level.TRANSLATIONS).numpy(),
        )
        energies, moved, made = [], float("inf"), 0
        while made < stage.iterations and moved >= stage.tolerance:
            pairs = self._correspondences(vertices, stage)
            data = self._data(pairs, pull)
            before, place = step.energy(self.maps, data), self.current
            self.maps = step.minimise(self.maps, data)
            energies.append((before, step.energy(self.maps, data)))
            moved = float((self.current - place).norm(dim=-1).mean())
            made += 1
        used = (pairs.weights > 0) & ~(self._folded | self.hidden)[vertices]
        return StageRecord(
            f"{number} {stage.level.value}",
            stage.stiffness,
            made,
            moved,
            float(pairs.distance[used].mean()),
            self._landmark_distance(),
            int(used.sum()),
            {
                **pairs.dropped,
                "fold": int((self._folded[vertices] & (pairs.weights > 0)).sum()),
                "hidden": int(((self.hidden & ~self._folded)[vertices] & (pairs.weights > 0)).sum()),
            },
            tuple(energies),
            0.0,
        )

    def folded_triangles(self) -> Tensor:
        """Mask (F,) of the triangles that have turned by more than 90° since the template was aligned with the scan."""
        return turned_over(self.rest, self.current, self.faces)

    def unfold(self) -> None:
        """Turns back what triangles are still turned over."""
        self.lay(unfolded(self.rest, self.current, self.faces))

    def lay(self, vertices: Tensor) -> None:
        """Sets the positions of the vertices (V,3)."""
        maps = self.maps.copy()
        maps[3::4] = vertices.numpy()
        self.maps = maps

    def _correspondences(self, vertices: Tensor, stage: Stage) -> Correspondences:
        pairs = correspondences(
            self.current, self.faces, vertices, self._scan, stage.reach, self._schedule.largest_angle
        )
        if not (pairs.weights > 0).any():
            reasons = ", ".join(f"{count} for {reason}" for reason, count in pairs.dropped.items())
            raise ValueRangeError(
                f"register: none of {len(vertices)} correspondences stands the tests (dropped: {reasons}); "
                "expected the scan to show the template's face where the landmarks or its shape lay it"
            )
        return pairs

    def _held_together(self, stage: Stage) -> Contacts | None:
        if stage.contact_weight == 0 or not len(self._contacts.pairs):
            return None
        weights = stage.contact_weight**2 * self._contacts.weights(self.current, self._scan, self._caster)
        return Contacts(self._contacts.pairs.numpy(), self._contacts.offsets.numpy(), weights.numpy())

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster(self._scan.vertices, self._scan.faces)

    def _data(self, found: Correspondences, pull: LandmarkPull) -> Data:
        share = self._area / _AREA_OF_ONE / max(len(found.vertices), 1)
        left_out = (self._folded | self.hidden)[found.vertices]
        weights = (share * found.weights).masked_fill(left_out, 0.0)
        return Data(found.points.numpy(), found.normals.numpy(), weights.numpy(), pull.points.numpy())

    def _landmark_distance(self) -> float:
        left = self.current[self._landmarks.vertices] - self._landmarks.points
        return float(left.square().sum(-1).mean().sqrt())


_BRIDGES = 8


def linked_edges(vertices: Tensor, faces: Tensor) -> NDArray[np.int64]:
    """The mesh's edges, and bridges from each smaller part to what is nearest of the rest, (E,2).

    An eyeball or a tooth shares no vertex with the face; bridges make it follow the face's motion.
    """
    pairs = edges(faces).numpy()
    count = len(vertices)
    while True:  # each turn at least halves the number of parts
        graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        parts, label = connected_components(graph, directed=False)
        if parts == 1:
            return pairs
        pairs = np.unique(np.sort(np.vstack([pairs, _bridges(vertices.double().numpy(), label)]), axis=1), axis=0)


def _bridges(points: NDArray[np.float64], label: NDArray[np.int32]) -> NDArray[np.int64]:
    """From each part but the largest, its vertices nearest to the rest, each with its nearest there."""
    sizes = np.bincount(label)
    edges = []
    for part in np.flatnonzero(np.arange(len(sizes)) != sizes.argmax()):  # a part a turn: they are tens
        own, rest = np.flatnonzero(label == part), np.flatnonzero(label != part)
        distance, nearest = cKDTree(points[rest]).query(points[own])
        chosen = np.argsort(distance, kind="stable")[:_BRIDGES]
        edges.append(np.stack([own[chosen], rest[nearest[chosen]]], axis=1))
    return np.concatenate(edges)


def stiffness_rows(vertices: Tensor, faces: Tensor, gradient_length: float) -> sparse.csr_array:
    r"""The matrix :math:`M \otimes G`, (4E,4V), that turns affine maps into their differences along edges.

    .. math:: \lVert (M \otimes G) X \rVert^2 = \sum_{(i,j)} \Big(\frac{\bar\ell}{\ell_{ij}}\Big)^2
        \lVert G\,(X_i - X_j)|_{m_{ij}} \rVert_F^2, \qquad G = \mathrm{diag}(g,g,g,1)

    Each map is written about its own vertex, :math:`v \mapsto A_i (v - v_i) + p_i`, with rows
    :math:`X_i = (A_i^\top, p_i)`, so that ``D X`` is simply the positions :math:`p`. The translation part of a
    difference is where the two maps send the middle :math:`m_{ij}` of the edge, which makes the energy the same
    wherever the origin lies, and zero for every affine motion of the whole.

    Source: Amberg, Romdhani, Vetter 2007, equations 3 and 10; thesis 3.2.3, equation 5.
    """
    pairs = linked_edges(vertices.detach().cpu(), faces.detach().cpu())
    points = vertices.detach().cpu().double().numpy()
    span = points[pairs[:, 1]] - points[pairs[:, 0]]
    length = np.linalg.norm(span, axis=1)
    length = np.maximum(length, 1e-3 * length.mean() + 1e-12)
    weight = length.mean() / length
    count, edge = len(pairs), np.arange(len(pairs))
    rows, columns, values = [], [], []
    for end, sign in ((0, -1.0), (1, 1.0)):
        first = 4 * pairs[:, end]
        for k in range(3):
            rows += [k * count + edge, 3 * count + edge]
            columns += [first + k, first + k]
            values += [sign * gradient_length * weight, -0.5 * weight * span[:, k]]
        rows.append(3 * count + edge)
        columns.append(first + 3)
        values.append(sign * weight)
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(triplets, shape=(4 * count, 4 * len(points)))


def identity_maps(vertices: Tensor) -> NDArray[np.float64]:
    """The maps X (4V,3) that leave every vertex where it is."""
    maps = np.zeros((len(vertices), 4, 3))
    maps[:, :3] = np.eye(3)
    maps[:, 3] = vertices.detach().cpu().double().numpy()
    return maps.reshape(-1, 3)


def positions(maps: NDArray[np.float64]) -> Tensor:
    """Where the maps X (4V,3) send their vertices, (V,3) float64."""
    return torch.from_numpy(maps[3::4].copy())
