"""The eye finder: pixels of the picture, lids of two networks by their variances, irises and openings."""

from pathlib import Path

import pytest
import torch
from real_faces import by_hand, errors

from torchface.landmarks import EyeFindings, FaceReading
from torchface.landmarks.images.landmark_finder import find_in_box
from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS, eye_transforms
from torchface.landmarks.images.networks.eye_finder import EyedFinder, EyeFinder, merged_lids
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

    def whole(image: torch.Tensor, box: torch.Tensor, tilt: float = 0.0) -> FaceReading:
        return FaceReading(face, torch.full((68,), 3.0), torch.ones(68), torch.tensor(1.0))

    scale = []

    def near(crops: torch.Tensor) -> EyeFindings:
        middle, one = torch.tensor([23.5, 15.5]), torch.ones(2)
        return EyeFindings(
            middle.expand(2, 6, 2), middle.expand(2, 2), torch.full((2, 7), 3.0 * scale[0]), 0.2 * one, 0 * one, one
        )

    scale.append(float(eye_transforms(face)[0, 0, :2].norm()))
    finder = EyedFinder(whole, EyeFinder(near, 48, 32))
    image = torch.zeros(3, 300, 300, dtype=torch.uint8)
    reading = find_in_box(finder, image, BOX)
    corners = face[[36, 39, 42, 45]].view(2, 2, 2).mean(1)
    for eye, rows in enumerate(EYE_LANDMARKS):
        expected = (face[list(rows)] + corners[eye]) / 2
        torch.testing.assert_close(reading.landmarks[list(rows)], expected, atol=1e-2, rtol=0)
    assert torch.equal(reading.landmarks[48:], face[48:])
    torch.testing.assert_close(reading.deviation[36:48], torch.full((12,), 3 / 2**0.5), atol=1e-2, rtol=0)
    torch.testing.assert_close(reading.iris, corners, atol=1e-2, rtol=0)
    assert float(reading.presence) == 1.0
    torch.testing.assert_close(reading.openness, torch.full((2,), 0.2))


@pytest.mark.real
def test_lids_of_photographs_lie_where_people_put_them(data: Path) -> None:
    pictures = by_hand(data)
    finder = load_finder().finder
    assert isinstance(finder, EyedFinder)
    off = [errors(one, pictures, seeds=2)[..., 36:48, :].norm(dim=-1).mean() for one in (finder.finder, finder)]
    assert float(off[1]) < float(off[0])
    assert float(off[1]) < 0.027


def test_lids_lie_between_by_inverse_variance_and_stay_where_the_eye_is_hidden() -> None:
    generator = torch.Generator().manual_seed(0)
    landmarks = 100 * torch.rand(3, 68, 2, generator=generator)
    offset = torch.tensor([4.0, -2.0])
    lids = torch.stack([landmarks[:, list(rows)] + offset for rows in EYE_LANDMARKS], 1)
    visibility = torch.tensor([[1.0, 0.1], [0.9, 0.9], [0.55, 0.0]])
    found, deviation = merged_lids(landmarks, torch.full((3, 68), 3.0), lids, torch.full((3, 2, 6), 1.0), visibility)
    # A ninth of the variance moves a landmark nine tenths of the way; half a share of it 4.5 / 5.5.
    share = torch.tensor([[0.9, 0.0], [0.9, 0.9], [4.5 / 5.5, 0.0]]).repeat_interleave(6, 1)
    torch.testing.assert_close(found[:, 36:48], landmarks[:, 36:48] + share[..., None] * offset)
    torch.testing.assert_close(deviation[:, 36:48], 3 * (1 - share).sqrt())
    outside = [*range(36), *range(48, 68)]
    assert torch.equal(found[:, outside], landmarks[:, outside])
    assert bool((deviation[:, outside] == 3).all())


def test_a_finder_gives_pixels_of_the_picture(face: torch.Tensor) -> None:
    """A network that says where its crops' middles are puts both irises there, and a sure one draws the lids there."""
    landmarks = face

    def network(crops: torch.Tensor) -> EyeFindings:
        middle = torch.tensor([23.5, 15.5])
        one = torch.ones(2)
        return EyeFindings(middle.expand(2, 6, 2), middle.expand(2, 2), torch.full((2, 7), 1e-3), one, one, one)

    image = torch.zeros(3, 200, 400, dtype=torch.uint8)
    before = FaceReading(landmarks, torch.ones(68), torch.ones(68), torch.tensor(1.0))
    found = EyeFinder(network, 48, 32)(image, before)
    corners = landmarks[[36, 39, 42, 45]].view(2, 2, 2).mean(1)
    torch.testing.assert_close(found.iris, corners, atol=1e-2, rtol=0)
    torch.testing.assert_close(found.landmarks[36:48], corners.repeat_interleave(6, 0), atol=1e-2, rtol=0)
    assert torch.equal(found.landmarks[:36], landmarks[:36])
    nobody = FaceReading(torch.full((68, 2), torch.nan), torch.ones(68), torch.ones(68), torch.tensor(0.0))
    assert bool(EyeFinder(network, 48, 32)(image, nobody).iris.isnan().all())
    tiny = FaceReading(landmarks / 30, torch.ones(68), torch.ones(68), torch.tensor(1.0))
    assert bool(EyeFinder(network, 48, 32)(image, tiny).iris.isnan().all())
