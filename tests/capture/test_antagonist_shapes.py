"""Antagonists are one quantity with a sign, whatever a rig calls them."""

import torch

from torchface.capture.antagonist_shapes import one_side, signed_difference, signed_quantities, weaker_sides
from torchface.shape_names import ANTAGONISTS, ARKIT, antagonists, mirror


def test_arkits_antagonists_are_pairs_that_do_not_overlap() -> None:
    pairs = antagonists(ARKIT)
    assert len(pairs) == 12  # of cheekSuck there is none
    assert len(pairs.unique()) == 24
    assert {one for pair in ANTAGONISTS for one in pair} >= {"mouthLeft", "browOuterUp", "cheekSuck"}


def test_a_face_in_the_mirror_has_the_same_antagonists() -> None:
    twin = mirror(ARKIT)
    pairs = {frozenset(pair) for pair in antagonists(ARKIT).tolist()}
    assert pairs == {frozenset(pair) for pair in twin[antagonists(ARKIT)].tolist()}


def test_the_smaller_of_two_rests_and_equal_ones_are_free() -> None:
    signed = signed_quantities(["jawLeft", "jawOpen", "jawRight"])
    weights = torch.tensor([[0.2, 0.9, 0.3], [0.3, 0.9, 0.2], [0.0, 0.0, 0.0], [0.2, 0.1, 0.2]])
    expected = [[True, False, False], [False, False, True], [False] * 3, [False] * 3]
    assert weaker_sides(weights, signed).tolist() == expected
    assert torch.equal(one_side(weights, signed)[:2], torch.tensor([[0.0, 0.9, 0.3], [0.3, 0.9, 0.0]]))


def test_the_difference_keeps_the_quantity() -> None:
    signed = signed_quantities(ARKIT)
    weights = torch.rand(20, 52, generator=torch.Generator().manual_seed(0))
    found = signed_difference(weights, signed)
    assert torch.allclose(found @ signed.T.float(), weights @ signed.T.float(), atol=1e-6)
    first, second = antagonists(ARKIT).T
    assert float(torch.minimum(found[:, first], found[:, second]).max()) == 0
    alone = signed.abs().sum(0) == 0
    assert torch.equal(found[:, alone], weights[:, alone])
