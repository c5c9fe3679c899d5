"""A finder whose lids a second network sees again: they move, and what it says of them is told."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from real_faces import by_hand, errors

from torchface.landmarks.images.landmark_finder import FoundLandmarks, confidence_of, find_in_box
from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS, eye_transforms
from torchface.landmarks.images.networks.eye_finder import EyeFinder
from torchface.landmarks.images.networks.eye_network import EyeFindings
from torchface.landmarks.images.networks.eyed_finder import EyedFinder
from torchface.workflows.named_finders import load_finder
from train.rendered_people.head_kind import performer_kind

BOX = torch.tensor([40.0, 40.0, 220.0, 220.0])


@pytest.fixture(scope="module")
def face() -> torch.Tensor:
    kind = performer_kind()
    marks = kind.draw(torch.Generator().manual_seed(0)).rest[kind.landmarks][:, :2]
    return marks * torch.tensor([1.0, -1.0]) + 150


def test_lids_become_surer_and_move_to_what_is_seen_from_near(face: torch.Tensor) -> None:
    """Both networks are equally sure: lids lie half-way, and the deviation falls to its root."""

    def whole(image: torch.Tensor, box: torch.Tensor, tilt: float = 0.0) -> FoundLandmarks:
        return FoundLandmarks(face, confidence_of(torch.full((68,), 3.0 / 220)), torch.ones(68), 1.0)

    scale = []

    def near(crops: torch.Tensor) -> EyeFindings:
        middle, one = torch.tensor([23.5, 15.5]), torch.ones(2)
        return EyeFindings(
            middle.expand(2, 6, 2), middle.expand(2, 2), torch.full((2, 7), 3.0 * scale[0]), 0.2 * one, 0 * one, one
        )

    scale.append(float(eye_transforms(face)[0, 0, :2].norm()))
    finder = EyedFinder(whole, EyeFinder(near, 48, 32))
    image = torch.zeros(3, 300, 300, dtype=torch.uint8)
    found, reading = find_in_box(finder, image, BOX), finder.read(image, BOX)
    corners = face[[36, 39, 42, 45]].view(2, 2, 2).mean(1)
    for eye, rows in enumerate(EYE_LANDMARKS):
        expected = (face[list(rows)] + corners[eye]) / 2
        torch.testing.assert_close(found.landmarks[list(rows)], expected, atol=1e-2, rtol=0)
    assert torch.equal(found.landmarks[48:], face[48:])
    torch.testing.assert_close(reading.deviation[36:48], torch.full((12,), 3 / 2**0.5), atol=1e-2, rtol=0)
    torch.testing.assert_close(found.confidence, confidence_of(reading.deviation / 220))
    torch.testing.assert_close(reading.iris, corners, atol=1e-2, rtol=0)
    assert float(reading.presence) == 1.0
    torch.testing.assert_close(reading.openness, torch.full((2,), 0.2))


@pytest.mark.real
def test_lids_of_photographs_lie_nearer_to_where_people_put_them(data: Path) -> None:
    pictures = by_hand(data)
    finder = load_finder().finder
    assert isinstance(finder, EyedFinder)
    off = [errors(one, pictures, seeds=2)[..., 36:48, :].norm(dim=-1).mean() for one in (finder.finder, finder)]
    assert float(off[1]) < 0.9 * float(off[0])
    assert float(off[1]) < 0.028
