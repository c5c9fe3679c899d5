"""What moves with a character's face is told by names where its place does not; lips are where its skin has them."""

import pytest
import torch

from torchface.io.gltf.character_scene import Block
from torchface.modeling.rigging.eyelid_closure import SkinOfHead
from torchface.synthetic import neutral_head
from torchface.workflows.rig.character_face import _FACIAL, _STILL, _is_called, with_edges


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


def test_lips_that_pictures_show_elsewhere_are_put_right() -> None:
    head = neutral_head(texture=False)
    regions, rest = head.annotations.regions, head.vertices.double()
    balls = regions["eyeball_left"] | regions["eyeball_right"]
    lips = (regions["upper_lip"] | regions["lower_lip"]).nonzero()[:, 0]
    astray = torch.tensor([1.0, -7.0, 4.0], dtype=torch.float64)
    placed = rest[head.landmarks]
    placed[48:] += astray
    ids, points = with_edges(
        (lips, rest[lips] + astray), head, SkinOfHead(rest, head.faces, balls, balls.long()), placed
    )
    of_lips = torch.isin(ids, lips)
    assert int(of_lips.sum()) > 20
    assert float((points - rest[ids])[of_lips].norm(dim=-1).max()) < 1.5
