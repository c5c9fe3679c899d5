"""Who is followed is not lost to another's place."""

import torch
from torch import Tensor

from torchface.landmarks.images.person_identity import (
    CANDIDATES,
    IDENTITY,
    LOOK_SIZE,
    after_boxes,
    after_face,
    face_look,
    is_other,
)

STEP, YES, NO = torch.tensor(1 / 25), torch.tensor(True), torch.tensor(False)
OWN = torch.tensor([500.0, 185.0, 180.0, 1.0])


def boxes(*faces: Tensor) -> Tensor:
    return torch.cat([torch.stack(faces), torch.zeros(CANDIDATES - len(faces), 4)])


def colors(count: int, seed: int) -> Tensor:
    return torch.rand(count, 3, LOOK_SIZE, LOOK_SIZE, generator=torch.Generator().manual_seed(seed))


def test_who_comes_out_half_hidden_does_not_become_the_other() -> None:
    """Half a face looks like nobody: it was taken for the other's, and the person for the other ever after."""
    known, strange = (face_look(one) for one in colors(2, seed=1))
    state = torch.zeros(IDENTITY)
    for frame in range(70):
        other = torch.tensor([100.0 + 12 * frame, 150.0, 130.0, 1.0])
        past = float(other[0] - OWN[0])
        if past < -120:
            state = after_boxes(state, boxes(other, OWN), YES, STEP)
            state = after_face(state, OWN[:3], known, (YES, NO), STEP)
        elif past < 120:
            state = after_boxes(state, boxes(other), YES, STEP)
        else:  # it comes out, at first half hidden and without the other's box
            seen = OWN + torch.tensor([2.0, 1.0, 4.0, 0.0])
            share = min((past - 120) / 100, 1.0)
            look = face_look(share * known + (1 - share) * strange)
            state = after_boxes(state, boxes(seen) if past < 135 else boxes(other, seen), YES, STEP)
            mistaken = bool(is_other(state, seen[:3], look, STEP))
            state = after_face(state, seen[:3], look, (~torch.tensor(mistaken), torch.tensor(mistaken)), STEP)
    assert not mistaken


def test_somebody_who_was_not_noticed_is_not_taken_for_who_is_hidden() -> None:
    known, strange = (face_look(one) for one in colors(2, seed=2))
    state = torch.zeros(IDENTITY)
    for _ in range(10):
        state = after_face(after_boxes(state, boxes(OWN), YES, STEP), OWN[:3], known, (YES, NO), STEP)
    for _ in range(4):
        state = after_boxes(state, torch.zeros(CANDIDATES, 4), YES, STEP)
    assert bool(is_other(state, torch.tensor([400.0, 180.0, 140.0]), strange, STEP))
    assert not bool(is_other(state, torch.tensor([400.0, 180.0, 180.0]), known, STEP))
