"""Landmark trees against a plain computation, planted motion, a killed training, and faces, made-up and real."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from torchface import zoo
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.io import load_image, load_landmark_points
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.landmarks import LandmarkTrees, TreeSettings
from torchface.landmarks.images.ibug_68 import MIRROR_68, box_around, relative_errors
from torchface.landmarks.images.trees.landmark_trees import FAINTEST, initial_shapes, similarity_to
from torchface.landmarks.images.trees.tree_training import best_test
from torchface.onnx.landmark_trees_graph import export_landmark_trees
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.topology import topology

FEW = TreeSettings(cascades=4, trees=40, depth=4, features=120, test_splits=20, oversampling=10, components=10, noise=0)


def made_up(seed: int = 0, **sizes: int) -> LandmarkTrees:
    """Trees that have learned nothing, full of random numbers."""
    generator = torch.Generator().manual_seed(seed)
    model = LandmarkTrees(**sizes)
    features, landmarks = model.sizes["features"], model.sizes["landmarks"]
    model.mean.copy_(0.2 + 0.6 * torch.rand(model.mean.shape, generator=generator))
    model.anchors.random_(0, landmarks, generator=generator)
    model.offsets.normal_(0, 0.1, generator=generator)
    model.first.random_(0, features, generator=generator)
    model.second.random_(0, features, generator=generator)
    model.thresholds.normal_(0, 0.5, generator=generator)
    model.leaves.random_(-127, 128, generator=generator)
    model.scales.uniform_(0.5, 1.5, generator=generator).mul_(2e-4 / model.sizes["trees"] ** 0.5)
    model.bases.normal_(0, 0.3, generator=generator)
    return model


def clouds(count: int, height: int, width: int, seed: int = 0) -> Tensor:
    coarse = torch.rand(count, 1, height // 8, width // 8, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)


def plainly(model: LandmarkTrees, image: np.ndarray, box: np.ndarray) -> np.ndarray:
    """One face, tree by tree, node by node."""
    side, mean = np.sqrt(box[2] * box[3]), model.mean.double().numpy()
    shape = box[:2] + box[2:] / 2 + side * (mean - 0.5)
    for c in range(model.sizes["cascades"]):
        m, s = mean - mean.mean(0), shape - shape.mean(0)
        turn = (s[:, 0] + 1j * s[:, 1]) @ (m[:, 0] - 1j * m[:, 1]) / (m**2).sum()
        grey = []
        for anchor, offset in zip(model.anchors[c], model.offsets[c].double().numpy(), strict=True):
            away = turn * (offset[0] + 1j * offset[1])
            x, y = shape[anchor] + [away.real, away.imag]
            x, y = min(max(round(x), 0), image.shape[1] - 1), min(max(round(y), 0), image.shape[0] - 1)
            grey.append(image[y, x])
        grey = np.array(grey) / max(np.std(grey), FAINTEST)
        step = np.zeros(model.sizes["components"])
        for t in range(model.sizes["trees"]):
            node = 0
            for _ in range(model.sizes["depth"]):
                apart = grey[model.first[c, t, node]] - grey[model.second[c, t, node]]
                node = 2 * node + (2 if apart > float(model.thresholds[c, t, node]) else 1)
            step += float(model.scales[c, t]) * model.leaves[c, t, node - 2 ** model.sizes["depth"] + 1].numpy()
        moved = (step @ model.bases[c].double().numpy()).reshape(-1, 2)
        moved = turn * (moved[:, 0] + 1j * moved[:, 1])
        shape = shape + np.stack([moved.real, moved.imag], 1)
    return shape


def test_forward_is_the_plain_walk_down_every_tree() -> None:
    model = made_up(landmarks=7, cascades=3, trees=9, depth=3, features=20, components=5)
    images = clouds(3, 60, 80)
    boxes = torch.tensor([[20.0, 10, 40, 40], [5, 5, 30, 34], [50, 30, 50, 50]])  # the last one leaves the picture
    found = model(images, boxes)
    for row in range(3):
        expected = plainly(model, images[row, 0].double().numpy(), boxes[row].double().numpy())
        np.testing.assert_allclose(found[row], expected, atol=1e-3)
    start = initial_shapes(model.mean, boxes)
    assert ((found - start).norm(dim=-1).amax(1) > 0.5).all()
    torch.testing.assert_close(model.refine(images, start), found)


def test_light_contrast_and_place_do_not_matter() -> None:
    model = made_up(landmarks=7, cascades=3, trees=9, depth=3, features=20, components=5)
    picture, box = clouds(1, 90, 90), torch.tensor([[30.0, 30, 30, 30]])
    found = model(picture, box)
    torch.testing.assert_close(model(0.3 + 0.4 * picture, box), found, rtol=0, atol=1e-3)
    moved = model(picture.roll((3, -5), (2, 3)), box + torch.tensor([-5.0, 3, 0, 0]))
    torch.testing.assert_close(moved, found + torch.tensor([-5.0, 3]), rtol=0, atol=1e-3)
    torch.testing.assert_close(model(picture.double(), box.double()), found, rtol=0, atol=1e-3)
    lost = model(picture.expand(2, 1, 90, 90), torch.cat([box, box * torch.nan]))
    assert torch.isnan(lost[1]).all()
    torch.testing.assert_close(lost[:1], found)


@given(st.floats(0.2, 5.0), st.floats(-3.1, 3.1), st.integers(0, 1000))
def test_a_planted_similarity_comes_back(scale: float, angle: float, seed: int) -> None:
    mean = torch.rand(6, 2, generator=torch.Generator().manual_seed(seed))
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    turn = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float32)
    found = similarity_to(mean, (mean @ turn.T + torch.tensor([40.0, -7]))[None])
    torch.testing.assert_close(found[0], turn, rtol=1e-3, atol=1e-3)


def test_the_best_test_lowers_the_squared_error_most() -> None:
    generator = torch.Generator().manual_seed(3)
    right = (torch.rand(20, 50, generator=generator) > 0.5).float()
    right[3] = 1  # a test that does not divide
    wanted = torch.randn(50, 4, generator=generator)
    left_over = []
    for test in right:
        sides = [wanted[test == side] for side in (0, 1)]
        left_over.append(sum(float((side - side.mean(0)).square().sum()) for side in sides if len(side)))
    assert int(best_test(right, wanted)) == int(np.argmin(left_over))


def blobs(count: int, seed: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """Pictures of five bright and dark blobs, each at a landmark: a pattern moved, turned and bent at random."""
    generator = torch.Generator().manual_seed(seed)
    pattern = torch.tensor([[0.25, 0.3], [0.75, 0.3], [0.5, 0.55], [0.3, 0.78], [0.7, 0.78]])
    grey = torch.tensor([0.9, 0.8, -0.8, 0.7, -0.6])
    images, boxes, points = [], [], []
    for _ in range(count):
        box = torch.tensor([20.0, 20, 44, 44]) + 6 * torch.rand(4, generator=generator)
        bent = pattern + 0.05 * torch.randn(5, 2, generator=generator)
        place = box[:2] + bent * box[2:]
        y, x = torch.meshgrid(torch.arange(90.0), torch.arange(90.0), indexing="ij")
        away = (x[..., None] - place[:, 0]) ** 2 + (y[..., None] - place[:, 1]) ** 2
        picture = 0.5 + 0.45 * (grey * torch.exp(-away / 60)).sum(-1)
        images.append((255 * picture.clamp(0, 1)).byte())
        boxes.append(box)
        points.append(place)
    return images, torch.stack(boxes), torch.stack(points)


def errors(model: LandmarkTrees, images: list[Tensor], boxes: Tensor, points: Tensor) -> Tensor:
    return (model(torch.stack(images)[:, None].float() / 255, boxes) - points).norm(dim=-1)


@pytest.fixture(scope="module")
def learned() -> LandmarkTrees:
    return LandmarkTrees.fit(*blobs(60, 0), FEW)


def test_landmarks_are_found_in_new_pictures(learned: LandmarkTrees) -> None:
    images, boxes, points = blobs(40, 1)
    before = (initial_shapes(learned.mean, boxes) - points).norm(dim=-1)
    after = errors(learned, images, boxes, points)
    assert after.mean() < 0.45 * before.mean()
    jittered = boxes + 2.5 * torch.randn(40, 4, generator=torch.Generator().manual_seed(0))
    assert errors(learned, images, jittered, points).mean() < 0.6 * before.mean()


def test_more_trees_leave_less(learned: LandmarkTrees) -> None:
    data = blobs(60, 0)
    begin = LandmarkTrees.fit(*data, TreeSettings(**{**vars(FEW), "cascades": 1}))
    assert errors(learned, *data).mean() < 0.8 * errors(begin, *data).mean()


def test_a_killed_training_goes_on_to_the_same_result(learned: LandmarkTrees, tmp_path: Path) -> None:
    class KilledError(Exception):
        pass

    def kill(step: str, done: int = 0, total: int = 0) -> None:
        if done == 90:
            raise KilledError

    data, path = blobs(60, 0), tmp_path / "trees.safetensors"
    with pytest.raises(KilledError):
        LandmarkTrees.fit(*data, FEW, kill, checkpoint=path)
    told = []
    again = LandmarkTrees.fit(*data, FEW, lambda _, done, total: told.append((done, total)), checkpoint=path)
    assert told == [(done, 160) for done in range(81, 161)]
    for name, value in learned.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
    with pytest.raises(FileFormatError, match="other images or settings"):
        LandmarkTrees.fit(*blobs(60, 5), FEW, checkpoint=path)
    path.write_bytes(path.read_bytes()[:-64] + bytes(64))

    def kill_at_once(step: str, done: int = 0, total: int = 0) -> None:
        assert done == 1  # it begins anew
        raise KilledError

    with pytest.warns(UserWarning, match=r"trees\.safetensors: found a damaged"), pytest.raises(KilledError):
        LandmarkTrees.fit(*data, FEW, kill_at_once, checkpoint=path)


@pytest.mark.bench
def test_mirrored_pictures_teach_the_other_side() -> None:
    images, boxes, points = blobs(60, 0)
    twins = (1, 0, 2, 4, 3)  # of the places; their greys differ, so that the pictures are no mirror images
    flipped = [image.flip(1) for image in images]
    other_boxes, other_points = boxes.clone(), points[:, list(twins)].clone()
    other_boxes[:, 0] = 89 - boxes[:, 0] - boxes[:, 2]
    other_points[..., 0] = 89 - other_points[..., 0]
    taught = LandmarkTrees.fit(images, boxes, points, FEW, mirror=twins)
    untaught = LandmarkTrees.fit(images, boxes, points, FEW)
    after = [errors(model, flipped, other_boxes, other_points).mean() for model in (taught, untaught)]
    assert after[0] < 0.6 * after[1]
    assert errors(taught, images, boxes, points).mean() < 0.6 * after[1]


def test_a_model_of_full_size_stays_below_30_mb(tmp_path: Path) -> None:
    model = made_up(landmarks=68, cascades=10, trees=500, depth=5, features=400, components=136)
    record = zoo.save_model(model, tmp_path / "full", zoo.ModelCard("MIT", "none", {}, ""))
    assert record.size < 30e6
    usual = made_up()
    assert usual.sizes == {**model.sizes, "components": 40}
    half = ("offsets", "thresholds", "bases")
    record = zoo.save_model(usual, tmp_path / "usual", zoo.ModelCard("MIT", "", {}, ""), half=half)
    assert record.size < 8e6


def test_the_graph_computes_the_same(tmp_path: Path) -> None:
    path, learned = tmp_path / "trees.onnx", LandmarkTrees.fit(*blobs(60, 0), replace(FEW, cascades=2))
    report = export_landmark_trees(learned, path, {"licence": "MIT"})
    assert report.parity["landmarks"] < 0.05
    session = onnxruntime.InferenceSession(path)
    images, boxes, _ = blobs(2, 4)
    boxes = torch.cat([boxes, boxes[:1] * torch.nan])
    (found,) = session.run(None, {"image": images[0].numpy(), "boxes": boxes.numpy()})
    expected = learned(images[0][None, None].float().expand(3, 1, 90, 90) / 255, boxes)
    np.testing.assert_allclose(found, expected, atol=0.05)
    assert np.isnan(found[2]).all()


def test_zoo_round_trip(learned: LandmarkTrees, tmp_path: Path) -> None:
    card = zoo.ModelCard("MIT", "blobs", {}, "")
    zoo.save_model(learned, tmp_path / "exact", card)
    images, boxes, _ = blobs(3, 4)
    pictures = torch.stack(images)[:, None].float() / 255
    half = ("offsets", "thresholds", "bases")  # trained as they are stored: nothing is lost
    zoo.save_model(learned, tmp_path / "half", card, half=half)
    for name in ("exact", "half"):
        assert torch.equal(zoo.get_model(tmp_path / name)(pictures, boxes), learned(pictures, boxes))
    learned.first[0, 0, 0], kept = 5000, int(learned.first[0, 0, 0])
    zoo.save_model(learned, tmp_path / "broken", card)
    learned.first[0, 0, 0] = kept
    with pytest.raises(FileFormatError, match="first: found 0 to 5000"):
        zoo.get_model(tmp_path / "broken")


def test_bad_input_is_named(learned: LandmarkTrees) -> None:
    images, boxes, points = blobs(3, 0)
    with pytest.raises(ShapeError, match="2 images"):
        LandmarkTrees.fit(images[:2], boxes, points, FEW)
    with pytest.raises(ShapeError, match=r"image 1: found torch\.float32"):
        LandmarkTrees.fit([images[0], images[1].float(), images[2]], boxes, points, FEW)
    with pytest.raises(ValueRangeError, match="box 2"):
        LandmarkTrees.fit(images, boxes * torch.tensor([[1.0], [1], [-1]]), points, FEW)
    with pytest.raises(ValueRangeError, match="landmark 0: found in no image"):
        LandmarkTrees.fit(images, boxes, points * torch.nan, FEW)
    for same in (points[:, :1], points[:, :1].expand(-1, 3, -1)):
        with pytest.raises(ValueRangeError, match="landmarks: found a single place, expected at least two"):
            LandmarkTrees.fit(images, boxes, same, FEW)
    for name, value in (("trees", 0), ("depth", 40), ("noise", -0.1), ("shrinkage", 2.0)):
        with pytest.raises(ValueRangeError, match=f"{name}: found {value}|found {name} {value}"):
            TreeSettings(**{name: value})
    with pytest.raises(ShapeError, match=r"expected \(2,4\)"):
        learned(torch.rand(2, 1, 9, 9), torch.rand(1, 4))
    with pytest.raises(ShapeError, match=r"expected \(B,1,H,W\)"):
        learned(torch.rand(2, 3, 9, 9), torch.rand(2, 4))
    with pytest.raises(ValueRangeError, match="depth: found 99"):
        LandmarkTrees(depth=99)


def test_a_landmark_that_some_pictures_lack_is_learned_from_the_others() -> None:
    images, boxes, points = blobs(60, 0)
    points[::3, 1] = torch.nan
    model = LandmarkTrees.fit(images, boxes, points.requires_grad_(), FEW)
    assert not any(value.requires_grad for value in model.state_dict(keep_vars=True).values())
    new = blobs(40, 1)
    assert (
        errors(model, *new)[:, 1].mean() < 0.7 * (initial_shapes(model.mean, new[1]) - new[2]).norm(dim=-1)[:, 1].mean()
    )


def test_ibug_pairs_are_the_heads_mirror_images() -> None:
    marks = head_annotations().landmarks
    assert torch.equal(topology().mirror[marks], marks[list(MIRROR_68)])


def test_the_box_goes_with_the_landmarks() -> None:
    points = 20 + 60 * torch.rand(4, 68, 2, generator=torch.Generator().manual_seed(0))
    box = box_around(points)
    moved = box_around(2 * points + torch.tensor([5.0, -3]))
    torch.testing.assert_close(moved, 2 * box + torch.tensor([5.0, -3, 0, 0]))
    points[0, 20], points[1, 17:] = torch.nan, torch.nan
    assert torch.isfinite(box_around(points)).all(1).tolist() == [True, False, True, True]
    with pytest.raises(ShapeError):
        box_around(points[:, :5])


@pytest.mark.bench
@pytest.mark.real
def test_the_shipped_model_finds_real_faces(data: Path) -> None:
    """18 faces that dlib's predictor has landmarks for, a reference and no truth, and one annotated by hand.

    Boxes are those of the landmarks, and of the Haar cascade where it finds the face.
    """
    model = zoo.get_model("face_landmarks")
    folder = data / "images" / "dlib_faces"
    faces = [
        (folder / face.image, face.points) for face in load_dlib_faces(folder / "training_with_face_landmarks.xml")
    ]
    ibug = data / "images" / "ibug" / "image_0010"
    faces.append((ibug.with_suffix(".png"), load_landmark_points(ibug.with_suffix(".pts")).ibug()))
    finder = cv2.CascadeClassifier(cv2.data.haarcascades + "haarcascade_frontalface_alt2.xml")
    given, detected = [], []
    for path, points in faces:
        image = load_image(path).mean(0)[None, None]
        reference, box = points.float()[None], box_around(points.float())
        given.append(relative_errors(model(image, box[None]), reference))
        seen = torch.tensor(finder.detectMultiScale((255 * image[0, 0]).byte().numpy(), 1.1, 3)).reshape(-1, 4).float()
        away = (seen[:, :2] + seen[:, 2:] / 2 - box[:2] - box[2:] / 2).norm(dim=1) / box[2]
        if len(seen) and away.min() < 0.25:
            detected.append(relative_errors(model(image, seen[away.argmin()][None]), reference))
    print(
        f"\nreal faces: {100 * torch.cat(given).mean():.1f} %, "
        f"from detected boxes {100 * torch.cat(detected).mean():.1f} %"
    )
    assert len(detected) >= 14
    assert torch.cat(given).median() < 0.09
    assert torch.cat(detected).median() < 0.10
