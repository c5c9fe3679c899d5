"""What an input's head must be for a place of each vertex on the model's to be found."""

from dataclasses import replace
from pathlib import Path

import pytest

from torchface.errors import ValueRangeError
from torchface.mesh import submesh
from torchface.progress import silent
from torchface.synthetic import performer
from torchface.workflows.enhance.head_correspondence import find_correspondence


def test_a_head_in_another_unit_is_named_with_both_sizes(tmp_path: Path) -> None:
    head = performer(texture=False).neutral
    model = submesh(head, head.annotations.regions["face"]).mesh
    large = replace(head, vertices=10 * head.vertices)
    with pytest.raises(ValueRangeError, match=r"rig.glb: its head measures \d+ mm from corner to corner, the model's"):
        find_correspondence(large, model, None, Path("rig.glb"), tmp_path / "state", silent)
    assert not list(tmp_path.iterdir())
