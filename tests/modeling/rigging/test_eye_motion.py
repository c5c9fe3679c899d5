"""Plates on which an eye is drawn slide behind the lids as far as an eyeball's pole goes."""

import pytest
import torch
from torch import Tensor

from torchface.landmarks.surfaces.eye_openings import Opening
from torchface.modeling.rigging.eye_motion import eyeballs, slid
from torchface.modeling.rigging.joined_vertices import JoinedHead
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

SHAPES = ("eyeLookUpLeft", "eyeLookOutLeft", "eyeBlinkLeft")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(SHAPES)


def plate(middle: Tensor, across: float, up: float, count: int) -> Tensor:
    x, y = torch.meshgrid(torch.linspace(-1, 1, count).double(), torch.linspace(-1, 1, count).double(), indexing="ij")
    return middle + torch.stack([across * x, up * y, torch.zeros_like(x)], -1).reshape(-1, 3)


def moved(rig: BlendshapeRig, width: float, *plates: tuple[float, float, int]) -> tuple[Tensor, list[Tensor], Tensor]:
    """What slid (J,), each plate's ways (N,n,3), and the pole's (N,3); plates by depth, half width and fineness."""
    eyeball = eyeballs(rig)[0]
    ball = rig.vertices.double()[eyeball]
    middle = (ball.amax(0) + ball.amin(0)) / 2 + torch.tensor([0.0, 0.0, 14.0])
    share = torch.linspace(0, 1, 21).double()
    x, bow = width * (share - 0.5), 12 * share * (1 - share)
    upper, lower = (middle + torch.stack([x, sign * bow, torch.zeros_like(x)], 1) for sign in (1, -1))
    pieces = [plate(middle - torch.tensor([0.0, 0.0, deep]), half, half, count) for deep, half, count in plates]
    points = torch.cat(pieces)
    part = torch.arange(len(pieces)).repeat_interleave(torch.tensor([len(one) for one in pieces]))
    everything = torch.ones(len(points), dtype=torch.bool)
    head = JoinedHead(points, part, everything, torch.ones(len(SHAPES), len(points), 3).double())
    own = slid(head, rig, eyeball, Opening(upper, lower, share), everything)
    pole = rig.deltas.double()[:, eyeball.nonzero()[:, 0][ball[:, 2].argmax()]]
    return own, [head.deltas[:, part == one] for one in range(len(pieces))], pole


def test_an_iris_before_a_white_slides_in_its_plane_and_the_white_stays(rig: BlendshapeRig) -> None:
    own, (white, iris, light), pole = moved(rig, 30.0, (8.0, 20.0, 2), (7.0, 8.0, 2), (6.0, 1.0, 2))
    assert bool(own.all())
    assert float(white.abs().max()) == 0
    for one in (iris, light):
        assert torch.allclose(one[:2, :, :2], pole[:2, None, :2].expand_as(one[:2, :, :2]))
        assert float(one[..., 2].abs().max()) == 0
    assert float(pole[0, 1]) > 3  # up
    assert float(iris[2].abs().max()) < 0.5  # does not blink


def test_the_middle_of_an_only_plate_slides_and_its_rim_stays(rig: BlendshapeRig) -> None:
    _, (eye, light), pole = moved(rig, 60.0, (8.0, 34.0, 9), (7.0, 2.0, 2))
    assert torch.allclose(eye[:2, 40, :2], 2 * pole[:2, :2])  # twice a person's opening
    assert torch.equal(eye[:, [0, 8, 72, 80]], torch.zeros(len(SHAPES), 4, 3).double())
    assert torch.allclose(light[:2, 0, :2], 2 * pole[:2, :2])


def test_lashes_before_the_lids_and_plates_beside_the_eye_do_not_slide(rig: BlendshapeRig) -> None:
    own, (lashes, _), _ = moved(rig, 30.0, (-2.0, 14.0, 3), (8.0, 20.0, 2))
    assert float(lashes.min()) == 1
    assert own.tolist() == [False] * 9 + [True] * 4
