"""Mask of a photographed head's skin: neither hair nor clothes, nor what stands behind a misplaced ear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.modeling.photographs.landmark_view import JAW, LANDMARKS
from torchface.rendering.camera_visibility import Shown

_FEATURES = 0.10
_SURELY_SKIN = 0.75
_NECK, _BEHIND = (0.05, 0.35), (0.05, 0.30)
_FOREHEAD = 0.15
"""In distances between the eyes' outer corners, but for the second row: shares of the way to the face's outline."""
_OVER_BROWS = 0.03
_ALIKE, _UNLIKE = 1.8, 2.8
# Of skin: of brightness, of two ratios of channels.
_MIN_DEVIATIONS, _MAX_DEVIATIONS = (0.25, 0.06, 0.06), (0.45, 0.14, 0.14)
_SQUARE, _MIN_VERTICES, _AROUND = 0.35, 30, 60
_ITERATIONS = 4


@dataclass(frozen=True, eq=False)
class FacePlaces:
    """Where vertices lie beside a face's landmarks; lengths in distances between the outer corners of the eyes.

    Args:
        out: the way from the face's middle to its outline (jaw, and over the brows), seen from the front, (V,); 1 is
            on it.
        beyond: length beyond that outline, (V,); negative inside.
        place: right, up and forward of the point between the eyes, (V,3).
        features: near eyes, brows, nostrils or mouth, which are no skin and yet the person's, (V,) bool.
        behind: length behind the ears' landmarks, (V,).
        chin: the chin's place, (3,).
        brows: how high the brows are.
        ears: how far forward the ears' landmarks lie.
    """

    out: Tensor
    beyond: Tensor
    place: Tensor
    features: Tensor
    behind: Tensor
    chin: Tensor
    brows: float
    ears: float

    @property
    def cheeks(self) -> Tensor:
        """Vertices that are surely skin, unless something hides them: no feature, and below the brows, (V,) bool."""
        return (self.out < _SURELY_SKIN) & ~self.features & (self.place[:, 1] < self.brows)

    @staticmethod
    def of(mesh: Mesh) -> FacePlaces:
        """Those of a mesh with the 68 landmarks."""
        vertices = mesh.vertices.detach().cpu().double()
        marks = vertices[mesh.landmarks.cpu()]
        unit = (marks[45] - marks[36]).norm()
        across = (marks[45] - marks[36]) / unit
        up = marks[27] - marks[8]
        up = torch.nn.functional.normalize(up - (up @ across) * across, dim=0)
        frame = torch.stack([across, up, torch.linalg.cross(across, up)]) / unit
        place, at = (vertices - marks[[36, 45]].mean(0)) @ frame.T, (marks - marks[[36, 45]].mean(0)) @ frame.T
        brow = at[17:27].flip(0).clone()
        brow[:, 1] += _FOREHEAD
        outline = torch.cat([at[:JAW], brow])[:, :2]
        middle = at[[27, 33, 36, 45, 48, 54], :2].mean(0)
        offsets = place[:, :2] - middle
        reach = _radius(outline - middle, torch.atan2(offsets[:, 1], offsets[:, 0]))
        length = offsets.norm(dim=1)
        features = torch.cdist(place, torch.cat([at[JAW:27], at[31:LANDMARKS]])).amin(1) < _FEATURES
        ears, brows = float(at[[0, 16], 2].mean()), float(at[17:27, 1].mean())
        return FacePlaces(length / reach, length - reach, place, features, ears - place[:, 2], at[8], brows, ears)


def skin_shares(shown: Sequence[Shown], places: Sequence[FacePlaces], faces: Tensor) -> Tensor:
    """How far photographs show skin, or a feature of the face, at each vertex, (I,V) in [0,1].

    Inside the face's outline, up to the brows, everything is the person's. Around it counts what resembles the cheeks
    nearby, in brightness and in the ratios of the channels; far below the chin and behind the ears nothing does.

    Args:
        shown: the photographs at the vertices.
        places: where those lie beside the landmarks in each.
        faces: of the mesh, (F,3).
    """
    graph = VertexGraph(faces.cpu(), len(shown[0].cosine))
    return torch.stack([_share(one, where, graph) for one, where in zip(shown, places, strict=True)])


def _share(shown: Shown, places: FacePlaces, graph: VertexGraph) -> Tensor:
    light = shown.colors.double().clamp(min=0.02).log()
    appearance = torch.stack([light.mean(1), light[:, 0] - light[:, 1], light[:, 2] - light[:, 1]], dim=1)
    core = places.cheeks & (shown.cosine > _SQUARE)
    alike = torch.ones(len(appearance), dtype=torch.float64)
    if int(core.sum()) >= _MIN_VERTICES:
        alike = _alike(appearance, core, graph)
    # Above the brows a fringe may hang before the forehead.
    surely = (places.out < _SURELY_SKIN) & (places.place[:, 1] < places.brows + _OVER_BROWS)
    share = torch.where(surely | (places.features & (places.out < 1)), 1.0, alike)
    below = places.beyond * (places.place[:, 1] < 0.5 * places.chin[1])
    falloff = (1 - _ramp(below, *_NECK)) * (1 - _ramp(places.behind, *_BEHIND))
    return graph.smoothed((share * falloff)[:, None], torch.ones_like(share), 2)[:, 0]


def _alike(appearance: Tensor, core: Tensor, graph: VertexGraph) -> Tensor:
    """How much each vertex (V,) resembles the skin of the core nearest to it."""
    lower, upper = (appearance.new_tensor(bound) for bound in (_MIN_DEVIATIONS, _MAX_DEVIATIONS))
    weight = core.double()
    middle = appearance[core].median(0).values
    deviations = (1.4826 * (appearance[core] - middle).abs().median(0).values).clamp(lower, upper)
    for _ in range(_ITERATIONS):  # what is no skin loses its weight, and the median moves
        far = ((appearance - middle) / deviations).square().sum(1)
        weight = core * torch.exp(-0.5 * far / 4)
        middle = (weight[:, None] * appearance).sum(0) / weight.sum()
    local = graph.smoothed(appearance, weight, _AROUND)
    coverage = graph.smoothed(weight[:, None], torch.ones_like(weight), _AROUND)
    expected = torch.lerp(middle.expand_as(appearance), local, (coverage / 0.02).clamp(max=1))
    return 1 - _ramp(((appearance - expected) / deviations).square().sum(1).sqrt(), _ALIKE, _UNLIKE)


def _radius(outline: Tensor, angle: Tensor) -> Tensor:
    """How far a star-shaped outline (P,2) about the origin reaches in directions (V,)."""
    angles = torch.atan2(outline[:, 1], outline[:, 0])
    order = angles.argsort()
    angles, reach = angles[order], outline.norm(dim=1)[order]
    angles = torch.cat([angles[-1:] - 2 * torch.pi, angles, angles[:1] + 2 * torch.pi])
    reach = torch.cat([reach[-1:], reach, reach[:1]])
    after = torch.searchsorted(angles, angle).clamp(1, len(angles) - 1)
    share = (angle - angles[after - 1]) / (angles[after] - angles[after - 1]).clamp(min=1e-9)
    return torch.lerp(reach[after - 1], reach[after], share.clamp(0, 1)).clamp(min=1e-6)


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    """0 below ``low``, 1 above ``high``, smooth between."""
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
