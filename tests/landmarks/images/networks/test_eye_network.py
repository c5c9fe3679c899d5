"""The eye network learns what rendered eyes show."""

import pytest
import torch
from torch.utils.data import TensorDataset

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.networks.eye_augmentation import EyeAugmentation, EyeLabels, augmented_eyes
from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS, eye_transforms, moved
from torchface.landmarks.images.networks.eye_network import EyeNetwork
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


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="multiples of 8"):
        EyeNetwork(50, 32)
    with pytest.raises(ShapeError, match="expected"):
        EyeNetwork().eval()(torch.zeros(1, 3, 48, 32))
    assert EyeNetwork.from_config(EyeNetwork(hidden=5).config).config == EyeNetwork(hidden=5).config
