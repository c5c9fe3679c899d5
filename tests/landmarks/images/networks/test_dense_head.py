"""The landmark network's head for points and expression: its frame, its calibration, its graph, its training."""

import copy

import onnxruntime
import pytest
import torch
from torch.utils.data import TensorDataset

from torchface import zoo
from torchface.landmarks import FaceReading, LandmarkNetwork, NetworkSettings
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.crop_finder import BothSides, CropFinder
from torchface.landmarks.images.networks.dense_head import DenseHead, in_face_frame
from torchface.landmarks.images.networks.landmark_training import cropped, opening_loss, openings
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings
from torchface.onnx import export_model
from torchface.shape_names import ARKIT, mirror
from train.rendered_people.face_picture import FacePicture, draw_pictures
from train.rendered_people.head_kind import performer_kind

SMALL = {"size": 64, "margin": 1.25, "channels": (8, 12, 16, 24), "blocks": (1, 1, 1), "decoder": 16}
TWINS = torch.tensor([1, 0, 2, 3])
PLAIN = AugmentationSettings(turn=0.0, scale=0.0, shift=0.0, hidden=0.0, absent=0.0, grey=0.0)


@pytest.fixture(scope="module")
def pictures() -> list[FacePicture]:
    """Four rendered people."""
    return draw_pictures((performer_kind(),), (1.0,), 0, 4, seed=2)


@pytest.fixture(scope="module")
def faces(pictures: list[FacePicture]) -> torch.Tensor:
    """Their landmarks, (4,68,2)."""
    return torch.stack([one.landmarks for one in pictures])


@pytest.fixture(scope="module")
def plain() -> LandmarkNetwork:
    torch.manual_seed(3)
    return LandmarkNetwork(**SMALL).eval()


@pytest.fixture(scope="module")
def network(plain: LandmarkNetwork) -> LandmarkNetwork:
    return plain.with_points(torch.rand(4, 3), TWINS, hidden=12).eval()


def test_points_beside_the_68_leave_these_as_they_were(plain: LandmarkNetwork, network: LandmarkNetwork) -> None:
    crops = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        before, after = plain(crops), network(crops)
    for name in ("landmarks", "deviation", "visibility", "presence"):
        assert torch.equal(getattr(before, name), getattr(after, name))
    assert before.points.shape == (2, 0, 2)
    assert bool(before.expression.isnan().all())
    assert bool(before.expression_deviation.isinf().all())
    assert after.points.shape == (2, 4, 2)
    config = {name: value for name, value in plain.config.items() if name not in ("points", "hidden")}
    old = LandmarkNetwork.from_config(config)  # as it was saved before there were points
    old.load_state_dict(plain.state_dict())
    with torch.no_grad():
        assert torch.equal(old.eval()(crops).landmarks, before.landmarks)


def test_calibration_makes_deviations_as_large_as_errors() -> None:
    generator = torch.Generator().manual_seed(1)
    truth = torch.rand(4000, 52, generator=generator)
    noise = torch.linspace(0.05, 0.4, 52)
    read = truth + noise * torch.randn(4000, 52, generator=generator)
    head = DenseHead(1, 4, 4, 4)
    for stated in (0.1, 0.1 * noise / 0.1):  # calibrated anew it stays
        head.calibrate(read, (head.spread * stated).expand(4000, 52), truth)
        torch.testing.assert_close(head.spread * stated, noise, rtol=0.05, atol=0)


def test_a_face_in_its_own_frame_is_the_same_however_it_lies(faces: torch.Tensor) -> None:
    turn = torch.tensor(0.7)
    rotation = torch.stack([torch.stack([turn.cos(), -turn.sin()]), torch.stack([turn.sin(), turn.cos()])])
    moved = 1.7 * faces @ rotation.T + torch.tensor([30.0, -12.0])
    own = in_face_frame(faces, faces)
    torch.testing.assert_close(in_face_frame(moved, moved), own, atol=1e-4, rtol=0)
    assert float(own[:, 45, 0].min()) > 0 > float(own[:, 36, 0].max())  # the left eye lies where x is positive
    assert float(own[:, 8, 1].min()) > 0  # and the chin where y is


def test_a_mirrored_picture_has_mirrored_points_and_weights(faces: torch.Tensor) -> None:
    rgba = torch.full((40, 4, 192, 192), 255, dtype=torch.uint8)
    landmarks = faces[:1].expand(40, -1, -1)
    points, seen = landmarks[:, [36, 45, 27, 30]], torch.tensor([True, False, True, True]).expand(40, 4)
    weights = torch.linspace(0, 1, 52).expand(40, 52)
    given = rgba, landmarks, torch.ones(40, 68, dtype=torch.bool), points, seen, weights
    crops, shown = cropped(given, 112, 1.25, TWINS, torch.Generator().manual_seed(5), PLAIN)
    assert 8 < int(crops.mirrored.sum()) < 32
    for number in range(40):
        # Landmark 36 is the image's left outer corner, mirrored or not: of the other eye in a mirror.
        torch.testing.assert_close(crops.landmarks[number, COUNT:], crops.landmarks[number, [36, 45, 27, 30]])
        hidden = 0 if bool(crops.mirrored[number]) else 1
        assert float(crops.visible[number, COUNT + hidden]) == 0
        twins = mirror(ARKIT) if bool(crops.mirrored[number]) else torch.arange(52)
        assert torch.equal(shown[number], weights[0, twins])


def test_both_sides_of_a_crop_give_mirrored_points_and_weights(network: LandmarkNetwork) -> None:
    crops = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    both = BothSides(network, network.mirror)
    with torch.no_grad():
        found, mirrored = both(crops), both(crops.flip(-1))
    across = mirrored.points[:, TWINS] * torch.tensor([-1.0, 1.0]) + torch.tensor([63.0, 0.0])
    torch.testing.assert_close(across, found.points)
    torch.testing.assert_close(mirrored.point_deviation[:, TWINS], found.point_deviation)
    torch.testing.assert_close(mirrored.expression[:, mirror(ARKIT)], found.expression)


@pytest.mark.bench
def test_the_graph_gives_points_and_weights(network: LandmarkNetwork, tmp_path) -> None:
    path = tmp_path / "network.onnx"
    report = export_model(network, path, {"licence": "MIT"})
    names = ["landmarks", "deviation", "visibility", "presence"]
    names += ["points", "point_deviation", "expression", "expression_deviation"]
    assert set(names) == set(report.parity)
    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    crops = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(8))
    with torch.no_grad():
        expected = network(crops)
    for name, value in zip(names, session.run(names, {"image": crops.numpy()}), strict=True):
        torch.testing.assert_close(torch.from_numpy(value), getattr(expected, name), rtol=5e-3, atol=0.05)
    assert report.size < 2_000_000
    assert session.get_modelmeta().custom_metadata_map["crop"] == "1.25"


def test_a_finder_gives_points_in_pixels_of_the_picture(network: LandmarkNetwork) -> None:
    image = torch.randint(0, 255, (3, 90, 120), dtype=torch.uint8)
    found = CropFinder(network, 64)(image, torch.tensor([30.0, 20.0, 50.0, 50.0]))
    # The crop's middle is the box's, and a pixel of it 1.25 * 50 / 64 of the picture's.
    with torch.no_grad():
        shown = found.landmarks.new_tensor([55.0, 45.0]) - 0.5
    assert found.points.shape == (4, 2)
    assert float((found.points - shown).abs().max()) < 200
    assert bool(torch.isfinite(found.expression).all())
    take = FaceReading.stacked([FaceReading.lost(), found])
    assert take.points.shape == (2, 4, 2)
    assert bool(take.points[0].isnan().all())
    assert torch.equal(take.points[1], found.points)
    assert bool(take.point_deviation[0].isinf().all())


def test_openings_that_are_drawn_toward_their_mean_cost_more(faces: torch.Tensor) -> None:
    generator = torch.Generator().manual_seed(2)
    truth = faces[:1].repeat(32, 1, 1)
    truth[:, 60:68, 1] += 6 * torch.rand(32, 1, generator=generator) * torch.tensor([0, -1.0, -1, -1, 0, 1, 1, 1])
    sure = torch.ones(32, 68)
    read = truth.clone()
    assert float(opening_loss(read, truth, sure)) == pytest.approx(0, abs=1e-4)
    lips = torch.tensor([61, 62, 63, 65, 66, 67])
    read[:, lips] = 0.4 * truth[:, lips].mean(0) + 0.6 * truth[:, lips]
    slope = torch.linalg.lstsq(
        torch.stack([openings(truth, truth)[:, 2], torch.ones(32)], 1), openings(read, truth)[:, 2:3]
    ).solution[0]
    assert float(slope) == pytest.approx(0.6, abs=0.02)
    noisy = truth.clone()
    apart = (read - truth)[:, lips].abs().mean()
    noisy[:, lips, 1] += 2.0 * apart * torch.randn(32, 6, generator=generator)
    # As far from the truth or further, but not drawn toward the mean.
    assert float(opening_loss(read, truth, sure)) > float(opening_loss(noisy, truth, sure))


def test_training_finds_points_and_weights_beside_the_68(pictures: list[FacePicture], faces: torch.Tensor) -> None:
    network = zoo.get_model("landmark_network").with_points(torch.rand(4, 3), TWINS, hidden=12).eval()
    rgba = torch.stack([one.rgba for one in pictures])
    points = faces[:, [36, 45, 27, 30]] + torch.tensor([0.0, 4.0])
    weights = torch.rand(4, 52, generator=torch.Generator().manual_seed(3))
    given = rgba, faces, torch.ones(4, 68, dtype=torch.bool), points, torch.ones(4, 4, dtype=torch.bool), weights
    settings = NetworkSettings(steps=20, batch=6, rate=2e-3, average=0.7, workers=0, heat=0.0, augmentation=PLAIN)
    crops, shown = cropped(given, network.size, network.margin, TWINS, torch.Generator().manual_seed(1), PLAIN)

    @torch.no_grad()
    def errors(network: LandmarkNetwork) -> list[float]:
        found = network(crops.images)
        apart = (torch.cat([found.landmarks, found.points], 1) - crops.landmarks).norm(dim=-1)
        off = (found.expression - shown).square()
        return [float(one.mean()) for one in (apart[:, :COUNT], apart[:, COUNT:], off)]

    before = errors(network)
    after = errors(LandmarkNetwork.fit(TensorDataset(*given), copy.deepcopy(network), settings))
    assert after[0] < 1.2 * before[0]
    assert after[1] < 0.2 * before[1]
    assert after[2] < 0.9 * before[2]
