"""The landmark network: heat maps read by their means, training that goes on where it stopped, the graph."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.utils.data import TensorDataset

from torchface import zoo
from torchface.errors import ShapeError, ValueRangeError
from torchface.io import load_image, load_landmark_points
from torchface.landmarks import LandmarkNetwork, NetworkSettings
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.ibug_68 import INNER, MIRROR_68, box_around
from torchface.landmarks.images.networks.crop_finder import BothSides
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings, augmented
from torchface.workflows.named_finders import load_finder
from train.rendered_people.face_picture import draw_pictures
from train.rendered_people.head_kind import performer_kind

SMALL = {"size": 64, "margin": 1.25, "channels": (8, 12, 16, 24), "blocks": (1, 1, 1), "decoder": 16}
CALM = AugmentationSettings(turn=0.0, scale=0.0, shift=0.0, hidden=0.0, absent=0.0, grey=0.0)


@pytest.fixture(scope="module")
def pictures() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    drawn = draw_pictures((performer_kind(),), (1.0,), 0, 4, seed=2)
    return tuple(torch.stack([getattr(one, name) for one in drawn]) for name in ("rgba", "landmarks", "visible"))


@pytest.fixture(scope="module")
def network() -> LandmarkNetwork:
    torch.manual_seed(3)
    return LandmarkNetwork(**SMALL).eval()


def test_a_heat_map_with_one_hot_cell_is_read_at_its_place(network: LandmarkNetwork) -> None:
    heat = torch.full((1, 68, 16, 16), -60.0)
    rows, columns = torch.arange(68) // 16 + 3, torch.arange(68) % 16
    heat[0, torch.arange(68), rows, columns] = 60.0
    found = network.read(heat, torch.zeros(1, 16, 16, 16), torch.zeros(1, 24, 4, 4)).landmarks[0]
    # Four pixels a cell, pixel centres at integers: the first cell's middle is at 1.5.
    torch.testing.assert_close(found, torch.stack([4.0 * columns + 1.5, 4.0 * rows + 1.5], dim=1))


@pytest.mark.bench  # test_dense_head.py trains a network with more outputs
def test_training_finds_what_is_there_to_be_seen(pictures: tuple[torch.Tensor, ...]) -> None:
    torch.manual_seed(0)
    untrained = LandmarkNetwork(**SMALL)
    settings = NetworkSettings(steps=40, batch=8, rate=8e-3, average=0.8, workers=0, bfloat16=0.5, augmentation=CALM)
    crops = augmented(*pictures, 64, 1.25, torch.Generator().manual_seed(9), CALM)

    @torch.no_grad()
    def error(network: LandmarkNetwork) -> float:
        return float((network(crops.images).landmarks - crops.landmarks).norm(dim=-1).mean())

    before = error(untrained.eval())
    assert error(LandmarkNetwork.fit(TensorDataset(*pictures), untrained, settings)) < 0.6 * before


def test_a_network_of_another_size_computes_the_same() -> None:
    torch.manual_seed(2)
    network, crops = LandmarkNetwork(**SMALL).eval(), torch.rand(1, 3, 96, 96)
    other = network.resized(96)
    assert other.size == 96
    for found, expected in zip(other.maps(crops), network.maps(crops), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_augmented_landmarks_stay_on_what_they_mark() -> None:
    landmarks = torch.rand(40, 68, 2, generator=torch.Generator().manual_seed(2)) * 60 + 66
    y, x = torch.meshgrid(torch.arange(192.0), torch.arange(192.0), indexing="ij")
    # The tip of the nose is its own mirror image, so that a mirrored crop shows it under the same number.
    near = (x - landmarks[:, 30, 0, None, None]) ** 2 + (y - landmarks[:, 30, 1, None, None]) ** 2
    dots = (255 * torch.exp(-near / 18)).round().byte()
    rgba = torch.stack([dots, dots, dots, torch.full_like(dots, 255)], dim=1)
    settings = replace(AugmentationSettings(), hidden=0.0, absent=0.0)
    visible, generator = torch.ones(40, 68, dtype=torch.bool), torch.Generator().manual_seed(4)
    crops = augmented(rgba, landmarks, visible, 112, 1.25, generator, settings)
    smooth = torch.nn.functional.avg_pool2d(crops.images.mean(1, keepdim=True), 5, 1, 2).flatten(1)
    brightest = smooth.argmax(1)
    found = torch.stack([brightest % 112, brightest // 112], dim=1).float()
    off = (found - crops.landmarks[:, 30]).norm(dim=1)
    inside = crops.visible[:, 30] > 0
    assert int(inside.sum()) > 30
    assert float(off[inside].median()) < 1.5  # strands of hair and bright walls may outshine a few
    assert tuple(MIRROR_68[row] for row in (30, 36)) == (30, 45)


def test_what_is_covered_is_not_visible(pictures: tuple[torch.Tensor, ...]) -> None:
    settings = replace(AugmentationSettings(), hidden=1.0, absent=0.0)
    generators = (torch.Generator().manual_seed(6) for _ in range(2))
    free = augmented(*pictures, 112, 1.25, next(generators), replace(settings, hidden=0.0))
    hidden = augmented(*pictures, 112, 1.25, next(generators), settings)
    assert 0.05 < float(free.visible.mean() - hidden.visible.mean()) < 0.8


def test_wrong_shapes_and_settings_are_refused(network: LandmarkNetwork, pictures: tuple[torch.Tensor, ...]) -> None:
    with pytest.raises(ShapeError, match=r"found \(1, 3, 60, 64\), expected \(B,3,64,64\)"):
        network(torch.zeros(1, 3, 60, 64))
    with pytest.raises(ValueRangeError, match="found size 100"):
        LandmarkNetwork(size=100)
    for wrong in ((pictures[0].float(), *pictures[1:]), (pictures[0], pictures[1][:, :5], pictures[2])):
        with pytest.raises(ShapeError, match=r"found 4, .* expected at least one, uint8 \(4,H,W\)"):
            LandmarkNetwork.fit(TensorDataset(*wrong))
    with pytest.raises(ValueRangeError, match="0 steps"):
        NetworkSettings(steps=0)


def test_both_sides_of_a_crop_give_mirrored_landmarks(network: LandmarkNetwork) -> None:
    crops = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        found, mirrored = BothSides(network)(crops), BothSides(network)(crops.flip(-1))
    across = mirrored[0][:, list(MIRROR_68)] * torch.tensor([-1.0, 1.0]) + torch.tensor([63.0, 0.0])
    torch.testing.assert_close(across, found[0])
    torch.testing.assert_close(mirrored[1][:, list(MIRROR_68)], found[1])


def test_a_finder_runs_the_network_of_a_folder(network: LandmarkNetwork, tmp_path) -> None:
    zoo.save_model(network, tmp_path / "n", zoo.ModelCard("MIT", "none", {}, ""))
    finder = load_finder(tmp_path / "n").finder
    image = (255 * torch.rand(3, 90, 120, generator=torch.Generator().manual_seed(2))).round().byte()
    box = torch.tensor([30.0, 20.0, 50.0, 50.0])
    transform = crop_transform(box, 0.3, 64, network.margin)
    with torch.no_grad():
        expected = network(cut_crop(image, transform, 64)[None].float() / 255)
    found = finder(image, box, 0.3)
    torch.testing.assert_close(found.landmarks, from_crop(expected.landmarks[0], transform), atol=0.1, rtol=0)
    torch.testing.assert_close(found.visibility, expected.visibility[0], atol=0.01, rtol=0)


@pytest.mark.real
def test_the_shipped_network_finds_photographed_faces(data: Path) -> None:
    finder, errors, visible = load_finder(shown="photograph").finder, [], []
    for path in sorted((data / "images" / "people").glob("*.pts")):
        (image,) = (one for one in path.parent.glob(f"{path.stem}.*") if one.suffix != ".pts")
        truth = load_landmark_points(path).points.float()
        found = finder((255 * load_image(image)).round().byte(), box_around(truth), 0.0)
        assert found.presence > 0.9
        assert float((found.visibility > 0.5).float().mean()) > 0.9
        visible.append(float(found.visibility.mean()))
        eyes = (truth[36] - truth[45]).norm()
        errors.append(float((found.landmarks - truth)[INNER].norm(dim=1).mean() / eyes))
    # One of the four laughs with hair over his forehead, in grey.
    assert sorted(errors)[1] < 0.045
    assert sum(errors) / len(errors) < 0.055
    assert sum(visible) / len(visible) > 0.9
