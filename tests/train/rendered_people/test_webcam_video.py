"""Webcam videos of synthetic people: truth lies where it is drawn, weights drive it, who is away is not seen."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from planted.landmark_measures import lid_openings, mouth_gap
from torchface.shape_names import ARKIT
from train.rendered_people.head_kind import performer_kind
from train.rendered_people.looks import draw_looks
from train.rendered_people.people import Person
from train.rendered_people.turned_eyes import iris_centres
from train.rendered_people.webcam_performance import (
    SittingSettings,
    WebcamPerformance,
    gaze_of,
    sitting,
    with_blinks,
    with_speech,
)
from train.rendered_people.webcam_video import WebcamFrame, WebcamSettings, posed_head, webcam_frames

FPS = 10.0
STILL = SittingSettings(distance=500, yaw=0, pitch=0, tilt=0, drift=0)
CAMERA = WebcamSettings(160, 120, focal=150, blur=0.3, noise=0, quality=100)
POSES: dict[str, dict[str, float]] = {
    "rest": {},
    "again": {},
    "open": {"jawOpen": 0.8},
    "shut": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "left": {"eyeLookInRight": 1.0, "eyeLookOutLeft": 1.0},
}


@pytest.fixture(scope="module")
def person() -> Person:
    generator = torch.Generator().manual_seed(3)
    kind = performer_kind()
    looks = draw_looks(generator)
    return Person(kind, kind.draw(generator), replace(looks, glasses=None, hairdo=replace(looks.hairdo, curtain=0.0)))


def weights_of(*poses: dict[str, float]) -> Tensor:
    weights = torch.zeros(len(poses), len(ARKIT))
    for row, pose in enumerate(poses):
        for name, value in pose.items():
            weights[row, ARKIT.index(name)] = value
    return weights


@pytest.fixture(scope="module")
def acted() -> WebcamPerformance:
    return sitting(weights_of(*POSES.values()), FPS, torch.Generator().manual_seed(1), STILL)


@pytest.fixture(scope="module")
def frames(person: Person, acted: WebcamPerformance) -> dict[str, WebcamFrame]:
    return dict(zip(POSES, webcam_frames(person, acted, 5, CAMERA), strict=True))


def test_landmarks_lie_where_the_pose_and_the_camera_put_the_head(
    person: Person, acted: WebcamPerformance, frames: dict[str, WebcamFrame]
) -> None:
    tip = person.kind.landmarks[30]
    seen = acted.rotation[0] @ person.head.rest[tip].double() + acted.translation[0]
    pixel = CAMERA.intrinsics @ (seen / seen[2])
    torch.testing.assert_close(frames["rest"].landmarks[30].double(), pixel[:2], atol=1e-3, rtol=0)
    # Who sits still looks straight into the camera from where they sit.
    torch.testing.assert_close(acted.rotation[0], torch.tensor([1.0, -1.0, -1.0]).diag().double())
    assert float(acted.translation[0, 2]) == pytest.approx(500, abs=1)
    assert bool(frames["rest"].present)
    assert bool(frames["rest"].visible[17:].all())


def test_lamps_room_and_looks_do_not_change_from_frame_to_frame(frames: dict[str, WebcamFrame]) -> None:
    assert torch.equal(frames["rest"].picture, frames["again"].picture)
    marks = frames["rest"].landmarks
    brow = int(marks[17:27, 1].min()) - 2
    above = (frames["rest"].picture[:, :brow].float() - frames["open"].picture[:, :brow].float()).abs()
    assert float(above.max()) <= 18  # compression, and an exposure that measures the whole skin
    below = frames["rest"].picture[:, brow:].float() - frames["open"].picture[:, brow:].float()
    assert float(below.abs().max()) > 40


def test_weights_drive_mouth_lids_and_gaze(frames: dict[str, WebcamFrame]) -> None:
    marks = {name: frame.landmarks for name, frame in frames.items()}
    assert float(mouth_gap(marks["open"])) > float(mouth_gap(marks["rest"])) + 0.15
    assert float(lid_openings(marks["rest"]).min()) > 0.05
    assert float(lid_openings(marks["shut"]).abs().max()) < 0.02
    moved = frames["left"].iris - frames["rest"].iris
    assert float(moved[:, 0].min()) > 1.0  # the person's left is the picture's right
    # The pupil is darker where it is than where it was.
    grey = {name: frames[name].picture.float().mean(0) for name in ("rest", "left")}
    x, y = frames["left"].iris.round().long().unbind(1)
    assert bool((grey["left"][y, x] < grey["rest"][y, x]).all())


def test_the_gaze_of_weights_is_that_of_the_eyeballs(person: Person) -> None:
    weights = weights_of({"eyeLookInRight": 0.5, "eyeLookOutLeft": 0.5, "eyeLookUpLeft": 0.4, "eyeLookUpRight": 0.4})[0]
    gaze = gaze_of(weights)
    assert bool((gaze > 0).all())  # to the person's left, up
    moved = iris_centres(person.kind, posed_head(person, weights)) - iris_centres(person.kind, person.head.rest)
    # About 11 mm from the middle of an eyeball, turned by 15 and 10 degrees.
    torch.testing.assert_close(moved[:, :2], torch.tensor([[2.85, 1.9]] * 2), atol=0.6, rtol=0)
    torch.testing.assert_close(gaze[0], gaze[1])


def test_who_turns_away_has_no_face_and_a_hand_hides_the_mouth(person: Person) -> None:
    rest = weights_of(*[{}] * 20)
    generator = torch.Generator().manual_seed(2)
    away = sitting(rest, FPS, generator, STILL, away=0.1)
    away = WebcamPerformance(FPS, rest[:1], away.rotation[9:10], away.translation[9:10], away.hand[9:10])
    (turned,) = webcam_frames(person, away, 5, CAMERA)
    assert not bool(turned.present)
    brows = turned.visible[17:27]
    assert not bool(brows[:5].any() and brows[5:].any())  # a profile at most
    hand = sitting(rest, FPS, generator, STILL, hand=0.1)
    assert float(hand.hand[8]) == 1.0
    hand = WebcamPerformance(FPS, rest[:1], hand.rotation[8:9], hand.translation[8:9], hand.hand[8:9])
    (covered,) = webcam_frames(person, hand, 5, CAMERA)
    assert int(covered.visible[48:].sum()) <= 6
    assert bool(covered.visible[17:27].all())
    assert bool(covered.present)


def test_speech_moves_the_mouth_alone_and_blinks_shut_the_lids() -> None:
    generator = torch.Generator().manual_seed(0)
    calm = torch.full((60, len(ARKIT)), 0.1)
    talking = with_speech(calm, 30.0, generator, 0.5, 1.5)
    changed = (talking != calm).any(0)
    moved = {name for name, moves in zip(ARKIT, changed, strict=True) if moves}
    assert {"jawOpen", "mouthSmileLeft", "cheekSquintLeft"} < moved
    assert all(name.startswith(("jaw", "mouth", "cheek")) for name in moved)
    assert float(talking[:, ARKIT.index("jawOpen")].max()) > 0.7
    assert torch.equal(talking[:15], calm[:15])
    blinking = with_blinks(calm, 30.0, (1.0,))
    lids = blinking[:, [ARKIT.index("eyeBlinkLeft"), ARKIT.index("eyeBlinkRight")]]
    assert float(lids.max()) > 0.98
    assert torch.equal(lids[:30], calm[:30, :2])
