"""Landmarks of a character lie in its meshes' extras, and a skinned mesh stands where its joints put it at rest."""

from pathlib import Path

import numpy as np
import pytest
import torch

from planted.characters import Planted, write_character
from planted.glb_files import packed, unpacked
from torchface import Annotations, load_mesh
from torchface.errors import FileFormatError
from torchface.io.gltf.character_annotations import annotate_character
from torchface.io.gltf.character_scene import read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.morph_insertion import write_edited
from torchface.synthetic import performer

TURN = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


@pytest.fixture
def annotated(tmp_path: Path) -> Path:
    """A character in centimetres on its back, 66 of whose landmarks are on its body and two on its hair."""
    person = performer(texture=False)
    write_character(tmp_path / "bare.glb", person.neutral, how=Planted(turn=TURN, units=100.0))
    character = read_character(read_document(tmp_path / "bare.glb"))
    rows = torch.arange(len(character.vertices))
    hair = character.blocks[1].rows.start
    marks = torch.cat([person.neutral.landmarks[:66], torch.tensor([hair + 7, hair + 9])])
    eye = torch.zeros(len(rows), dtype=torch.bool)
    eye[: len(person.vertices)] = person.neutral.annotations.regions["eyeball_left"]
    root = read_document(tmp_path / "bare.glb").root
    annotate_character(root, character, rows, Annotations(marks, {"eyeball_left": eye, "mouth_interior": eye}))
    write_edited(character.document, root, b"", tmp_path / "a.glb")
    np.savez(tmp_path / "truth.npz", marks=character.vertices[marks], eye=character.vertices[eye])
    return tmp_path / "a.glb"


def test_landmarks_and_regions_come_back_from_all_meshes(annotated: Path) -> None:
    mesh, truth = load_mesh(annotated), np.load(annotated.with_name("truth.npz"))
    at = mesh.vertices[mesh.landmarks].numpy() / 1000
    assert np.abs(at - truth["marks"]).max() < 1e-4
    eye = mesh.vertices[mesh.annotations.regions["eyeball_left"]].numpy() / 1000
    assert {tuple(row) for row in eye.round(2)} == {tuple(row) for row in truth["eye"].astype(np.float32).round(2)}
    assert set(mesh.annotations.regions) == {"Body", "Hair", "eyeball_left"}
    assert "author" in unpacked(annotated)[0]["meshes"][0]["extras"]


def test_a_skinned_mesh_stands_where_its_joints_put_it(annotated: Path) -> None:
    character = read_character(read_document(annotated))
    vertices = load_mesh(annotated).vertices.double() / 1000
    assert torch.allclose(vertices.amin(0), character.vertices.amin(0), atol=1e-4)
    assert torch.allclose(vertices.amax(0), character.vertices.amax(0), atol=1e-4)


def test_landmarks_of_rows_that_were_put_in_another_order_are_not_taken(annotated: Path) -> None:
    root, binary = unpacked(annotated)
    record = root["meshes"][0]["extras"]["torchface"]["rows"]
    record["landmarks"] = [row if row < 0 else row + 1 for row in record["landmarks"]]
    annotated.write_bytes(packed(root, binary))
    assert load_mesh(annotated).annotations.landmarks is None


def test_landmarks_are_of_rows_that_two_materials_share(annotated: Path) -> None:
    """Of which one places its texture otherwise, as beside whole numbers of gltfpack."""
    before = load_mesh(annotated)
    root, binary = unpacked(annotated)
    change = {"KHR_texture_transform": {"scale": [0.5, 0.5]}}
    root["materials"].append({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": change}}})
    primitives = root["meshes"][0]["primitives"]
    primitives.append({**primitives[0], "material": len(root["materials"]) - 1})
    annotated.write_bytes(packed(root, binary))
    after = load_mesh(annotated)
    assert torch.equal(after.vertices[after.landmarks], before.vertices[before.landmarks])
    for name, mask in before.annotations.regions.items():
        assert torch.equal(after.vertices[after.annotations.regions[name]], before.vertices[mask])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("landmarks", [10**7] * 68),
        ("places", [[0.0, 1.0]] * 66),
        ("places", [[0.0, 1.0, 2.0]] * 3),
        ("regions", {"a": [5]}),
    ],
)
def test_damaged_annotations_are_refused(annotated: Path, field: str, value: object) -> None:
    root, binary = unpacked(annotated)
    root["meshes"][0]["extras"]["torchface"]["rows"][field] = value
    annotated.write_bytes(packed(root, binary))
    with pytest.raises(FileFormatError, match=r"extras\.torchface\.rows"):
        load_mesh(annotated)
