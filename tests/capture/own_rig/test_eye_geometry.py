"""Eyeballs of rigs, and gaze that is seen as it was planted."""

import torch

from planted.seen_irises import irises
from torchface.capture.own_rig.eye_geometry import (
    CORNERS,
    LOOKS,
    Eyeballs,
    gaze_of_looks,
    judged_openness,
    look_weights,
    seen_gaze,
    undrifted,
)
from torchface.geometry.rotations import rotation_matrix
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
