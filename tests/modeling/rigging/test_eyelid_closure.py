"""Blinks that leave eyes half open are made to shut them, before what lies in the eye; the rest of the face stays."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.modeling.rigging.eyelid_closure import (
    BLINKS,
    SkinOfHead,
    _before_the_eye,
    eyes_seen,
    lids_looking_down,
    shut_blinks,
)
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    return performer(texture=False).select(BLINKS)


def head_of(actor: BlendshapeRig, eyes: bool = True) -> tuple[SkinOfHead, Tensor]:
    mesh = actor.neutral
    regions = mesh.annotations.regions
    balls = regions["eyeball_left"].long() + 2 * regions["eyeball_right"].long()
    faces = mesh.faces if eyes else mesh.faces[balls[mesh.faces].amax(1) == 0]
    head = SkinOfHead(mesh.vertices.double(), faces, balls > 0, balls)
    return head, head.vertices[mesh.landmarks]


@pytest.mark.parametrize("eyes", [True, False])
def test_half_a_blink_is_made_whole(actor: BlendshapeRig, eyes: bool) -> None:
    head, marks = head_of(actor, eyes)
    openings = eyes_seen(head, marks)
    half = 0.5 * actor.deltas.double()
    shut, left = shut_blinks(head, half, actor.names, openings)
    assert max(left) < 0.08
    whole = shut_blinks(head, shut, actor.names, openings)[0]
    assert float((whole - shut).abs().max()) < 1.0  # nothing is left to do
    for row, opening in enumerate(openings):
        corners, seen = marks[36 + 6 * row : 42 + 6 * row, 0], opening.upper[:, 0]
        assert corners.min() - 1 < seen.min() < seen.max() < corners.max() + 1
        assert float(seen.max() - seen.min()) > 0.7 * float(corners.max() - corners.min())
        middle = marks[[37 + 6 * row, 41 + 6 * row]].mean(0)
        lids = ((head.vertices - middle).norm(dim=-1) < 12) & ~head.loose
        assert float((shut[row] - actor.deltas[row])[lids].norm()) < 0.7 * float(
            (half[row] - actor.deltas[row])[lids].norm()
        )
    moved = (shut - half).norm(dim=-1).amax(0) > 0
    assert not bool(moved[actor.neutral.annotations.regions["chin"]].any())
    assert not bool(moved[head.loose].any())


def test_upper_lid_goes_along_with_its_edge(actor: BlendshapeRig) -> None:
    head, marks = head_of(actor)
    upper = eyes_seen(head, marks)[0].upper
    away, nearest = torch.cdist(head.vertices, upper).min(1)
    edge_alone = actor.deltas.double() * torch.exp(-((away / 0.8) ** 2))[:, None]
    shut = shut_blinks(head, edge_alone, actor.names, eyes_seen(head, marks))[0][0]
    beside = head.vertices - upper[nearest]
    middle = (beside[:, 0].abs() < 1) & ((upper[nearest, 0] - upper[:, 0].mean()).abs() < 6)
    lid = middle & (beside[:, 1] > 0.5) & (away < 2.2) & (beside[:, 2] > 0)
    assert int(lid.sum()) > 2
    assert float(shut[lid, 1].max()) < 0.7 * float(shut[:, 1].min())
    assert float(edge_alone[0, lid, 1].min()) > 0.4 * float(actor.deltas[0, :, 1].min())


def test_lids_of_other_shapes_follow_as_far_as_the_template_s() -> None:
    names = ["eyeLookDownLeft", "eyeLookUpLeft", "eyeWideLeft"]
    actor = performer(texture=False).select([*BLINKS, *names])
    head, marks = head_of(actor)
    openings, shares = eyes_seen(head, marks), lids_looking_down(actor)
    assert shares[0] is None
    assert shares[1] == pytest.approx(0.66, abs=0.01)
    edge = torch.cat([openings[1].upper, openings[1].lower])
    lids = (torch.cdist(head.vertices, edge).amin(1) < 2) & ~head.loose
    whole = actor.deltas.double()
    less = torch.cat([whole[:2], 0.6 * whole[2:]])
    made = shut_blinks(head, less, actor.names, openings, looking_down=shares)[0]
    for row in (2, 3, 4):
        assert float((made[row] - whole[row])[lids].norm()) < 0.4 * float((less[row] - whole[row])[lids].norm())
    same = shut_blinks(head, whole, actor.names, openings, looking_down=shares)[0]
    assert float((same[2:] - whole[2:])[:, lids].norm(dim=-1).max()) < 0.4


def test_a_fold_of_the_open_lid_is_flatter_when_the_eye_is_shut(actor: BlendshapeRig) -> None:
    head, marks = head_of(actor)
    openings = eyes_seen(head, marks)
    blinks = actor.deltas.double()
    for row, opening in enumerate(openings):
        line = opening.upper + torch.tensor([0.0, 4.0, 0.0], dtype=torch.float64)
        apart = torch.cdist(head.vertices[:, :2], line[:, :2]).amin(1)
        fold = 0.8 * torch.exp(-((apart / 1.1) ** 2)) * ~head.loose * (head.vertices[:, 2] > opening.upper[:, 2].min())
        folded = replace(head, vertices=head.vertices + fold[:, None] * torch.tensor([0.0, 0.0, 1.0]))
        apart = torch.full_like(fold, 1.5)  # as of a stranger's lids
        plain = (head.vertices + shut_blinks(head, blinks, actor.names, openings, apart)[0][row])[:, 2]
        shut = (folded.vertices + shut_blinks(folded, blinks, actor.names, openings, apart)[0][row])[:, 2]
        middle = opening.upper.mean(0)
        rays = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(head.vertices)
        posed = torch.cat([head.vertices[:, :2], plain[:, None]], 1)
        posed[:, :2] += shut_blinks(head, blinks, actor.names, openings, apart)[0][row][:, :2]
        seen = RayCaster(posed, head.skin).distances(posed + 0.3 * rays, rays, 50.0) >= 50.0
        there = (fold > 0.4) & ((head.vertices - middle)[:, 0].abs() < 12) & seen
        assert int(there.sum()) > 10
        assert float((shut - plain)[there].abs().mean()) < 0.85 * float(fold[there].mean())


def test_painted_eyes_have_no_opening(actor: BlendshapeRig) -> None:
    head, marks = head_of(actor)
    whole = SkinOfHead(head.vertices, head.faces, torch.zeros_like(head.loose), head.part)
    assert eyes_seen(whole, marks) == [None, None]
    half = 0.5 * actor.deltas.double()
    same, left = shut_blinks(whole, half, actor.names, [None, None])
    assert torch.equal(same, half)
    assert left == (None, None)
    assert eyes_seen(head, torch.full_like(marks, torch.nan)) == [None, None]


def test_a_large_triangle_of_a_lid_goes_before_a_round_eye(actor: BlendshapeRig) -> None:
    head, _ = head_of(actor)
    ball = actor.neutral.annotations.regions["eyeball_left"]
    points, eye = head.vertices[ball], head.faces[ball[head.faces].all(1)]
    middle, front = points.mean(0), float(points[:, 2].max())
    corners = torch.tensor([[-16, -13, 0], [16, -13, 0], [0, 16, 0]]).double() + middle
    corners[:, 2] = front - 1.0  # before the eye at its corners, which lie beside it, and 1 mm behind its front
    first = len(head.vertices)
    lid = SkinOfHead(torch.cat([head.vertices, corners]), torch.arange(first, first + 3)[None], head.loose, head.part)
    rows = torch.arange(first, first + 3)
    whole = replace(lid, faces=torch.cat([lid.faces, eye]), loose=torch.cat([ball, torch.zeros(3, dtype=torch.bool)]))
    moved = _before_the_eye(whole, eye, torch.zeros(first + 3, 3).double(), rows)
    assert bool((corners[:, 2] + moved[rows, 2] > front - 0.6).all())  # one of the places looked at is near the front
    assert float(moved[rows, 2].max()) < 1.5


def test_a_sockets_lining_behind_shut_lids_stays(actor: BlendshapeRig) -> None:
    head, marks = head_of(actor)
    ball = head.vertices[head.part == 2]
    middle, reach = ball.mean(0), float(ball[:, 0].max() - ball[:, 0].min()) / 2 + 1
    across = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    count = len(head.vertices)
    lined = SkinOfHead(
        torch.cat([head.vertices, middle + reach * across]),
        torch.cat([head.faces, count + torch.arange(3)[None]]),
        torch.cat([head.loose, torch.zeros(3, dtype=torch.bool)]),
        torch.cat([head.part, torch.zeros(3, dtype=torch.int64)]),
    )
    blinks = torch.cat([actor.deltas.double(), torch.zeros(2, 3, 3, dtype=torch.float64)], 1)
    shut = shut_blinks(lined, blinks, actor.names, eyes_seen(lined, marks))[0]
    row = actor.names.index("eyeBlinkRight" if middle[0] < 0 else "eyeBlinkLeft")
    assert float(shut[row, count:].abs().max()) < 0.1
