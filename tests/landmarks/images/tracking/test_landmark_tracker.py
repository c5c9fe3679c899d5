"""A filmed performer's landmarks are followed, lost and found again; what trembles in one start is steady in many."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.rotations import rotation_matrix
from torchface.io import load_image, load_landmark_points
from torchface.io.video import open_video, write_video
from torchface.landmarks import (
    AppearanceModel,
    FaceReading,
    LandmarkTracker,
    LandmarkTrees,
    NoFaceError,
    TreeFinder,
    find_landmarks,
    landmark_jitter,
    track_landmarks,
)
from torchface.landmarks.images.ibug_68 import MIRROR_68, box_around, turned_box
from torchface.landmarks.images.trees.landmark_consensus import ConsensusSettings, consensus
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import performer

SIZE = 160


@pytest.fixture(scope="module")
def trees() -> LandmarkTrees:
    model = zoo.get_model("face_landmarks")
    assert isinstance(model, LandmarkTrees)
    return model


@pytest.fixture(scope="module")
def film() -> tuple[Tensor, Tensor]:
    """A head that turns, sways and opens its mouth: frames (12,3,160,160), the truth (12,68,2)."""
    rig = performer()
    marks, jaw = rig.neutral.landmarks, rig.index(["jawOpen"])[0]
    middle = rig.vertices[marks].double().mean(0)
    camera = look_at(middle, 0.0, 0.0, 330.0, SIZE, SIZE)
    pivot = middle + torch.tensor([0.0, -40.0, -90.0])
    frames, truth = [], []
    for t in range(12):
        weights = torch.zeros(1, len(rig.names))
        weights[0, jaw] = 0.3 * (1 - math.cos(t / 4))
        turn = torch.tensor([0.0, 0.2 * math.sin(t / 6), 0.1 * math.sin(t / 8)], dtype=torch.float64)
        sway = torch.tensor([15 * math.sin(t / 7), 5 * math.sin(t / 5), 0.0])
        posed = (rig(weights)[0].double() - pivot) @ rotation_matrix(turn).T + pivot + sway
        mesh = rig.neutral.with_vertices(posed.float())
        picture = render(mesh, camera, background=(0.3, 0.35, 0.4), lighting=Lighting(occlusion_rays=0), samples=1)
        frames.append((picture.clamp(0, 1) * 255).round().to(torch.uint8))
        truth.append(camera.project(posed[marks]))
    return torch.stack(frames), torch.stack(truth).float()


def errors(found: Tensor, truth: Tensor) -> Tensor:
    """Distances (T,68), of the eyes' outer corners'."""
    eyes = (truth[:, 36] - truth[:, 45]).norm(dim=-1)
    return (found - truth).norm(dim=-1) / eyes[:, None]


def test_every_frame_is_tracked_near_the_truth(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    calls: list[tuple[str, int, int]] = []
    track = track_landmarks(frames, LandmarkTracker(trees), lambda *progress: calls.append(progress))
    assert track.names == tuple(str(number) for number in range(68))
    off = errors(track.values, truth)
    assert off.mean() < 0.035
    assert off[:, 17:].mean() < 0.025
    assert calls == [("tracking landmarks", t + 1, 12) for t in range(12)]
    assert ((track.confidence > 0) & (track.confidence <= 1)).all()
    sure = track.confidence > track.confidence.median()
    assert off[sure].mean() < 0.8 * off[~sure].mean()  # confidence says which landmarks are off


def test_the_past_alone_counts(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, _ = film
    frames = frames[:5]
    whole = track_landmarks(frames, LandmarkTracker(trees))
    tracker = LandmarkTracker(trees)
    first, second = track_landmarks(frames[:3], tracker), track_landmarks(frames[3:], tracker)
    assert torch.equal(torch.cat([first.values, second.values]), whole.values)
    grey = (frames.float() * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1).round().to(torch.uint8)
    assert (track_landmarks(grey, LandmarkTracker(trees)).values - whole.values).abs().mean() < 0.3


def test_a_finder_may_write_over_the_landmarks_that_it_gave(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, _ = film
    finder, landmarks = TreeFinder(trees), torch.zeros(68, 2)

    def overwriting(image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        reading = finder(image, box, tilt)
        landmarks.copy_(reading.landmarks)
        return replace(reading, landmarks=landmarks)

    trackers = LandmarkTracker(finder), LandmarkTracker(overwriting)
    first, second = (track_landmarks(frames[:8], tracker).values for tracker in trackers)
    assert torch.equal(first, second)


def test_many_starts_are_steadier_than_two(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, _ = film
    noisy = frames[:1].repeat(30, 1, 1, 1).float()  # a still face: what moves is noise
    noisy += 5 * torch.randn(noisy.shape, generator=torch.Generator().manual_seed(0))
    noisy = noisy.clamp(0, 255).to(torch.uint8)
    finders = [TreeFinder(trees, ConsensusSettings(starts=count)) for count in (2, 16)]
    jitter = [landmark_jitter(track_landmarks(noisy, LandmarkTracker(finder)).values) for finder in finders]
    assert jitter[1] < 0.6 * jitter[0]
    assert jitter[1] < 0.2  # pixels, eyes' outer corners 44 apart


def test_a_lost_face_is_nan_and_found_again(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    wall = torch.randint(60, 120, (3, SIZE, SIZE), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    seen = torch.cat([frames[:3], wall[None], wall[None], frames[3:6]])
    tracker = LandmarkTracker(trees)
    steps = [tracker.step(frame) for frame in seen]
    assert [one.found for one in steps] == [True] * 3 + [False] * 2 + [True] * 3
    for one in steps[3:5]:
        assert one.landmarks.isnan().all()
        assert one.box.isnan().all()
        assert (one.confidence == 0).all()
    found = torch.stack([one.landmarks for one in steps[5:]])
    assert errors(found, truth[3:6]).mean() < 0.035
    assert torch.equal(steps[5].box, box_around(steps[5].landmarks))


def side_by_side(frames: Tensor, scales: tuple[float, float]) -> tuple[Tensor, list[Tensor]]:
    """Two copies of a film in one, each scaled, and how to bring points of the first film into each."""
    wide = torch.full((len(frames), 3, 260, 520), 90, dtype=torch.uint8)
    maps = []
    for place, scale in enumerate(scales):
        side = round(SIZE * scale)
        copy = torch.nn.functional.interpolate(frames.float(), size=(side, side), mode="bilinear", antialias=True)
        wide[:, :, 10 : 10 + side, 260 * place + 10 : 260 * place + 10 + side] = copy.round().to(torch.uint8)
        maps.append(torch.tensor([side / SIZE, 260 * place + 10.0, 10.0]))
    return wide, maps


def mapped(points: Tensor, way: Tensor) -> Tensor:
    return (points + 0.5) * way[0] - 0.5 + way[1:]


def test_it_stays_with_the_face_asked_for(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    early, maps = side_by_side(frames[:3], (1.2, 0.8))
    alone = early.clone()
    alone[:, :, :, 260:] = 90
    late, later = side_by_side(frames[3:5], (1.2, 1.5))  # the other one is the larger now
    video = torch.cat([alone[:1], early[1:], late])
    track = track_landmarks(video, LandmarkTracker(trees))
    assert errors(track.values, mapped(truth[:5], maps[0])).mean() < 0.04
    second = track_landmarks(torch.cat([alone[:1], early[1:]]), LandmarkTracker(trees, face=1))
    assert second.values[0].isnan().all()  # there is but one
    assert errors(second.values[1:], mapped(truth[1:3], maps[1])).mean() < 0.04
    assert later[0].equal(maps[0])


def test_after_a_cut_the_face_is_found_elsewhere(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    here, _ = side_by_side(frames[:2], (1.0, 1.0))
    here[:, :, :, 260:] = 90
    there, maps = side_by_side(frames[:1].repeat(3, 1, 1, 1), (1.0, 1.0))
    there[:, :, :, :260] = 90
    track = track_landmarks(torch.cat([here, there]), LandmarkTracker(trees))
    assert not track.values[:, 0, 0].isnan().any()  # from the first frame on
    assert errors(track.values[2:], mapped(truth[:1], maps[1])).mean() < 0.04


def test_a_turned_face_is_found_at_once(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    for quarters in (1, 2, 3):
        turned, points = frames[:2].rot90(quarters, (-2, -1)), truth[:2]
        for _ in range(quarters):
            points = torch.stack([points[..., 1], SIZE - 1 - points[..., 0]], -1)
        track = track_landmarks(turned, LandmarkTracker(trees))
        assert errors(track.values, points).mean() < 0.04
    assert (
        errors(
            find_landmarks(frames[0].rot90(1, (-2, -1)), trees).landmarks[None],
            torch.stack([truth[:1, :, 1], SIZE - 1 - truth[:1, :, 0]], -1),
        ).mean()
        < 0.04
    )


def test_what_is_black_is_hidden(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    seen = LandmarkTracker(trees).step(frames[0])
    assert (seen.visibility[17:] == 1).all()
    half = frames[0].clone()
    half[..., : int(truth[0, 27:31, 0].mean())] = 0
    tracker = LandmarkTracker(trees)
    tracker.step(frames[0])
    found = tracker.step(half)
    hidden = torch.tensor([36, 37, 41, 40, 48, 18, 19])
    assert not found.found or bool((found.visibility[hidden] < 0.5).all())
    assert not found.found or bool((found.confidence[hidden] < 0.3).all())


def test_an_appearance_model_refines(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    learned, rest = [0, 3, 6, 9], [4, 5, 7]
    model = AppearanceModel.fit([frames[t] for t in learned], truth[learned])
    plain = track_landmarks(frames[rest], LandmarkTracker(trees))
    refined = track_landmarks(frames[rest], LandmarkTracker(trees, model))
    assert errors(refined.values, truth[rest]).mean() < 0.7 * errors(plain.values, truth[rest]).mean()


def test_a_moved_or_mirrored_picture_moves_the_landmarks(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    grey, box = frames[0, 1], box_around(truth[:1])[0]

    def placed(x: int, y: int) -> Tensor:
        wide = torch.full((SIZE + 100, SIZE + 100), 128, dtype=torch.uint8)
        wide[y : y + SIZE, x : x + SIZE] = grey
        return wide

    found = consensus(trees, placed(40, 40), box + torch.tensor([40, 40, 0, 0]))
    assert (found.dispersion >= 0).all()
    moved = consensus(trees, placed(57, 44), box + torch.tensor([57, 44, 0, 0]))
    assert torch.allclose(moved.landmarks, found.landmarks + torch.tensor([17, 4]), atol=1e-3)
    across = torch.cat([SIZE + 99 - 40 - box[:1] - box[2:3], box[1:2] + 40, box[2:]])
    mirrored = consensus(trees, placed(40, 40).flip(-1), across).landmarks[list(MIRROR_68)]
    back = mirrored * torch.tensor([-1, 1]) + torch.tensor([SIZE + 99, 0])
    assert (back - found.landmarks).norm(dim=-1).mean() < 0.15


@pytest.mark.parametrize("quarters", [1, 2])
def test_trees_find_a_face_that_is_turned_as_they_are_told(
    trees: LandmarkTrees, film: tuple[Tensor, Tensor], quarters: int
) -> None:
    image, truth = film[0][0], film[1][0]
    image = image[1]
    angle = math.pi / 2 * quarters
    upright = consensus(trees, image, box_around(truth))
    last = torch.tensor([image.shape[1] - 1.0, image.shape[0] - 1.0])
    turned = [torch.stack([last[1] - truth[:, 1], truth[:, 0]], 1), last - truth][quarters - 1]
    found = consensus(trees, image.rot90(-quarters).contiguous(), turned_box(turned)[0], angle)
    off, before = (
        (one - two).norm(dim=1).mean() for one, two in ((found.landmarks, turned), (upright.landmarks, truth))
    )
    assert float(off) < 1.2 * float(before)
    assert float(found.dispersion.mean()) < 1.5 * float(upright.dispersion.mean())


def test_jitter_is_the_deviation_of_planted_noise() -> None:
    noise = 0.7 * torch.randn(400, 68, 2, generator=torch.Generator().manual_seed(0))
    path = torch.arange(400.0)[:, None, None] * torch.tensor([1.3, -0.4]) + 100
    assert float(landmark_jitter(path)) < 1e-4
    assert float(landmark_jitter(path + noise)) == pytest.approx(0.7, rel=0.02)
    holes = (path + noise).clone()
    holes[50:60] = torch.nan
    assert float(landmark_jitter(holes)) == pytest.approx(0.7, rel=0.02)
    assert landmark_jitter(path[:2]).isnan()
    with pytest.raises(ShapeError, match=r"expected \(T,L,2\)"):
        landmark_jitter(path[0])


def test_a_photograph_shows_its_landmarks(trees: LandmarkTrees, film: tuple[Tensor, Tensor]) -> None:
    frames, truth = film
    pair, maps = side_by_side(frames[:1], (0.8, 1.4))
    for number, way in ((0, maps[1]), (1, maps[0])):
        found = find_landmarks(pair[0], trees, number)
        assert errors(found.landmarks[None], mapped(truth[:1], way)).mean() < 0.04
    with pytest.raises(NoFaceError, match="found 2 faces, expected more than 2"):
        find_landmarks(pair[0], trees, 2)
    with pytest.raises(NoFaceError, match="found no face"):
        find_landmarks(torch.zeros(64, 64, dtype=torch.uint8), trees)


def test_what_cannot_be_tracked_is_said(trees: LandmarkTrees, tmp_path: Path) -> None:
    with pytest.raises(ValueRangeError, match="5 landmarks, expected the 68"):
        LandmarkTracker(LandmarkTrees(5, 1, 1, 1, 4, 10))
    with pytest.raises(ValueRangeError, match="face: found -1"):
        LandmarkTracker(trees, face=-1)
    with pytest.raises(ShapeError, match="expected uint8"):
        LandmarkTracker(trees).step(torch.zeros(3, 40, 40))
    with pytest.raises(ShapeError, match="resume"):
        LandmarkTracker(trees).resume(torch.zeros(5))
    with pytest.raises(ValueRangeError, match="consensus: found 3 starts"):
        ConsensusSettings(starts=3)
    with pytest.raises(ValueRangeError, match="box"):
        consensus(trees, torch.zeros(40, 40, dtype=torch.uint8), torch.full((4,), torch.nan))
    empty = write_video([torch.full((3, 60, 80), 99, dtype=torch.uint8)], tmp_path / "wall.avi", 25.0)
    track = track_landmarks(empty, LandmarkTracker(trees))
    assert track.values.shape == (3, 68, 2)
    assert track.values.isnan().all()


@pytest.mark.bench  # the shipped network tracks one in tests/workflows/track
@pytest.mark.real
def test_a_real_face_is_tracked_and_no_face_is_none(trees: LandmarkTrees, data: Path) -> None:
    track = track_landmarks(list(open_video(data / "video" / "single_face.mp4").frames())[:36], LandmarkTracker(trees))
    assert torch.isfinite(track.values).all()
    assert len(track) == 36
    assert landmark_jitter(track.values) < 0.6  # pixels, of a box of 200
    nothing = track_landmarks(list(open_video(data / "video" / "no_face.mp4").frames())[::8], LandmarkTracker(trees))
    assert nothing.values.isnan().all()
    picture = (load_image(data / "images" / "ibug" / "image_0010.png") * 255).round().to(torch.uint8)
    truth = load_landmark_points(data / "images" / "ibug" / "image_0010.pts").ibug().float()
    assert errors(find_landmarks(picture, trees).landmarks[None], truth[None]).mean() < 0.1
