"""BlendshapeRig: equation 1, parts, names."""

import numpy as np
import pytest
import torch

from torchface import BlendshapeRig, Mesh
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError


def small_rig(seed: int = 0) -> BlendshapeRig:
    generator = torch.Generator().manual_seed(seed)
    neutral = Mesh(torch.randn(6, 3, generator=generator), torch.tensor([[0, 1, 2], [2, 3, 4], [3, 4, 5]]))
    return BlendshapeRig(neutral, torch.randn(4, 6, 3, generator=generator), ["a", "b", "c", "d"])


def test_forward_is_neutral_plus_weighted_deltas() -> None:
    rig = small_rig()
    weights = torch.rand(5, 4, generator=torch.Generator().manual_seed(1))
    expected = rig.vertices + sum(weights[:, i, None, None] * rig.deltas[i] for i in range(4))
    torch.testing.assert_close(rig(weights), expected)
    torch.testing.assert_close(rig(torch.eye(4))[2], rig.neutral.vertices + rig.deltas[2])


def test_a_rig_of_plain_tensors_is_the_same_rig() -> None:
    rig = small_rig()
    plain = BlendshapeRig.from_tensors(rig.vertices, rig.neutral.faces.int(), rig.deltas, rig.names)
    weights = torch.rand(3, 4, generator=torch.Generator().manual_seed(2))
    assert torch.equal(plain(weights), rig(weights))
    deltas = rig.deltas.clone().requires_grad_()
    quads, uvs = torch.tensor([[0, 1, 2, 3], [3, 4, 5, -1]]), torch.rand(6, 2)
    built = BlendshapeRig.from_tensors(rig.vertices, quads, deltas, uvs=uvs, uv_faces=quads)
    assert built.names == ("shape_0", "shape_1", "shape_2", "shape_3")
    assert built.neutral.faces.tolist() == built.neutral.uv_faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 4, 5]]
    built(weights).sum().backward()
    assert torch.equal(deltas.grad[:, 0], weights.sum(0)[:, None].expand(4, 3))


def test_casting_moves_the_neutral_too() -> None:
    rig = small_rig().to(torch.float64)
    assert rig.neutral.vertices.dtype == rig.deltas.dtype == torch.float64
    assert set(rig.state_dict()) == {"vertices", "deltas"}


def test_part_moves_as_the_whole_does() -> None:
    rig = small_rig()
    part = rig.part(torch.tensor([2, 3, 4, 5]))
    weights = torch.rand(3, 4, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(part(weights), rig(weights)[:, 2:])
    torch.testing.assert_close(rig.select(["d", "a"]).deltas, rig.deltas[[3, 0]])


def test_bad_rigs_and_weights_are_named() -> None:
    rig = small_rig()
    with pytest.raises(NameMismatchError, match="no shape 'smile'"):
        rig.select(["smile"])
    with pytest.raises(ShapeError, match=r"found \(2, 3\), expected \(B,4\)"):
        rig(torch.zeros(2, 3))
    with pytest.raises(NameMismatchError, match="more than once: a"):
        BlendshapeRig(rig.neutral, rig.deltas, ["a", "a", "b", "c"])
    with pytest.raises(ShapeError, match=r"expected \(N,6,3\)"):
        BlendshapeRig(rig.neutral, rig.deltas[:, :5], rig.names)
    broken = rig.deltas.clone()
    broken[1, 0, 0] = torch.inf
    with pytest.raises(ValueRangeError, match="NaN or infinite in b"):
        BlendshapeRig(rig.neutral, broken, rig.names)


def test_one_name_is_no_list_of_names() -> None:
    with pytest.raises(NameMismatchError, match=r"found the text 'ab', expected a list of names: \['ab'\]"):
        small_rig().index("ab")


def test_under_arkits_names_the_face_moves_as_before() -> None:
    rig = small_rig()
    own = BlendshapeRig(rig.neutral, rig.deltas, ["wink", "browInnerUp_L", "JawOpen", "browInnerUp_R"])
    renamed = own.with_arkit_names()
    assert renamed.names == ("jawOpen", "browInnerUp", "wink")
    weights = torch.tensor([[0.3, 0.7, 0.2]])
    torch.testing.assert_close(renamed(weights), own(torch.tensor([[0.2, 0.7, 0.3, 0.7]])))


def test_arrays_and_lists_do_as_tensors_do(dome_rig: BlendshapeRig) -> None:
    given = dome_rig.neutral
    rig = BlendshapeRig.from_tensors(
        given.vertices.numpy(), given.faces.numpy(), dome_rig.deltas.numpy(), dome_rig.names
    )
    weights = [[0.5] * len(rig.names)]
    expected = dome_rig(torch.tensor(weights))
    for kind in (weights, np.array(weights), torch.tensor(weights, dtype=torch.float64)):
        torch.testing.assert_close(rig(kind), expected)
