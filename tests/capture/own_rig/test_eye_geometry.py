"""Eyeballs of rigs, and gaze that is seen as it was planted."""

from pathlib import Path

import pytest
import torch

from planted.seen_irises import irises
from torchface import load_take
from torchface.capture.own_rig.eye_geometry import (
    CORNERS,
    LOOKS,
    Eyeballs,
    gaze_of_looks,
    judged_openness,
    lid_followers,
    look_weights,
    openness_rows,
    seen_gaze,
    undrifted,
    with_following_lids,
)
from torchface.geometry.rotations import rotation_matrix
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer


def test_gaze_is_seen_as_planted() -> None:
    """Of heads that turn by up to 20 degrees, within two degrees: a camera sees eyes in perspective."""
    rig, generator = performer(texture=False), torch.Generator().manual_seed(3)
    gaze = 0.5 * (torch.rand(40, 1, 2, generator=generator).double() - 0.5).expand(-1, 2, -1)
    turn = 0.35 * (torch.rand(40, 3, generator=generator).double() - 0.5)
    rotation = torch.diag(torch.tensor([1.0, -1, -1]).double()) @ rotation_matrix(turn)
    translation = torch.tensor([0.0, 0, 600]).double().expand(40, 3)
    marks = rig.vertices[rig.neutral.landmarks].double() @ rotation.mT + translation[:, None]
    middle = torch.stack([0.5 * (marks[:, a] + marks[:, b]) for a, b in CORNERS], 1)
    seen = seen_gaze(
        marks[..., :2] / marks[..., 2:], irises(rig, gaze, rotation, translation), rotation, middle[..., 2],
        Eyeballs.of(rig),
    )  # fmt: skip
    assert float((seen - gaze).abs().max().rad2deg()) < 4
    assert float((seen - gaze).square().mean().sqrt().rad2deg()) < 2


def test_looks_and_gaze_are_inverse() -> None:
    turns = torch.linspace(0.4, 0.6, len(LOOKS)).double()
    gaze = 0.6 * (torch.rand(30, 2, 2, generator=torch.Generator().manual_seed(0)).double() - 0.5)
    weights = look_weights(gaze, turns)
    torch.testing.assert_close(gaze_of_looks(weights, turns), gaze)
    assert bool(((weights > 0).sum(1) == 4).all())  # never both of two antagonists


def test_irises_are_as_far_aside_as_beside_corners_that_do_not_follow_them() -> None:
    """Corners that follow the iris by a fifth of its way along a tilted eye; up and down nothing is added."""
    marks = torch.randn(68, 2, generator=torch.Generator().manual_seed(1)).double()
    along = torch.tensor([0.8, 0.6]).double()
    for a, b in CORNERS:
        marks[b] = marks[a] + 3 * along
    middle = torch.stack([0.5 * (marks[a] + marks[b]) for a, b in CORNERS])
    across = torch.tensor([-0.6, 0.8]).double()
    iris = middle + 0.5 * along + 0.2 * across
    drifted = marks.clone()
    drifted[[36, 39, 42, 45]] += 0.2 * 0.5 * along
    found = undrifted(drifted, iris) - (middle + 0.1 * along)
    torch.testing.assert_close(found, (0.5 * along + 0.2 * across).expand(2, 2))


def test_hidden_and_shut_eyes() -> None:
    part, closed = torch.tensor([[0.4, 1.0]]).double(), torch.tensor([[0.95, 0.0]]).double()
    opened, trust = judged_openness(part, closed, torch.tensor([[1.0, 1.0]]).double())
    assert opened.tolist() == [[0.0, 1.0]]
    assert trust.tolist() == [[1.0, 1.0]]
    opened, trust = judged_openness(part, torch.full_like(closed, torch.nan), torch.tensor([[0.0, 1.0]]).double())
    assert opened.tolist() == [[1.0, 1.0]]  # as its twin
    # Of an eye in the shade, that nobody calls shut, the other one says more than it does; a wink stays one.
    dim, sure = torch.tensor([[0.2, 0.8]]).double(), torch.ones(1, 2).double()
    assert float(judged_openness(dim, torch.tensor([[0.3, 0.02]]).double(), sure)[0].diff().abs()) < 0.15
    assert float(judged_openness(dim, torch.tensor([[0.95, 0.02]]).double(), sure)[0].diff().abs()) > 0.75
    assert 0 < float(trust[0, 0]) < 0.5


def test_lids_follow_eyes_that_look_up_and_leave_them_as_open() -> None:
    rig = performer(texture=False)
    names, landmarks = list(rig.names), rig.neutral.landmarks
    weights = torch.zeros(3, len(names))
    up, blink = names.index("eyeLookUpLeft"), names.index("eyeBlinkLeft")
    weights[:, up] = 0.8
    weights[1, blink] = 0.1
    weights[2, blink] = 0.6  # a blink
    lids = with_following_lids(weights, lid_followers(names)) - weights
    wide, squint = (lids[:, names.index(f"eye{name}Left")] for name in ("Wide", "Squint"))
    assert wide[0] > wide[1] > wide[2] == 0
    assert torch.equal(wide, squint)
    assert float(lids.sum()) == pytest.approx(float(wide.sum() + squint.sum()))  # no other shape, nor the other eye
    opened, _ = openness_rows(rig.vertices[landmarks], rig.deltas[:, landmarks].permute(1, 2, 0), names)
    assert float((opened @ lids[0]).abs().max()) < 0.02
    assert float(opened[1, names.index("eyeWideLeft")] * wide[0]) > 0.04


def test_a_rig_that_lacks_a_lid_is_left_alone() -> None:
    names = ["eyeLookUpLeft", "eyeSquintLeft", "eyeBlinkLeft"]
    weights = torch.tensor([0.5, 0.1, 0.0])
    assert torch.equal(with_following_lids(weights, lid_followers(names)), weights)


@pytest.mark.real
def test_lids_of_people_follow_by_more_than_what_is_added(performances: list[Path]) -> None:
    """A network reads a part of it, so what is added is near the least of six takes."""
    slopes = []
    for path in performances:
        track = load_take(path).weights
        weights = track.values[..., 0].double() @ mapping(track.names, ARKIT).double().T
        look, *lids = (weights[:, ARKIT.index(f"eye{name}Left")] for name in ("LookUp", "Wide", "Squint"))
        look = look - look.mean()
        slopes.append([float((look @ (lid - lid.mean())) / (look @ look)) for lid in lids])
    added = with_following_lids(torch.eye(52)[ARKIT.index("eyeLookUpLeft")], lid_followers(ARKIT))
    for lid, found in zip(("Wide", "Squint"), torch.tensor(slopes).T, strict=True):
        assert float(found.median()) > float(added[ARKIT.index(f"eye{lid}Left")]) > 0.2
        assert float(found.min()) > 0.15
