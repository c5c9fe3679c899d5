"""Who is followed is not lost to another's place."""

import pytest
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
    other = torch.tensor([400.0, 180.0, 140.0, 1.0])
    state = alone(known)
    for _ in range(4):
        state = after_boxes(state, boxes(other), YES, STEP)
    assert bool(is_other(state, other[:3], strange, STEP))
    assert not bool(is_other(state, other[:3], known, STEP))


@pytest.mark.parametrize("lost", [1, 2, 10])
@pytest.mark.parametrize("place", [(500.0, 185.0, 180.0), (400.0, 180.0, 140.0)])
def test_one_alone_who_turned_or_was_lit_otherwise_while_lost_is_found(
    lost: int, place: tuple[float, float, float]
) -> None:
    known, turned = (face_look(one) for one in colors(2, seed=3))
    state, here = alone(known), torch.tensor([*place, 1.0])
    for _ in range(lost):
        state = after_boxes(state, torch.zeros(CANDIDATES, 4), YES, STEP)
    state = after_boxes(state, boxes(here), YES, STEP)
    assert not bool(is_other(state, here[:3], turned, STEP))


def test_who_turns_back_where_a_picture_on_the_wall_looks_like_a_face_is_found() -> None:
    known, turned = (face_look(one) for one in colors(2, seed=4))
    picture = torch.tensor([60.0, 80.0, 60.0, 0.6])
    state = after_boxes(alone(known), boxes(OWN, picture), YES, STEP)
    state = after_face(state, OWN[:3], known, (YES, NO), STEP)
    for _ in range(10):
        state = after_boxes(state, boxes(picture), YES, STEP)
    state = after_boxes(state, boxes(OWN, picture), YES, STEP)
    assert not bool(is_other(state, OWN[:3], turned, STEP))
    assert bool(is_other(state, picture[:3], turned, STEP))


def alone(look: Tensor) -> Tensor:
    """What is known of one person after ten frames."""
    state = torch.zeros(IDENTITY)
    for _ in range(10):
        state = after_face(after_boxes(state, boxes(OWN), YES, STEP), OWN[:3], look, (YES, NO), STEP)
    return state
