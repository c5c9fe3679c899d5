"""Claim: the performer's shapes go with those of two rigs of ARKit's shapes as these go with each other.

ICT-FaceKit's and Face Cap's shapes, carried to the performer's skin: their landmarks are laid on his by a thin-plate
spline, then each of his vertices moves as the nearest point. The performer's shapes were set with these two in view.
"""

from pathlib import Path

import pytest
import torch
import trimesh
from character_trials import own_shapes, without_shapes
from scipy.interpolate import RBFInterpolator
from torch import Tensor

from torchface.geometry.similarity import similarity_transform
from torchface.io import load_rig
from torchface.io.gltf.character_scene import read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.shape_names.recognised_names import recognised_shapes
from torchface.synthetic import performer
from torchface.workflows.rig.character_face import find_character_face, textured

pytestmark = [pytest.mark.bench, pytest.mark.real]

_HIDDEN = ("eyeball_left", "eyeball_right", "mouth_interior", "eye_sockets", "ear_left", "ear_right", "nostrils")
_FACE = (-112.0, 75.0)  # heights of the performer's vertices that count, those in front of his ears
_INNER = slice(17, None)  # landmarks inside the face's outline


def skin() -> tuple[Tensor, Tensor]:
    """Ids of the performer's vertices that count, and all his vertices."""
    rig = performer(texture=False)
    regions, vertices = rig.neutral.annotations.regions, rig.vertices.double()
    shown = ~torch.stack([regions[name] for name in _HIDDEN]).any(0)
    shown &= (vertices[:, 2] > 0) & (vertices[:, 1] > _FACE[0]) & (vertices[:, 1] < _FACE[1])
    return shown.nonzero()[:, 0], vertices


def carried(
    vertices: Tensor, faces: Tensor, shapes: dict[str, Tensor], ids: Tensor, marks: Tensor
) -> dict[str, Tensor]:
    """Shapes at the performer's skin (P,3), of a rig whose points ``marks`` (L,3) belong to his vertices ``ids``."""
    counted, own = skin()
    pose = similarity_transform(marks.double()[None], own[ids][None])
    placed, at = (pose.apply(points.double()[None])[0].numpy() for points in (vertices, marks))
    placed = placed + RBFInterpolator(at, own[ids].numpy() - at, kernel="thin_plate_spline", smoothing=5.0)(placed)
    mesh = trimesh.Trimesh(placed, faces.numpy(), process=False)
    nearest, _, rows = trimesh.proximity.closest_point(mesh, own[counted].numpy())
    corners = mesh.faces[rows]
    share = torch.from_numpy(trimesh.triangles.points_to_barycentric(placed[corners], nearest))[..., None]
    return {name: (pose.apply_vectors(s.double()[None])[0][corners] * share).sum(1) for name, s in shapes.items()}


@pytest.fixture(scope="module")
def ict(ict_folder: Path) -> dict[str, Tensor]:
    rig = load_rig(ict_folder, part="face")
    shapes = {n: rig.deltas[rig.index(s.names)].sum(0) for n, s in recognised_shapes(list(rig.names)).items()}
    marks = rig.vertices[rig.neutral.landmarks][_INNER]
    return carried(rig.vertices, rig.neutral.faces, shapes, performer(texture=False).neutral.landmarks[_INNER], marks)


@pytest.fixture(scope="module")
def face_cap(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Tensor]:
    path = data / "characters" / "facecap.glb"
    character, shapes = own_shapes(path)
    bare = read_character(read_document(without_shapes(path, tmp_path_factory.mktemp("face_cap") / "bare.glb")))
    face = find_character_face(bare, textured(bare))
    ids, points = face.landmarks
    size = float((character.vertices.amax(0) - character.vertices.amin(0)).norm())
    joined = joined_vertices(character.vertices / size * 300, character.faces)
    part = joined.part[joined.of]
    whole = character.faces[(part == part.bincount().argmax())[character.faces].all(1)]
    marks = face.found.pose.apply(points.double()[None])[0]
    return carried(character.vertices, whole, shapes, ids, marks)


def test_shapes_go_with_those_of_others(ict: dict[str, Tensor], face_cap: dict[str, Tensor]) -> None:
    rig, (counted, _) = performer(texture=False), skin()
    own = dict(zip(rig.names, rig.deltas.double()[:, counted], strict=True))
    pairs = {"with ICT": (own, ict), "with Face Cap": (own, face_cap), "ICT with Face Cap": (ict, face_cap)}
    names = [name for name in own if name in ict and name in face_cap]
    cosine = {
        what: torch.stack([(a[n] * b[n]).sum() / (a[n].norm() * b[n].norm()) for n in names])
        for what, (a, b) in pairs.items()
    }
    size = torch.stack([own[n].norm() / (ict[n].norm() * face_cap[n].norm()).sqrt() for n in names])
    print()
    for what, values in cosine.items():
        print(f"{what}: cosine {values.mean():.3f} in the mean, {values.min():.2f} at least ({names[values.argmin()]})")
    print(
        f"motion over the geometric mean of theirs: {size.amin():.2f} to {size.amax():.2f}, median {size.median():.2f}"
    )
    both = (cosine["with ICT"].mean() + cosine["with Face Cap"].mean()) / 2
    assert both > cosine["ICT with Face Cap"].mean()
    assert float(size.amin()) > 0.4
    assert float(size.amax()) < 1.6
