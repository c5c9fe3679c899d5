"""Anybody's finder drives the tracker; one that breaks the protocol is named, with the frame."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks import FaceBoxes, FaceReading, LandmarkTracker, NoFaceError, find_landmarks, track_landmarks
from torchface.landmarks.images.face_reading import trust_of
from torchface.landmarks.images.ibug_68 import box_around, tilt_around, turned_box
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def face() -> Tensor:
    """The performer's landmarks from the front, (68,2) pixels, about their mean, the eyes 60 apart."""
    rig = performer()
    points = rig.vertices[rig.neutral.landmarks][:, :2] * torch.tensor([1.0, -1.0])
    points = points - points.mean(0)
    return points * 60 / (points[36] - points[45]).norm()


def turned(points: Tensor, angle: float) -> Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ torch.tensor([[cos, sin], [-sin, cos]])


def test_boxes_turn_with_the_face(face: Tensor) -> None:
    upright = turned_box(face)[0]
    assert float(tilt_around(face)) == pytest.approx(0, abs=0.02)
    for angle in (0.7, -2.0, math.pi - 0.1):
        found = tilt_around(turned(face, angle)) - tilt_around(face)
        assert math.remainder(float(found) - angle, math.tau) == pytest.approx(0, abs=1e-5)
        box = turned_box(turned(face, angle))[0]
        middle, expected = box[:2] + box[2:] / 2, turned((upright[:2] + upright[2:] / 2)[None], angle)[0]
        torch.testing.assert_close(middle, expected, atol=1e-3, rtol=0)
        torch.testing.assert_close(box[2:], upright[2:], atol=1e-3, rtol=0)


class Knowing:
    """Finds a planted face wherever the box is, unless it is more than half a side away."""

    name = "planted"

    def __init__(self, landmarks: Tensor) -> None:
        self.landmarks = landmarks

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        at = self.landmarks
        away = (at.mean(0) - box[:2] - box[2:] / 2).norm() / box[2]
        return FaceReading(at, 0.01 * box[2] * torch.ones(68), torch.ones(68), (away < 0.5).float())


def test_a_finder_of_ones_own_is_followed(face: Tensor) -> None:
    finder = Knowing(face + 100)
    tracker = LandmarkTracker(finder, detector=lambda _: FaceBoxes(box_around(face + 104)[None], torch.ones(1)))
    frames = torch.zeros(4, 200, 200, dtype=torch.uint8)
    track = track_landmarks(frames, tracker)
    torch.testing.assert_close(track.values, (face + 100).expand(4, -1, -1))
    torch.testing.assert_close(track.confidence, torch.full((4, 68), 0.8))
    finder.landmarks = face + 400
    assert not tracker.step(frames[0]).found


class Stage:
    """People of plain colours in grey, who know where their landmarks are; the first of them stands in front."""

    def __init__(self, face: Tensor, colours: list[tuple[int, int, int]]) -> None:
        self.face, self.colours = face, colours
        self.places: list[Tensor] = []

    def frame(self, *places: tuple[float, float]) -> Tensor:
        """A picture (3,200,400) with somebody at each place."""
        self.places = [torch.tensor(place) for place in places]
        picture = torch.full((3, 200, 400), 90, dtype=torch.uint8)
        for place, colour in reversed(list(zip(self.places, self.colours, strict=True))):
            x, y = place.int().tolist()
            left, right = max(x - 29, 0), max(x + 29, 0)
            picture[:, y - 29 : y + 29, left:right] = torch.tensor(colour).byte()[:, None, None]
            picture[:, y - 5 : y + 5, left:right] //= 2
        return picture

    def seen(self) -> list[Tensor]:
        """Those whom nobody hides."""
        shown: list[Tensor] = []
        for place in self.places:
            if all(float((place - other).norm()) > 60 for other in shown):
                shown.append(place)
        return shown

    def find(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        middle = box[:2] + box[2:] / 2
        near = min(self.seen(), key=lambda place: float((place - middle).norm()))
        there = ((near - middle).norm() < 0.5 * box[2]).float()
        return FaceReading(self.face + near, 0.01 * box[2] * torch.ones(68), torch.ones(68), there)

    def detect(self, image: Tensor) -> FaceBoxes:
        smaller = image.shape[-1] / 400  # the copy that a detector is shown
        boxes = smaller * torch.stack([box_around(self.face + place) for place in self.seen()])
        return FaceBoxes(boxes, torch.ones(len(boxes)))


def test_two_who_change_places_stay_apart(face: Tensor) -> None:
    stage = Stage(face, [(200, 120, 90), (70, 90, 180)])
    for followed in (0, 1):  # the one in front, and the one behind
        tracker = LandmarkTracker(stage.find, detector=stage.detect, face=followed)
        for t in range(31):
            places = ((100 + 6.0 * t, 100.0), (300 - 6.0 * t, 100.0))
            found = tracker.step(stage.frame(*places))
            if found.found:  # never the other one
                assert float((found.landmarks - face - torch.tensor(places[followed])).norm(dim=1).max()) < 1, t
            hidden = followed == 1 and abs(places[0][0] - places[1][0]) <= 60
            assert found.found != hidden, t


def test_a_face_that_was_hidden_or_went_is_noticed_and_found_again(face: Tensor) -> None:
    stage = Stage(face, [(200, 120, 90)])
    tracker = LandmarkTracker(stage.find, detector=stage.detect)
    assert tracker.step(stage.frame((100.0, 100.0))).found
    stage.frame((500.0, 100.0))  # behind the edge
    gone = torch.full((3, 200, 400), 90, dtype=torch.uint8)
    assert not any(tracker.step(gone).found for _ in range(5))
    assert tracker.step(stage.frame((300.0, 100.0))).found  # elsewhere, at once
    assert tracker.step(stage.frame((306.0, 100.0))).found


@pytest.mark.parametrize("elsewhere", [(320.0, 100.0), (60.0, 40.0)])
def test_somebody_else_is_found_at_once_after_a_cut(face: Tensor, elsewhere: tuple[float, float]) -> None:
    stage = Stage(face, [(200, 120, 90)])
    tracker = LandmarkTracker(stage.find, detector=stage.detect)
    for _ in range(3):
        assert tracker.step(stage.frame((200.0, 100.0))).found
    stage.colours = [(40, 90, 180)]
    assert tracker.step(stage.frame(elsewhere)).found


@pytest.mark.parametrize("followed", [0, 1])
def test_a_person_is_found_again_after_a_cut_to_that_person_alone(face: Tensor, followed: int) -> None:
    colours = [(200, 120, 90), (70, 90, 180)]
    for elsewhere in ((200.0, 110.0), (60.0, 60.0), (330.0, 140.0)):
        stage = Stage(face, colours)
        tracker = LandmarkTracker(stage.find, detector=stage.detect, face=followed)
        for _ in range(4):
            found = tracker.step(stage.frame((90.0, 100.0), (310.0, 100.0)))
        person = int(found.landmarks[:, 0].mean() > 200)
        assert person == followed
        stage.colours = [colours[person]]
        assert all(tracker.step(stage.frame(elsewhere)).found for _ in range(30)), elsewhere


@pytest.mark.parametrize("fps", [15.0, 30.0, 60.0])
def test_who_stood_there_already_is_not_taken_for_one_who_is_hidden_for_a_moment(face: Tensor, fps: float) -> None:
    stage = Stage(face, [(200, 120, 90), (70, 90, 180)])
    tracker = LandmarkTracker(stage.find, detector=stage.detect, fps=fps)
    there, gone, other = (70.0, 100.0), (-300.0, 100.0), (330.0, 100.0)
    for _ in range(3):
        assert tracker.step(stage.frame(there, other)).found
    for _ in range(round(0.3 * fps)):
        assert not tracker.step(stage.frame(gone, other)).found
    back = tracker.step(stage.frame(there, other))
    assert float((back.landmarks - face - torch.tensor(there)).abs().max()) < 1
    for _ in range(round(1.1 * fps)):
        found = tracker.step(stage.frame(gone, other))
    assert float((found.landmarks - face - torch.tensor(other)).abs().max()) < 1


def test_a_resumed_tracker_does_as_one_that_went_on(face: Tensor) -> None:
    stage = Stage(face, [(200, 120, 90)])

    def high(image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        found = stage.find(image, box, tilt)  # five hundredths of the box's side above where the box says the face is
        middle = (box[:2] + box[2:] / 2) * torch.tensor([0.1, 0.1]) + 0.9 * found.landmarks.mean(0)
        return replace(found, landmarks=face + middle - torch.tensor([0.0, 0.05]) * box[2])

    frames = [stage.frame((100 + 3.0 * t, 100.0)) for t in range(8)]
    one, other = (LandmarkTracker(high, detector=stage.detect) for _ in range(2))
    last = None
    for t, frame in enumerate(frames):
        stage.frame((100 + 3.0 * t, 100.0))
        kept = one.step(frame)
        if t == 4:
            memory = other.memory
            other = LandmarkTracker(high, detector=stage.detect)
            other.resume(memory)
        last = other.step(frame)
        assert torch.equal(kept.landmarks, last.landmarks)


def test_a_finder_that_breaks_the_protocol_is_named(face: Tensor) -> None:
    frames = torch.zeros(2, 200, 200, dtype=torch.uint8)
    good = Knowing(face + 100)(frames[0], box_around(face + 100))
    cases = [
        (replace(good, landmarks=face[:5]), ShapeError, r"frame 0: .*function: .*\(5, 2\).*expected \(68,2\)"),
        (replace(good, landmarks=face * torch.nan), ValueRangeError, "68 landmarks that are not finite"),
        (
            replace(good, deviation=torch.full((68,), -1.0)),
            ValueRangeError,
            "deviation from -1 to -1, expected 0 pixels or more",
        ),
        (replace(good, visibility=torch.full((68,), torch.nan)), ValueRangeError, "visibility from nan"),
        (replace(good, presence=torch.tensor(2.0)), ValueRangeError, "presence from 2 to 2, expected 0 to 1"),
    ]
    for found, kind, message in cases:

        def finder(image: Tensor, box: Tensor, tilt: float = 0.0, found: FaceReading = found) -> FaceReading:
            return found

        tracker = LandmarkTracker(finder, detector=lambda _: FaceBoxes(box_around(face + 100)[None], torch.ones(1)))
        with pytest.raises(kind, match=message):
            track_landmarks(frames, tracker)


def test_a_mouth_behind_a_hand_counts_nothing() -> None:
    confidence, visibility = torch.full((2, 68), 0.9), torch.full((2, 68), 0.99)
    visibility[1, 48:58] = 0.1  # the other half of the lips is said to be seen
    trust = trust_of(confidence, visibility)
    torch.testing.assert_close(trust[0], confidence[0])
    assert float(trust[1, 48:].max()) == 0
    assert float(trust[1, 4:13].max()) == 0  # nor does the chin below it
    torch.testing.assert_close(trust[1, 13:48], confidence[1, 13:48])


def test_a_box_that_shows_no_face_is_told() -> None:
    def doubting(image: torch.Tensor, box: torch.Tensor, tilt: float = 0.0) -> FaceReading:
        marks = box[:2] + box[2:] * torch.rand(68, 2, generator=torch.Generator().manual_seed(1))
        return FaceReading(marks, torch.ones(68), torch.ones(68), torch.tensor(0.02))

    def one_box(image: torch.Tensor) -> FaceBoxes:
        return FaceBoxes(torch.tensor([[10.0, 10.0, 40.0, 40.0]]), torch.ones(1))

    with pytest.raises(NoFaceError, match=r"with a probability of 0\.02, expected a face"):
        find_landmarks(torch.zeros(80, 80, dtype=torch.uint8), doubting, detector=one_box)
