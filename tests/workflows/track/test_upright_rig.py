"""A rig is brought to where heads are, and one that is there stays as it is."""

import torch

from torchface import BlendshapeRig, Corrective, Correctives
from torchface.synthetic import performer
from torchface.workflows.track.upright_rig import upright

BACK = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # lies on its back


def moved(rig: BlendshapeRig, size: float, turn: torch.Tensor, shift: torch.Tensor) -> BlendshapeRig:
    neutral = rig.neutral.with_vertices(size * rig.vertices @ turn.T + shift)
    both = Correctives(size * rig.deltas[:1] @ turn.T, (Corrective("both", rig.names[:2]),))
    return BlendshapeRig(neutral, size * rig.deltas @ turn.T, rig.names, both)


def test_a_head_in_centimetres_on_its_back_is_brought_upright() -> None:
    person = performer(texture=False).select(["jawOpen", "mouthPucker"])
    made, line = upright(moved(person, 100.0, BACK, torch.tensor([5e3, 2e4, -3e3])))
    assert (
        line.startswith("the rig's head is 104 times a head's size and turned by 90 degrees") or "turned by 9" in line
    )
    known = upright(moved(person, 1.0, torch.eye(3), torch.tensor([0.0, 1600.0, 0.0])))
    assert known[1] == ""
    for rig in (made, known[0]):
        size = float(rig.vertices.std() / person.vertices.std())
        assert 0.9 < size < 1.1
        assert torch.allclose(rig.deltas / size, person.deltas, atol=2.0)
        assert torch.allclose(rig.correctives.deltas, rig.deltas[:1], atol=1e-3)
        assert float((rig.vertices - person.vertices).norm(dim=1).max()) < 40


def test_a_head_at_its_place_stays_as_it_is() -> None:
    person = performer(texture=False).select(["jawOpen", "mouthPucker"])
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0, 0.3], [0, 0, 0], [-0.3, 0, 0]]))
    rig = moved(person, 1.2, turn, torch.tensor([0.0, 30.0, 0.0]))
    assert upright(rig) == (rig, "")
    bare = BlendshapeRig.from_tensors(100 * rig.vertices, rig.neutral.faces, rig.deltas, rig.names)  # no landmarks
    assert upright(bare) == (bare, "")
