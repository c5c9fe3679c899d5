"""What an input's head must be for a place of each vertex on the model's to be found."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface.errors import ValueRangeError
from torchface.mesh import Mesh, submesh
from torchface.progress import silent
from torchface.synthetic import character, draw_identities, neutral_head, performer
from torchface.workflows.enhance.head_correspondence import find_correspondence


def test_a_head_in_another_unit_is_named_with_both_sizes(tmp_path: Path) -> None:
    head = performer(texture=False).neutral
    model = submesh(head, head.annotations.regions["face"]).mesh
    large = replace(head, vertices=10 * head.vertices)
    with pytest.raises(ValueRangeError, match=r"rig.glb: its head measures \d+ mm from corner to corner, the model's"):
        find_correspondence(large, model, None, Path("rig.glb"), tmp_path / "state", silent)
    assert not list(tmp_path.iterdir())


def test_hair_and_teeth_are_not_bent_onto_a_model_of_the_face(tmp_path: Path) -> None:
    """All of the head had 4,900 vertices on the model, hair among them, and lay 9 mm off."""
    person = performer(texture=False)
    model = submesh(person.neutral, person.neutral.annotations.regions["face"]).mesh
    head = character(person, size=64).rig.neutral
    found = find_correspondence(head, model, None, Path("rig.glb"), tmp_path / "state", silent)
    face = head.annotations.regions["face"]
    assert found.residual < 0.5
    assert not found.known[~face].any()
    assert found.known[face].float().mean() > 0.8
    assert f"{int(found.known.sum())} of {int(face.sum())} vertices" in found.notes(Path("rig.glb"))[0]


@pytest.fixture(scope="module")
def two_people() -> tuple[Mesh, Mesh, torch.Tensor]:
    """A head, another person's face as the model, and where that person has the head's vertices."""
    head, other = (neutral_head(one, texture=False) for one in draw_identities(2, torch.Generator().manual_seed(3)))
    return head, submesh(other, other.annotations.regions["face"]).mesh, other.vertices


def with_face(head: Mesh, face: torch.Tensor) -> Mesh:
    return replace(head, annotations=replace(head.annotations, regions={"face": face}))


def test_what_is_kept_of_a_head_is_not_taken_for_one_with_other_annotations(
    two_people: tuple[Mesh, Mesh, torch.Tensor], tmp_path: Path
) -> None:
    """The state of a rig before it had a region face gave 282 % of the vertices of the face."""
    head, model, _ = two_people
    regions, state = head.annotations.regions, tmp_path / "state"
    whole = find_correspondence(head, model, None, Path("rig.glb"), state, silent)
    assert whole.known[regions["cheek_left"]].any()
    smaller = with_face(head, regions["face"] & ~regions["cheek_left"])
    part = find_correspondence(smaller, model, None, Path("rig.glb"), state, silent)
    assert not part.known[regions["cheek_left"]].any()
    unmarked = replace(model, annotations=replace(model.annotations, landmarks=None))
    assert not find_correspondence(smaller, unmarked, None, Path("rig.glb"), state, silent).bent.equal(part.bent)


def test_landmarks_count_where_the_face_lacks_one(two_people: tuple[Mesh, Mesh, torch.Tensor], tmp_path: Path) -> None:
    """Without all of them eyes, nose and mouth lay 0.8 mm off."""
    head, model, truth = two_people
    face = head.annotations.regions["face"].clone()
    face[head.landmarks[0]] = False
    found = find_correspondence(with_face(head, face), model, None, Path("rig.glb"), tmp_path / "state", silent)
    assert (found.bent - truth)[head.landmarks[17:]].norm(dim=1).mean() < 0.4


def test_an_empty_face_is_refused_with_the_file_named(
    two_people: tuple[Mesh, Mesh, torch.Tensor], tmp_path: Path
) -> None:
    head, model, _ = two_people
    empty = with_face(head, torch.zeros(len(head.vertices), dtype=torch.bool))
    with pytest.raises(ValueRangeError, match=r"^rig.glb: found no triangle in its region face"):
        find_correspondence(empty, model, None, Path("rig.glb"), tmp_path / "state", silent)
