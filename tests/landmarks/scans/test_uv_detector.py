"""The detector on small images with planted landmarks: it learns, decides by location, keeps its state on disk."""

import copy
import hashlib
from pathlib import Path

import pytest
import torch
from safetensors.torch import load, save
from torch import Tensor

from torchface import zoo
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.landmarks import DetectorSettings, LineExamples, UVLandmarkDetector
from torchface.landmarks.scans.hog import HogLayout

NAMES = ("cross", "ring", "corner")
SETTINGS = DetectorSettings(hog=HogLayout(stride=4), responses=50)
SIZE = 160
CARD = zoo.ModelCard("MIT", "drawn marks", {"error": 1.5}, "none")


def stamp(image: Tensor, kind: str, x: float, y: float) -> None:
    across, down = torch.meshgrid(torch.arange(SIZE) - x, torch.arange(SIZE) - y, indexing="xy")
    near = torch.exp(-(((across**2 + down**2) / 14**2) ** 4))
    away = (across**2 + down**2).sqrt()
    mark = {
        "cross": torch.exp(-((across / 2) ** 2)) + torch.exp(-((down / 2) ** 2)),
        "ring": torch.exp(-(((away - 8) / 2) ** 2)),
        "corner": torch.sigmoid(across) * torch.sigmoid(down),
    }[kind]
    image -= 0.4 * near * mark.clamp(max=1)


def drawn(seed: int, decoy: tuple[str, float, float] | None = None) -> tuple[Tensor, Tensor]:
    """An image (1,S,S) and its landmarks (3,2)."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, 10, 10, generator=generator)
    image = 0.6 + 0.1 * torch.nn.functional.interpolate(coarse, size=(SIZE, SIZE), mode="bicubic")[0, 0]
    places = torch.tensor([[45.0, 50.0], [105.0, 55.0], [80.0, 110.0]]) + 4 * torch.randn(3, 2, generator=generator)
    for name, (x, y) in zip(NAMES, places.tolist(), strict=True):
        stamp(image, name, x, y)
    if decoy is not None:
        stamp(image, *decoy)
    image += 0.02 * torch.randn(SIZE, SIZE, generator=generator)
    return image[None], places


@pytest.fixture(scope="module")
def detector() -> UVLandmarkDetector:
    images, places = zip(*(drawn(seed) for seed in range(8)), strict=True)
    return UVLandmarkDetector.fit(torch.stack(images), torch.stack(places), NAMES, settings=SETTINGS)


def test_images_and_landmarks_may_be_part_of_a_graph(detector: UVLandmarkDetector) -> None:
    images, places = zip(*(drawn(seed) for seed in range(8)), strict=True)
    given = [torch.stack(one).requires_grad_() for one in (images, places)]
    again = copy.deepcopy(UVLandmarkDetector.fit(*given, NAMES, settings=SETTINGS))
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in detector.state_dict().items())


def test_planted_landmarks_are_found_in_new_images(detector: UVLandmarkDetector) -> None:
    images, places = zip(*(drawn(seed) for seed in range(50, 56)), strict=True)
    found = detector(torch.stack(images))
    error = (found.pixels - torch.stack(places)).norm(dim=-1)
    prior = (detector.prior_mean - torch.stack(places)).norm(dim=-1)
    assert error.mean() < 2.5
    assert error.mean() < 0.5 * prior.mean()
    assert (found.confidence > 0).all()


def test_a_decoy_far_from_the_usual_place_is_ignored(detector: UVLandmarkDetector) -> None:
    image, places = drawn(60, decoy=("cross", 130.0, 125.0))
    found = detector(image[None])
    assert (found.pixels[0] - places).norm(dim=-1).max() < 6


def test_good_scores_lie_above_bad_ones(detector: UVLandmarkDetector) -> None:
    assert (detector.good[..., 0] > detector.bad[..., 0]).float().mean() > 0.9


def test_a_featureless_image_gives_the_usual_place_without_confidence(detector: UVLandmarkDetector) -> None:
    found = detector(torch.full((1, 1, SIZE, SIZE), 0.5))
    assert torch.allclose(found.pixels[0], detector.prior_mean, atol=12)
    assert found.confidence.max() < 0.05


def test_images_that_are_not_finite_are_refused(detector: UVLandmarkDetector) -> None:
    (one, places), (other, _) = drawn(60), drawn(61)
    images = torch.stack([one, other])
    images[1, 0, 20, 30] = torch.nan
    with pytest.raises(ValueRangeError, match=r"images: found NaN or infinity in row 1, expected numbers in \[0,1\]"):
        detector(images)
    with pytest.raises(ValueRangeError, match="images: found NaN or infinity in row 1"):
        UVLandmarkDetector.fit(images, places.expand(2, -1, -1), NAMES, settings=SETTINGS)


def test_a_model_saved_under_the_old_names_loads(tmp_path: Path) -> None:
    """Keys of the state, and the word for what it sees, as they were."""
    images, places = zip(*(drawn(seed) for seed in range(3)), strict=True)
    lines = [{"lips": torch.tensor([[40.0, 90.0], [60.0, 95.0 + i], [80.0, 90.0]])} for i in range(3)]
    fitted = UVLandmarkDetector.fit(
        torch.stack(images), torch.stack(places), NAMES, "curvature", SETTINGS, lines=LineExamples(lines)
    )
    folder = tmp_path / "model"
    zoo.save_model(fitted, folder, CARD)
    path, text = folder / "state.safetensors", (folder / "model.toml").read_text()
    old = {"line_statistics": "courses", "line_profiles": "looks", "corner_deviation": "looseness"}
    before = path.read_bytes()
    path.write_bytes(save({old.get(key, key): value for key, value in load(before).items()}))
    for now, then in (
        (f"size = {len(before)}", f"size = {path.stat().st_size}"),
        (hashlib.sha256(before).hexdigest(), hashlib.sha256(path.read_bytes()).hexdigest()),
        ('"curvature"', '"relief"'),
    ):
        assert now in text
        text = text.replace(now, then)
    (folder / "model.toml").write_text(text)
    again = zoo.get_model(folder)
    assert again.appearance == "curvature"
    assert again.line_statistics.abs().max() > 0
    for key, value in fitted.state_dict().items():
        assert torch.equal(again.state_dict()[key], value)


def test_files_that_lie_are_refused(detector: UVLandmarkDetector, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    zoo.save_model(detector, folder, CARD)
    text = (folder / "model.toml").read_text()
    (folder / "model.toml").write_text(text.replace("images = 8", "images = 800000000"))
    with pytest.raises(FileFormatError, match="do not fit"):
        zoo.get_model(folder)
    (folder / "model.toml").write_text(text.replace("images = 8", "images = 7"))
    with pytest.raises(FileFormatError, match="do not fit"):
        zoo.get_model(folder)
    (folder / "model.toml").write_text(text.replace("uv_landmarks", "morphable"))
    with pytest.raises(FileFormatError):
        zoo.get_model(folder)
    (folder / "model.toml").write_text(text)
    state = (folder / "state.safetensors").read_bytes()
    (folder / "state.safetensors").write_bytes(state[: len(state) // 2])
    with pytest.raises(FileFormatError, match="cut off"):
        zoo.get_model(folder)


def test_a_missing_landmark_is_left_out_of_the_statistics() -> None:
    images, places = zip(*(drawn(seed) for seed in range(5)), strict=True)
    known = torch.stack(places)
    known[2, 1] = torch.nan
    fitted = UVLandmarkDetector.fit(torch.stack(images), known, NAMES, settings=SETTINGS)
    assert torch.allclose(fitted.prior_mean[1], known[[0, 1, 3, 4], 1].mean(0), atol=1e-4)
    image, truth = drawn(80)
    assert (fitted(image[None]).pixels[0] - truth).norm(dim=-1).max() < 6


def test_bad_input_is_named(detector: UVLandmarkDetector) -> None:
    with pytest.raises(ShapeError, match="160,160"):
        detector(torch.zeros(1, 1, 64, 64))
    with pytest.raises(ShapeError, match=r"\(4,3,2\)"):
        UVLandmarkDetector.fit(torch.zeros(4, 1, 64, 64), torch.zeros(4, 2, 2), NAMES)
    with pytest.raises(ValueRangeError, match="at least two"):
        UVLandmarkDetector.fit(torch.zeros(1, 1, 64, 64), torch.zeros(1, 3, 2), NAMES)
    with pytest.raises(ValueRangeError, match="'texture' or 'curvature'"):
        UVLandmarkDetector(2, appearance="smell")
