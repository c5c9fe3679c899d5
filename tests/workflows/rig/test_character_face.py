"""What moves with a character's face is told by names where its place does not."""

import pytest

from torchface.io.gltf.character_scene import Block
from torchface.workflows.rig.character_face import _FACIAL, _STILL, _is_called


@pytest.mark.parametrize(
    ("name", "material", "still"),
    [
        ("Hair001", "", True),
        ("Wolf3D_Glasses", "", True),
        ("top hat", "", True),
        ("Head", "M_Hair_Cap", True),
        ("FaceCap eyes", "", False),
        ("Eyebrow_Hair", "", False),
        ("Wolf3D_Teeth", "Teeth", False),
        ("CC_Base_Eye", "", False),
    ],
)
def test_hair_and_what_is_worn_stay_still(name: str, material: str, still: bool) -> None:
    assert _is_called(Block(0, 0, (0,), name, (material,), slice(0, 1), (), ()), _STILL) is still


@pytest.mark.parametrize(
    ("name", "facial"), [("avatarBeard", True), ("Moustache_01", True), ("Wolf3D_Hair", False), ("brown_coat", False)]
)
def test_beards_move_however_long_they_are(name: str, facial: bool) -> None:
    assert _is_called(Block(0, 0, (0,), name, ("",), slice(0, 1), (), ()), _FACIAL) is facial
