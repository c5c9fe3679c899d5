"""Characters whose shapes are stripped and made again, and how near to their own the made ones are."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from planted.characters import UPRIGHT, Planted, write_character
from planted.glb_files import packed, unpacked
from torchface.geometry.similarity import similarity_transform
from torchface.io.gltf.character_scene import Character, read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.rig import BlendshapeRig
from torchface.shape_names.recognised_names import recognised_shapes
from torchface.synthetic import performer
from torchface.workflows.rig.character_face import find_character_face, textured
from torchface.workflows.rig.character_rig import CharacterReport, rig_character


@dataclass(frozen=True, eq=False)
class Trial:
    """One character."""

    name: str  # for the table
    whole: Path  # the file with its own shapes


@dataclass(frozen=True, eq=False)
class Scores:
    """How near made shapes are to a character's own, by ARKit's names."""

    names: tuple[str, ...]  # of the S shapes that both have and that move something
    cosine: Tensor  # of the directions in which all vertices go, (S,)
    error: Tensor  # root of the summed squared error over that of the own shape, (S,)

    @staticmethod
    def of(own: dict[str, Tensor], made: dict[str, Tensor], counted: Tensor) -> "Scores":
        """Of the vertices (V,) bool that count."""
        names = tuple(name for name in own if name in made and float(own[name].norm()) > 0)
        pairs = [(own[name].double()[counted], made[name].double()[counted]) for name in names]
        cosine = [float((a * b).sum() / (a.norm() * b.norm()).clamp(min=1e-12)) for a, b in pairs]
        error = [float((a - b).norm() / a.norm()) for a, b in pairs]
        return Scores(names, torch.tensor(cosine), torch.tensor(error))


def trial(folder: Path, name: str, rig: BlendshapeRig, how: Planted = UPRIGHT) -> Trial:
    """A character by code whose shapes are known."""
    path = folder / f"{name}_whole.glb"
    write_character(path, rig.neutral, dict(zip(rig.names, rig.deltas, strict=True)), how)
    return Trial(name, path)


def without_shapes(path: Path, out: Path) -> Path:
    """The same file without morph targets and animations."""
    root, binary = unpacked(path)
    for mesh in root["meshes"]:
        mesh.pop("weights", None)
        (mesh.get("extras") or {}).pop("targetNames", None)
        for primitive in mesh["primitives"]:
            primitive.pop("targets", None)
    root.pop("animations", None)
    out.write_bytes(packed(json.loads(json.dumps(root)), binary))
    return out


def own_shapes(path: Path) -> tuple[Character, dict[str, Tensor]]:
    """A character and its shapes by ARKit's names, (V,3) in the scene's axes and unit."""
    character = read_character(read_document(path))
    names = list(dict.fromkeys(name for block in character.blocks for name in block.names))
    moved = {name: torch.zeros_like(character.vertices) for name in names}
    for block in character.blocks:
        for name, rows in zip(block.names, character.targets(block).double(), strict=True):
            moved[name][block.rows] = torch.einsum("vij,vj->vi", character.linear[block.rows], rows)
    found = recognised_shapes(names)
    return character, {arkit: sum(moved[name] for name in shape.names) for arkit, shape in found.items()}


def rigged(one: Trial, folder: Path) -> tuple[CharacterReport, Scores, Scores]:
    """What was made of a character without its shapes, how near it is, and how near nearest vertices come."""
    bare = without_shapes(one.whole, folder / f"{one.name}.glb")
    report = rig_character(bare, folder / f"{one.name}_rigged.glb")
    character, own = own_shapes(one.whole)
    _, made = own_shapes(folder / f"{one.name}_rigged.glb")
    counted = gaze_or_all(character, own)
    return report, Scores.of(own, made, counted), Scores.of(own, nearest_vertices(bare), counted)


def gaze_or_all(character: Character, own: dict[str, Tensor]) -> Tensor:
    """All vertices but those of parts that no shape of the character's own moves, such as eyeballs that bones turn."""
    millimetres = character.vertices / float((character.vertices.amax(0) - character.vertices.amin(0)).norm()) * 300
    joined = joined_vertices(millimetres, character.faces)
    moved = torch.stack(list(own.values())).norm(dim=-1).amax(0)
    part = joined.part[joined.of]
    most = torch.zeros(int(part.max()) + 1, dtype=moved.dtype).scatter_reduce(0, part, moved, "amax")
    return most[part] > 0.01 * moved.max()


def nearest_vertices(bare: Path) -> dict[str, Tensor]:
    """The embedded performer's shapes on a character: landmarks aligned, each vertex moves as the nearest."""
    character = read_character(read_document(bare))
    face = find_character_face(character, textured(character))
    template = performer(texture=False)
    ids, points = face.landmarks
    pose = similarity_transform(template.vertices[ids].double()[None], points.double()[None])
    placed = pose.apply(template.vertices.double())[0]
    distance, nearest = cKDTree(placed.numpy()).query(face.vertices[face.rows].numpy())
    moved = pose.apply_vectors(template.deltas.double())[:, torch.from_numpy(nearest)]
    moved[:, torch.from_numpy(distance) > 20.0] = 0.0
    result = {}
    for name, rows in zip(template.names, face.found.pose.apply_vectors(moved), strict=True):
        result[name] = torch.zeros_like(character.vertices)
        result[name][face.rows] = rows
    return result
