"""Eyes of a take: lids beside the person's own, gaze beside straight ahead, both as readings of a rig's weights."""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from planted.seen_irises import irises
from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.own_rig.eye_geometry import CORNERS, Eyeballs
from torchface.capture.own_rig.face_measurements import FaceMeasurements
from torchface.capture.own_rig.take_eyes import TakeEyes, take_eyes
from torchface.geometry.rotations import rotation_matrix
from torchface.landmarks.images.face_reading import FaceReading
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic import performer

FRAMES, SHUT = 60, slice(20, 24)
TIMES = 200  # that the person does so
NARROW = 0.21  # openness of this person's open eyes
K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]]).double()
ROTATION = torch.diag(torch.tensor([1.0, -1, -1]).double()).expand(FRAMES, 3, 3)
TRANSLATION = torch.tensor([0.0, 0, 520]).double().expand(FRAMES, 3)


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False)


def true_gaze() -> Tensor:
    """To both sides and back, and up."""
    at = torch.linspace(0, 12.6, FRAMES).double()
    return torch.stack([0.25 * at.sin(), 0.12 * (2 * at).sin()], -1)[:, None].expand(-1, 2, -1)


@pytest.fixture(scope="module")
def eyes(rig: BlendshapeRig) -> TakeEyes:
    return seen_eyes(rig, 0.97)


def seen_eyes(rig: BlendshapeRig, surely: float) -> TakeEyes:
    """A narrow-eyed person who blinks once, which a network sees more or less surely; while the eyes are shut irises
    are anywhere. Two seconds of a minute."""
    marks = rig.vertices[rig.neutral.landmarks].double()
    placed = marks @ ROTATION[0].T + TRANSLATION[0]
    rays = (placed[:, :2] / placed[:, 2:]).expand(FRAMES, -1, -1)
    iris = irises(rig, true_gaze(), ROTATION, TRANSLATION)
    iris[SHUT] += 0.01
    closed, openness = torch.zeros(FRAMES, 2), torch.full((FRAMES, 2), NARROW)
    closed[SHUT], openness[SHUT] = surely, 0.06
    openness[40:44] = 1.4 * NARROW
    middles = torch.stack([0.5 * (placed[a] + placed[b]) for a, b in CORNERS])[:, 2].expand(FRAMES, 2)
    rays, iris, closed, openness, turned, middles = (
        torch.cat([part] * TIMES) for part in (rays, iris, closed, openness, ROTATION, middles)
    )
    count = TIMES * FRAMES
    reading = FaceReading(
        (700 * rays + K[:2, 2]).float(), torch.ones(count, 68), torch.ones(count, 68), torch.ones(count),
        iris.float(), openness, closed, torch.ones(count, 2),
    )  # fmt: skip
    found = take_eyes(reading, rays, iris, turned, middles, torch.ones(count), Eyeballs.of(rig))
    return TakeEyes(*(getattr(found, part.name)[:FRAMES] for part in fields(found)))


def test_openness_is_beside_the_persons_own(eyes: TakeEyes) -> None:
    assert float(eyes.open[SHUT].abs().max()) == 0
    assert float((eyes.open[:20] - 1).abs().max()) < 0.02
    assert 1.3 < float(eyes.open[40:44].mean()) < 1.7


def test_gaze_follows_and_is_held_while_eyes_are_shut(eyes: TakeEyes) -> None:
    seen, true = eyes.gaze.mean(1), true_gaze()[:, 0]
    opened = torch.ones(FRAMES, dtype=torch.bool)
    opened[SHUT] = False
    for way in range(2):
        assert float(torch.corrcoef(torch.stack([seen[opened, way], true[opened, way]]))[0, 1]) > 0.99
    assert torch.equal(eyes.gaze[SHUT], eyes.gaze[SHUT.start - 1].expand(4, -1, -1))
    assert float((eyes.gaze[:, 0, 0] - eyes.gaze[:, 1, 0]).abs().max()) < 0.25  # both look at one thing


def test_gaze_is_held_too_where_shut_eyes_are_not_surely_shut(rig: BlendshapeRig) -> None:
    """Between lids that nearly touch an iris is a guess."""
    eyes = seen_eyes(rig, 0.5)
    assert torch.equal(eyes.gaze[SHUT], eyes.gaze[SHUT.start - 1].expand(4, -1, -1))
    assert float(eyes.gaze_trust[SHUT].max()) < 0.1


def test_lids_that_landmarks_leave_open_shut_on_the_rig(rig: BlendshapeRig, eyes: TakeEyes) -> None:
    """The landmarks' lids never close, the eye network's do: so do the rig's, and no others."""
    solver = VideoSolver(rig, None, K, settings=VideoSettings.of_found_landmarks())
    marks = rig.vertices[rig.neutral.landmarks].double() @ ROTATION[0].T + TRANSLATION[0]
    pixels = (marks @ K.T)[:, :2] / marks[:, 2:]
    frames = torch.arange(14, 26)
    read = eyes.readings(solver.rest[:68], solver.basis[:68], rig.names, Eyeballs.of(rig)).of_frames(frames)
    trust, found = eyes.agreed(torch.ones(FRAMES, 68))[frames], pixels.expand(len(frames), -1, -1)
    solved = solver(found, confidence=trust, measured=FaceMeasurements(weights=read))
    blinks = solved.weights[:, [rig.names.index(f"eyeBlink{side}") for side in ("Left", "Right")]]
    shut = (frames >= SHUT.start) & (frames < SHUT.stop)
    assert float(blinks[shut][1:].min()) > 0.9
    assert float(blinks[~shut][:5].max()) < 0.1
    turned = eyes.turned(torch.cat([solved.weights.double()]), rig.names, Eyeballs.of(rig))
    off = (turned - eyes.gaze[frames])[frames < SHUT.start].abs()
    assert float(off.median().rad2deg()) < 0.5
    assert float(off.max().rad2deg()) < 6  # in the frame in which a gaze goes over to the other side


def test_lids_landmarks_that_disagree_count_less(eyes: TakeEyes) -> None:
    trust = eyes.agreed(torch.ones(FRAMES, 68))
    assert torch.equal(trust[:, :36], torch.ones(FRAMES, 36))
    assert torch.equal(trust[:, 48:], torch.ones(FRAMES, 20))
    assert float(trust[SHUT, 36:48].max()) < 0.3


def test_lids_whose_landmarks_are_doubted_shut_by_what_is_read(rig: BlendshapeRig, eyes: TakeEyes) -> None:
    """As behind glasses: no landmark of an eye counts, and the eye network sees the blink."""
    solver = VideoSolver(rig, None, K, settings=VideoSettings.of_found_landmarks())
    marks = rig.vertices[rig.neutral.landmarks].double() @ ROTATION[0].T + TRANSLATION[0]
    frames, trust = torch.arange(14, 26), torch.ones(12, 68)
    trust[:, 36:48] = 0.0
    read = eyes.readings(solver.rest[:68], solver.basis[:68], rig.names, Eyeballs.of(rig)).of_frames(frames)
    found = ((marks @ K.T)[:, :2] / marks[:, 2:]).expand(len(frames), -1, -1)
    solved = solver(found, confidence=trust, measured=FaceMeasurements(weights=read))
    blinks = solved.weights[:, [rig.names.index(f"eyeBlink{side}") for side in ("Left", "Right")]]
    shut = (frames >= SHUT.start) & (frames < SHUT.stop)
    assert float(blinks[shut][1:].min()) > 0.8
    assert float(blinks[~shut][:5].max()) < 0.1


def test_a_lasting_gaze_is_the_persons_own_where_eyes_stay_on_the_lens(rig: BlendshapeRig) -> None:
    """Eyes that lie otherwise seem to look up as the head nods before a lens; a network knows those that do look up."""
    up, count = 0.2, 90
    nod = torch.zeros(count, 3).double()
    nod[:, 0] = 0.08 * torch.linspace(0, 9, count).double().sin()
    turned, place = rotation_matrix(nod) @ ROTATION[:1], TRANSLATION[:1].expand(count, -1)
    placed = rig.vertices[rig.neutral.landmarks].double() @ turned.transpose(1, 2) + place[:, None]
    rays, depth = placed[..., :2] / placed[..., 2:], torch.stack([placed[:, a, 2] for a, _ in CORNERS], 1)
    lens = -torch.nn.functional.normalize(placed[:, 36:48].mean(1), dim=1)[:, None] @ turned
    lens = torch.stack([torch.zeros(count).double(), torch.asin(lens[:, 0, 1])], 1)
    gaze = (lens + torch.tensor([0.0, up]))[:, None].expand(-1, 2, -1)
    iris, ones = irises(rig, gaze, turned, place), torch.ones(count, 68)
    seen = FaceReading(
        (700 * rays + K[:2, 2]).float(), ones, ones, ones[:, 0], iris.float(), torch.full((count, 2), 0.3),
        torch.zeros(count, 2), torch.ones(count, 2),
    )  # fmt: skip
    expression = torch.zeros(count, 52)
    expression[:, [ARKIT.index("eyeLookUpLeft"), ARKIT.index("eyeLookUpRight")]] = float(gaze[..., 1].mean()) / 0.45
    believed = replace(seen, expression=expression, expression_deviation=torch.full((count, 52), 0.02))
    beside = [
        float(
            (take_eyes(one, rays, iris, turned, depth, torch.ones(count), Eyeballs.of(rig)).gaze - gaze)[..., 1].mean()
        )
        for one in (seen, believed)
    ]
    assert -0.2 < beside[0] < -0.1
    assert abs(beside[1]) < 0.05
