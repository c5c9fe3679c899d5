"""Which part of a photographed head is skin: neither hair nor clothes, nor what stands behind an ear that is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.modeling.photographs.landmark_view import JAW, LANDMARKS
from torchface.rendering.camera_visibility import Shown, shown_in
from torchface.rendering.raycast import RayCaster

_FEATURES = 0.10
_SURE = 0.75
_NECK, _BEHIND = (0.05, 0.35), (0.05, 0.30)
_FOREHEAD = 0.15
"""In distances between the eyes' outer corners, but for the second row: shares of the way to the face's outline."""
_ALIKE, _UNLIKE = 1.8, 2.8
_LEAST, _MOST = (0.25, 0.06, 0.06), (0.45, 0.14, 0.14)  # deviations of skin: of brightness, of two ratios of channels
_SQUARE, _FEWEST, _AROUND = 0.35, 30, 60
_SETTLING = 4


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
    """

    out: Tensor
    beyond: Tensor
    place: Tensor
    features: Tensor
    behind: Tensor
    chin: Tensor
    brows: float

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
        away = place[:, :2] - middle
        reach = _radius(outline - middle, torch.atan2(away[:, 1], away[:, 0]))
        length = away.norm(dim=1)
        features = torch.cdist(place, torch.cat([at[JAW:27], at[31:LANDMARKS]])).amin(1) < _FEATURES
        ears = at[[0, 16], 2].mean()
        return FacePlaces(
            length / reach, length - reach, place, features, ears - place[:, 2], at[8], float(at[17:27, 1].mean())
        )


def skin_shares(mesh: Mesh, images: Sequence[Tensor], cameras: Sequence[Camera]) -> Tensor:
    """How far photographs show skin, or a feature of the face, at each vertex, (I,V) in [0,1].

    Inside the face's outline everything is the person's. Around it counts what looks like the cheeks nearby, in
    brightness and in the ratios of the channels; far below the chin and behind the ears nothing does.

    Args:
        mesh: the head as the photographs show it, with 68 landmarks.
        images: photographs, (3,H,W) each.
        cameras: one each.
    """
    places = FacePlaces.of(mesh)
    vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    normals, caster, graph = (
        vertex_normals(vertices, faces),
        RayCaster(vertices, faces),
        VertexGraph(faces, len(vertices)),
    )
    shares = [
        _share(shown_in(image.cpu(), camera, caster, vertices, normals), places, graph)
        for image, camera in zip(images, cameras, strict=True)
    ]
    return torch.stack(shares)


def _share(shown: Shown, places: FacePlaces, graph: VertexGraph) -> Tensor:
    light = shown.colors.double().clamp(min=0.02).log()
    look = torch.stack([light.mean(1), light[:, 0] - light[:, 1], light[:, 2] - light[:, 1]], dim=1)
    core = (places.out < _SURE) & ~places.features & (shown.cosine > _SQUARE) & (places.place[:, 1] < places.brows)
    alike = torch.ones(len(look), dtype=torch.float64)
    if int(core.sum()) >= _FEWEST:
        alike = _alike(look, core, graph)
    share = torch.where((places.out < _SURE) | (places.features & (places.out < 1)), 1.0, alike)
    below = places.beyond * (places.place[:, 1] < 0.5 * places.chin[1])
    fade = (1 - _ramp(below, *_NECK)) * (1 - _ramp(places.behind, *_BEHIND))
    return graph.smoothed((share * fade)[:, None], torch.ones_like(share), 2)[:, 0]


def _alike(look: Tensor, core: Tensor, graph: VertexGraph) -> Tensor:
    """How much each vertex (V,) looks like the skin of the core nearest to it."""
    least, most = (look.new_tensor(bound) for bound in (_LEAST, _MOST))
    weight = core.double()
    middle = look[core].median(0).values
    spread = (1.4826 * (look[core] - middle).abs().median(0).values).clamp(least, most)
    for _ in range(_SETTLING):  # what is no skin loses its say, and the middle moves
        far = ((look - middle) / spread).square().sum(1)
        weight = core * torch.exp(-0.5 * far / 4)
        middle = (weight[:, None] * look).sum(0) / weight.sum()
    local = graph.smoothed(look, weight, _AROUND)
    told = graph.smoothed(weight[:, None], torch.ones_like(weight), _AROUND)
    expected = torch.lerp(middle.expand_as(look), local, (told / 0.02).clamp(max=1))
    return 1 - _ramp(((look - expected) / spread).square().sum(1).sqrt(), _ALIKE, _UNLIKE)


def _radius(outline: Tensor, angle: Tensor) -> Tensor:
    """How far a star-shaped outline (P,2) about the origin reaches in directions (V,)."""
    turns = torch.atan2(outline[:, 1], outline[:, 0])
    order = turns.argsort()
    turns, reach = turns[order], outline.norm(dim=1)[order]
    turns = torch.cat([turns[-1:] - 2 * torch.pi, turns, turns[:1] + 2 * torch.pi])
    reach = torch.cat([reach[-1:], reach, reach[:1]])
    after = torch.searchsorted(turns, angle).clamp(1, len(turns) - 1)
    share = (angle - turns[after - 1]) / (turns[after] - turns[after - 1]).clamp(min=1e-9)
    return torch.lerp(reach[after - 1], reach[after], share.clamp(0, 1)).clamp(min=1e-6)


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    """0 below ``low``, 1 above ``high``, smooth between."""
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
