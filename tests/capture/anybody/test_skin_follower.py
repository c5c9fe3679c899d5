"""Skin that moves before a webcam: weights by how each frame's face differs from those before."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from planted.skin_films import FRAMES, HEIGHT, MOVED, WIDTH, Film, film_of, part_of, planted
from torchface.capture.antagonist_shapes import signed_quantities
from torchface.capture.anybody import WebcamControls, WebcamState, skin_follower
from torchface.capture.anybody.guided_gains import gain_groups
from torchface.capture.anybody.skin_follower import SkinFollower
from torchface.capture.anybody.webcam_state import GROUPS, StateLayout
from torchface.capture.own_rig.flat_face import FlatFace
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.geometry.cameras.calibration import ASSUMED_FIELD_OF_VIEW, assumed_calibration
from torchface.io.video import open_video
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer

FPS, LACKS = 10, 0.3
ALONE = signed_quantities(ARKIT).abs().sum(0) == 0  # shapes without an antagonist
ROWS = [ARKIT.index(name) for name in MOVED]


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer()


@pytest.fixture(scope="module")
def filmed(rig: BlendshapeRig) -> Film:
    across = 2 * np.arctan(HEIGHT / max(WIDTH, HEIGHT) * np.tan(np.radians(ASSUMED_FIELD_OF_VIEW / 2)))
    return film_of(rig, float(np.degrees(across)))


def solved(names: tuple[str, ...], weights: Tensor, poses: tuple[Tensor, Tensor]) -> list[WebcamState]:
    """States as a solver would give them, of weights (T,N)."""
    start = StateLayout(len(names), 4).start()
    to_arkit = mapping(names, ARKIT)
    return [
        replace(
            start,
            shown=torch.tensor(9.0),
            shapes=row,
            weights=to_arkit @ row,
            pose=torch.cat([turn.flatten(), at]).float(),
        )
        for row, turn, at in zip(weights, *poses, strict=True)
    ]


def shown(film: Film) -> list[np.ndarray]:
    return [np.ascontiguousarray(picture.permute(1, 2, 0).numpy()) for picture in film.pictures]


def followed(follower: SkinFollower, pictures: list[np.ndarray], states: list[WebcamState], times: int) -> Tensor:
    """Weights of the last of several times that a film is shown."""
    for _ in range(times):
        rows = [follower.followed(*given, 1 / FPS) for given in zip(pictures, states, strict=True)]
    return torch.stack(rows)


def test_skin_says_what_weights_lack(rig: BlendshapeRig, filmed: Film) -> None:
    truth = planted(rig.names)
    beyond = 0.25 * (truth.sum(0) > 0)  # so that no change ends at a weight of 0
    states = solved(rig.names, LACKS * truth + beyond, filmed.poses)
    follower = SkinFollower(rig, part_of("skin"))
    pictures, given = shown(filmed), torch.stack([state.weights for state in states])
    torch.testing.assert_close(follower.followed(pictures[0], states[0], 1 / FPS), given[0])  # of what comes, none
    found = followed(follower, pictures, states, 12)
    truth = truth @ mapping(rig.names, ARKIT).T
    for row in ROWS:
        lacks, change = ((one - given)[:, row] - (one - given)[:, row].mean() for one in (truth, found))
        assert torch.corrcoef(torch.stack([lacks, change]))[0, 1] > 0.85
        assert 0.1 < change @ lacks / lacks.square().sum() < 1.1
    moves = [(one - one.mean(0) - truth + truth.mean(0))[:, ROWS].square().mean().sqrt() for one in (given, found)]
    assert moves[1] < 0.8 * moves[0]
    assert (found - given)[:, ROWS].mean(0).abs().max() < 0.06  # the first frames are no more than others
    blinks = [row for row, name in enumerate(ARKIT) if name.startswith("eyeBlink")]
    assert not found[:, blinks].any()
    assert 0 <= float(found.min()) <= float(found.max()) <= 1


def test_gains_divide_what_the_skin_says(rig: BlendshapeRig, filmed: Film) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    halves = [replace(state, gains=torch.full((GROUPS,), 2.0).log()) for state in states]
    once, halved = (followed(SkinFollower(rig, part_of("skin")), pictures, given, 2) for given in (states, halves))
    given = torch.stack([state.weights for state in states])
    scaled = mapping(rig.names, ARKIT) @ gain_groups(rig.names).sum(0).to(given) > 0
    free = (once > 0) & (halved > 0) & ALONE
    torch.testing.assert_close((halved - given)[free & scaled], 0.5 * (once - given)[free & scaled])
    torch.testing.assert_close((halved - given)[free & ~scaled], (once - given)[free & ~scaled])
    follower = SkinFollower(rig, part_of("skin"))
    for picture, state in zip(pictures, states, strict=True):
        none = follower.followed(picture, state, 1 / FPS, WebcamControls(gain=0.0))
        torch.testing.assert_close(none, state.weights)


def test_a_lost_face_and_a_reset_leave_weights_alone(rig: BlendshapeRig, filmed: Film) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    follower = SkinFollower(rig, part_of("skin"))
    before = (followed(follower, pictures, states, 3)[-1] - states[-1].weights)[ALONE]
    gone = replace(states[-1], lost=torch.tensor(0.1))
    steps = [(follower.followed(pictures[-1], gone, 0.1) - gone.weights)[ALONE] for _ in range(20)]
    torch.testing.assert_close(steps[0].clamp(min=0), before.clamp(min=0) * math.exp(-0.1 / 0.4))
    assert steps[-1].abs().max() < 0.002
    again = follower.followed(pictures[3], states[3], 1 / FPS, WebcamControls(reset=True))
    torch.testing.assert_close(again, states[3].weights)
    nobody = StateLayout(len(rig.names), 4).start()
    assert not SkinFollower(rig, part_of("skin")).followed(pictures[0], nobody, 1 / FPS).any()


def test_who_takes_over_is_followed_as_the_first_one_was(rig: BlendshapeRig, filmed: Film) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    others, given = [255 - picture for picture in pictures], torch.stack([state.weights for state in states])
    follower = SkinFollower(rig, part_of("skin"))
    followed(follower, pictures, states, 3)
    late, first = (followed(one, others, states, 6) - given for one in (follower, SkinFollower(rig, part_of("skin"))))
    moves = [(one - one.mean(0))[:, ROWS].square().mean().sqrt() for one in (late, first)]
    assert moves[0] > 0.7 * moves[1]


def test_lids_that_are_shut_do_not_rise(rig: BlendshapeRig, filmed: Film) -> None:
    lid, risen = (ARKIT.index(name) for name in ("eyeBlinkLeft", "eyeWideLeft"))
    states = solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    shut = [replace(state, weights=state.weights.index_fill(0, torch.tensor(lid), 0.3)) for state in states]
    opened, found = (followed(SkinFollower(rig, part_of("skin")), shown(filmed), given, 3) for given in (states, shut))
    assert opened[:, risen].max() > 0.01
    assert not found[:, risen].any()
    torch.testing.assert_close(found[:, lid], torch.full((FRAMES,), 0.3))


def test_a_face_is_looked_at_when_it_has_been_there_for_a_second(rig: BlendshapeRig, filmed: Film) -> None:
    """What the first solves of a face are off by is no reference."""
    states = solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    pictures, follower = shown(filmed), SkinFollower(rig, part_of("skin"))
    new = [replace(state, shown=torch.tensor(0.9)) for state in states]
    torch.testing.assert_close(followed(follower, pictures, new, 3), torch.stack([one.weights for one in new]))
    assert (followed(follower, pictures, states, 2)[-1] - states[-1].weights).abs().max() > 0.01


def test_pictures_with_opacity_or_mirrored_are_followed_alike(rig: BlendshapeRig, filmed: Film) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    opaque = [np.concatenate([picture, picture[..., :1]], 2) for picture in pictures]
    views = [np.ascontiguousarray(picture[:, ::-1])[:, ::-1] for picture in pictures]
    plain, *others = (followed(SkinFollower(rig, part_of("skin")), one, states, 1) for one in (pictures, opaque, views))
    for other in others:
        torch.testing.assert_close(other, plain)


def test_smoothing_calms_what_the_skin_says(rig: BlendshapeRig, filmed: Film) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    steps = []
    for smoothing in (0.0, 0.5, 1.0):
        follower, controls = SkinFollower(rig, part_of("skin")), WebcamControls(smoothing=smoothing)
        rows = [follower.followed(*given, 1 / FPS, controls) for given in zip(pictures * 2, states * 2, strict=True)]
        changes = torch.stack(rows) - torch.stack([state.weights for state in states * 2])
        steps.append(float(changes.diff(dim=0).norm()))
    assert steps[0] > 1.1 * steps[1] > 1.2 * steps[2]


def test_no_smoothing_leaves_each_frame_to_itself(
    rig: BlendshapeRig, filmed: Film, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a filter makes of a frame depends on how long ago the last one was."""
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    monkeypatch.setattr(skin_follower, "_GROWS", 1e-6)  # at once in full

    def played(fps: float, smoothing: float) -> Tensor:
        follower, controls = SkinFollower(rig, part_of("skin")), WebcamControls(smoothing=smoothing)
        rows = [follower.followed(*given, 1 / fps, controls) for given in zip(pictures, states, strict=True)]
        return torch.stack(rows)

    torch.testing.assert_close(played(30, 0.0), played(10, 0.0))
    assert (played(30, 0.5) - played(10, 0.5)).abs().max() > 0.005


def test_what_covers_skin_says_nothing(rig: BlendshapeRig, filmed: Film) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    found = followed(SkinFollower(rig, part_of("hand")), pictures, states, 3)
    torch.testing.assert_close(found, torch.stack([state.weights for state in states]))


def test_a_quick_camera_is_looked_at_every_second_frame(
    rig: BlendshapeRig, filmed: Film, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, states = shown(filmed), solved(rig.names, LACKS * planted(rig.names), filmed.poses)
    looked, see = [], FlatFace.seen_in
    monkeypatch.setattr(FlatFace, "seen_in", lambda *given: looked.append(1) or see(*given))
    for fps, looks in ((30, FRAMES), (60, FRAMES // 2)):
        follower, before = SkinFollower(rig, part_of("skin")), len(looked)
        for given in zip(pictures, states, strict=True):
            follower.followed(*given, 1 / fps)
        assert len(looked) - before == looks


@pytest.mark.real
def test_real_skin_takes_back_weights_that_are_made_up(rig: BlendshapeRig, data: Path) -> None:
    clip = open_video(data / "video" / "single_face.mp4")
    count = 60
    marks = torch.from_numpy(np.load(data / "landmarks" / "mediapipe_68.npz")["single_face"])[:count].double()
    calibration = assumed_calibration(clip.width, clip.height)
    poses = measure_poses(rig.vertices[rig.neutral.landmarks].detach().double(), marks, calibration.intrinsics.double())
    pictures = [
        np.ascontiguousarray(frame.permute(1, 2, 0).numpy())
        for _, frame in zip(range(count), clip.color_frames(), strict=False)
    ]
    row = [rig.names.index(name) for name in ("browOuterUpLeft", "browOuterUpRight")]
    given = torch.zeros(2, count, len(rig.names))
    given[:, :, row] = 0.4
    wave = 0.3 * torch.linspace(0, 18.8, count).sin()
    given[1, :, row] += wave[:, None]
    changes = []
    for weights in given:
        states = solved(rig.names, weights, (poses.rotation, poses.translation))
        found = followed(SkinFollower(rig, part_of("skin")), pictures, states, 1)
        changes.append((found @ mapping(ARKIT, rig.names).T - weights)[:, row].mean(1))
    later = slice(count // 2, None)
    taken_back, wave = (changes[0] - changes[1])[later], wave[later]
    wave = wave - wave.mean()
    assert torch.corrcoef(torch.stack([taken_back, wave]))[0, 1] > 0.8
    assert 0.2 < taken_back @ wave / wave.square().sum() < 1.2
