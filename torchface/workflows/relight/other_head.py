"""Another head that stands in the actor's place in a film: bare of hair, as paint, and moving as the actor does."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_rig
from torchface.mesh import Mesh
from torchface.modeling.photographs.image_texture import part_vertices
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.modeling.photographs.skin_mask import FacePlaces
from torchface.rendering.point_light import vertex_albedo
from torchface.rendering.texture_overlay import FacePaint
from torchface.rig import BlendshapeRig
from torchface.synthetic import Look, character
from torchface.synthetic.head.embedded_character import is_performers
from torchface.take import Track
from torchface.workflows.relight.tracked_film import TrackedFilm, bare
from torchface.workflows.track.upright_rig import upright

# In distances between the eyes' outer corners; of colours' logarithms; rings of vertices; share; vertices; of white.
_ABOVE_BROWS, _UNLIKE_SKIN, _HAIR_EDGE, _HALF_HAIR, _FEWEST, _DARK = 0.08, 0.5, 3, 0.2, 20, 0.02
_DOWN, _STRANDS, _FRINGE, _NAPE = 40, 8, -0.06, -1.6  # rings of vertices; over the brows' landmarks and the eyes
_STRAND = (0.1, 0.25)  # logarithms by which a strand is darker than skin
# Logarithms of hue; behind the ears' landmarks; and over the eyes.
_GREYER, _BACK, _TEMPLES = 0.2, (0.35, -0.7), (-0.45, -0.2)


def other_head(path: Path) -> BlendshapeRig:
    """A head for the actor's place, with teeth where the template has some; hair and clothes are the film's."""
    other = upright(load_rig(path))[0]
    texture = other.neutral.texture
    if texture is None or other.neutral.uvs is None:
        raise ValueRangeError(
            f"{path}: found a rig without a texture that can be read, expected one as PNG or JPEG, which the film is "
            "to show"
        )
    if is_performers(other):
        return bare(character(other, Look(haircut=None), texture.shape[-1], texture.float()).rig)
    other = bare(other)
    marks = other.neutral.landmarks
    if marks is None or len(marks) != LANDMARKS:
        return other
    return BlendshapeRig(without_painted_hair(other.neutral), other.deltas, other.names, other.correctives)


def without_painted_hair(mesh: Mesh) -> Mesh:
    """A head with the 68 landmarks whose texture shows skin in place of hair above the brows and about the ears."""
    assert mesh.texture is not None
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    places, colors, faces = FacePlaces.of(mesh), vertex_albedo(mesh).double().clamp(min=_DARK), mesh.faces.cpu()
    parts = part_vertices(mesh)
    up, behind = places.place[:, 1], places.behind
    sides = ((behind > _BACK[0]) & (up > _BACK[1])) | ((behind > _TEMPLES[0]) & (up > _TEMPLES[1]))
    brows = places.place[mesh.landmarks.cpu()[17:27]]
    above = up - brows[(places.place[:, :1] - brows[:, 0]).abs().argmin(1), 1]
    forehead = ((above > _ABOVE_BROWS) | (sides & ~places.brow)) & ~parts
    cheeks = places.cheeks & ~parts
    if not cheeks.any():
        return mesh  # nothing says what skin looks like
    skin = colors[cheeks].median(0).values
    apart = colors.log() - skin.log()
    grey = (apart - apart.mean(1, keepdim=True)).norm(dim=1) > _GREYER  # beside fair skin grey hair is hardly darker
    unlike = (apart.clamp(max=0).norm(dim=1) > _UNLIKE_SKIN) | grey  # what is brighter is a highlight
    graph = VertexGraph(faces, len(colors))
    hair, lower = (forehead & unlike).double(), ((above > _FRINGE) | ((behind > _BACK[0]) & (up > _NAPE))) & ~parts
    for _ in range(_DOWN):  # nearer to the brows and on the neck only what hangs down from above is hair
        hair = torch.maximum(hair, (graph.sum(hair[:, None])[:, 0] > 0) * unlike * lower.double())
    beside = hair
    for _ in range(_HAIR_EDGE):
        hair = torch.maximum(hair, graph.sum(hair[:, None])[:, 0] / graph.degree)
    for _ in range(_STRANDS):
        beside = torch.maximum(beside, (graph.sum(beside[:, None])[:, 0] > 0) * (forehead | lower).double())
    hair = (hair / _HALF_HAIR).clamp(max=1) * (forehead | (lower & unlike))
    bare_forehead = forehead & (hair == 0) & (places.out < 1)
    if int(bare_forehead.sum()) >= _FEWEST:
        skin = colors[bare_forehead].median(0).values
    height, width = mesh.texture.shape[1:]
    texels = rasterise_uvs(mesh.uvs.cpu(), mesh.uv_faces.cpu(), height, width)
    shown = mesh.texture.float().flatten(1)[:, texels.texels].T.double()
    share, near = texels.interpolate(torch.stack([hair, beside], dim=1), faces).double().T[:, :, None]
    # Single strands lie between vertices.
    darker = (skin.log() - shown.clamp(min=_DARK).log()).mean(1, keepdim=True)
    strand = ((darker - _STRAND[0]) / (_STRAND[1] - _STRAND[0])).clamp(0, 1)
    painted = torch.lerp(shown, skin.expand_as(shown), torch.maximum(share, near * strand))
    return replace(mesh, texture=texels.image(painted))


def as_paint(mesh: Mesh) -> FacePaint:
    """All of another head as paint, eyes and teeth too."""
    assert mesh.texture is not None
    texture = torch.cat([mesh.texture.float(), torch.ones_like(mesh.texture[:1]).float()])
    paint = FacePaint.of(mesh, texture)
    return replace(paint, skin=torch.ones_like(paint.skin))


def placed(other: BlendshapeRig, tracked: TrackedFilm, path: Path) -> Callable[[int], Tensor]:
    """Another head that stands where the actor's does, by their landmarks, and moves as it."""
    marks = other.neutral.landmarks, tracked.rig.neutral.landmarks
    if len(marks[0]) != len(marks[1]):
        raise ValueRangeError(f"{path}: found {len(marks[0])} landmarks, expected the actor's {len(marks[1])}")
    target = tracked.rig.vertices[marks[1]].double()[None]
    pose = similarity_transform(other.vertices[marks[0]].double()[None], target)
    weights = other.weights_from(Track(tracked.rig.names, tracked.weights[..., None]))

    def vertices(frame: int) -> Tensor:
        posed = other(weights[frame : frame + 1].to(other.deltas))
        return pose.apply(posed.double())[0]

    return vertices
