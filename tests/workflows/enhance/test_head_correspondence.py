"""What an input's head must be for a place of each vertex on the model's to be found."""

from dataclasses import replace
from pathlib import Path

import pytest

from torchface.errors import ValueRangeError
from torchface.mesh import submesh
from torchface.progress import silent
from torchface.synthetic import performer
from torchface.synthetic.head.embedded_character import character
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
