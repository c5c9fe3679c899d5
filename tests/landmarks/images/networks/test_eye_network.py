"""The eye network learns what rendered eyes show, and a finder gives it back in the picture's pixels."""

import pytest
import torch
from torch.utils.data import TensorDataset

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.networks.eye_augmentation import EyeAugmentation, EyeLabels, augmented_eyes
from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS, eye_transforms, moved
from torchface.landmarks.images.networks.eye_finder import EyeFinder, face_without_eyes
from torchface.landmarks.images.networks.eye_network import EyeFindings, EyeNetwork
from torchface.landmarks.images.networks.eye_training import EyeSettings
from train.rendered_people.eye_picture import EyePicture, draw_eye_pictures
from train.rendered_people.head_kind import performer_kind

PLAIN = EyeAugmentation(turn=0, scale=0, shift=0, hidden=0, absent=0, far=0)
ASIDE = EyeAugmentation(turn=0, scale=0, shift=0.3, hidden=0, absent=0, far=0)


@pytest.fixture(scope="module")
def pictures() -> list[EyePicture]:
    return draw_eye_pictures((performer_kind(),), (1.0,), 0, 6, seed=3, each=3)


@pytest.fixture(scope="module")
def labels(pictures: list[EyePicture]) -> EyeLabels:
    names = ("landmarks", "visible", "iris", "openness", "bare")
    return EyeLabels(*(torch.stack([getattr(one, name) for one in pictures]) for name in names))


def test_irises_are_where_eyes_are_dark(pictures: list[EyePicture], labels: EyeLabels) -> None:
    """In wide open eyes the pupil is darker than the white beside it."""
    checked = 0
    for one in pictures:
        for eye in range(2):
            x, y = one.iris[eye].round().long().tolist()
            if one.bare[eye] > 90 and not one.gaze[eye].abs().max() > 0.4:
                grey = one.rgba[:3].float().mean(0)
                assert float(grey[y, x]) < 0.6 * float(grey[y - 1 : y + 2, x - 14 : x + 15].max())
                checked += 1
    assert checked >= 2
    assert bool((labels.bare[labels.openness < 0.02] < 12).all())  # shut eyes show no eyeball


def test_points_of_crops_are_those_of_the_picture_in_the_mirror_too(
    pictures: list[EyePicture], labels: EyeLabels
) -> None:
    rgba = torch.stack([one.rgba for one in pictures])
    for eye in range(2):
        eyes = torch.full((len(rgba),), eye)
        crops = augmented_eyes(rgba, labels, eyes, 48, 32, torch.Generator().manual_seed(0), PLAIN)
        transforms = eye_transforms(labels.landmarks)[:, eye]
        expected = torch.cat([labels.landmarks[:, list(EYE_LANDMARKS[eye])], labels.iris[:, eye, None]], 1)
        torch.testing.assert_close(crops.points, moved(expected, transforms), atol=1e-3, rtol=0)
        assert bool((crops.points[:, 0, 0] < crops.points[:, 3, 0]).all())  # outer corners lie to the left
        assert bool((crops.closed[labels.bare[:, eye] < 5] == 1).all())


def test_training_finds_lids_and_irises(pictures: list[EyePicture], labels: EyeLabels) -> None:
    rgba = torch.stack([one.rgba for one in pictures])
    torch.manual_seed(0)
    small = EyeNetwork(channels=(12, 16, 16), hidden=8)
    settings = EyeSettings(steps=110, batch=16, rate=1e-2, average=0.9, augmentation=ASIDE)
    network = EyeNetwork.fit(TensorDataset(rgba, *vars(labels).values()), small, settings)
    offsets, spread, gaps = [], [], []
    for eye in range(2):
        eyes = torch.full((len(rgba),), eye)
        crops = augmented_eyes(rgba, labels, eyes, 48, 32, torch.Generator().manual_seed(1), ASIDE)
        with torch.no_grad():
            found = network(crops.images)
        seen = crops.seen[:, :6] > 0
        offsets.append((found.landmarks - crops.points[:, :6])[seen])
        spread.append((crops.points[:, :6] - crops.points[:, :6].mean(0))[seen])
        gaps.append(torch.stack([found.openness, crops.openness]))
    # Nearer than the mean eye is, in crops that are dark, grey, blurred and compressed by chance.
    assert float(torch.cat(offsets).norm(dim=1).median()) < 0.75 * float(torch.cat(spread).norm(dim=1).median())
    assert float(torch.corrcoef(torch.cat(gaps, 1))[0, 1]) > 0.8


def test_a_finder_gives_pixels_of_the_picture(labels: EyeLabels) -> None:
    """A network that says where its crops' middles are puts both irises there, and a sure one draws the lids there."""
    landmarks = 2 * labels.landmarks[0]

    def network(crops: torch.Tensor) -> EyeFindings:
        middle = torch.tensor([23.5, 15.5])
        one = torch.ones(2)
        return EyeFindings(middle.expand(2, 6, 2), middle.expand(2, 2), torch.full((2, 7), 1e-3), one, one, one)

    image = torch.zeros(3, 200, 400, dtype=torch.uint8)
    before = face_without_eyes(landmarks, torch.ones(68), torch.ones(68), torch.tensor(1.0))
    face = EyeFinder(network, 48, 32)(image, before)
    corners = landmarks[[36, 39, 42, 45]].view(2, 2, 2).mean(1)
    torch.testing.assert_close(face.iris, corners, atol=1e-2, rtol=0)
    torch.testing.assert_close(face.landmarks[36:48], corners.repeat_interleave(6, 0), atol=1e-2, rtol=0)
    assert torch.equal(face.landmarks[:36], landmarks[:36])
    nobody = face_without_eyes(torch.full((68, 2), torch.nan), torch.ones(68), torch.ones(68), torch.tensor(0.0))
    assert bool(EyeFinder(network, 48, 32)(image, nobody).iris.isnan().all())
    tiny = face_without_eyes(landmarks / 30, torch.ones(68), torch.ones(68), torch.tensor(1.0))
    assert bool(EyeFinder(network, 48, 32)(image, tiny).iris.isnan().all())


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="multiples of 8"):
        EyeNetwork(50, 32)
    with pytest.raises(ShapeError, match="expected"):
        EyeNetwork().eval()(torch.zeros(1, 3, 48, 32))
    assert EyeNetwork.from_config(EyeNetwork(hidden=5).config).config == EyeNetwork(hidden=5).config
