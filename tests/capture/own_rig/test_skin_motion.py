"""Skin that moves: weights by how the face, laid flat, differs from frame to frame."""

import errno
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from planted.skin_films import FRAMES, HEIGHT, MOVED, WIDTH, Film, film_of, part_of, planted
from torchface.capture.own_rig import skin_motion as module
from torchface.capture.own_rig.flat_face import FlatFace
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.own_rig.skin_motion import SkinMotion, skin_motion
from torchface.correctives.corrective_shapes import Corrective, Correctives
from torchface.errors import FileFormatError
from torchface.geometry.cameras.calibration import CameraCalibration, assumed_calibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.io.video import open_video
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer


class FullFile(BytesIO):
    """A file on a disk that holds 1000 bytes."""

    def write(self, values: Any) -> int:
        if self.tell() >= 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(values[:1000])


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer()


@pytest.fixture(scope="module")
def filmed(rig: BlendshapeRig) -> Film:
    return film_of(rig)


def test_skin_says_what_weights_lack(rig: BlendshapeRig, filmed: Film) -> None:
    truth, shown = planted(rig.names), torch.ones(FRAMES, dtype=torch.bool)
    given = 0.3 * truth
    found = skin_motion(rig, filmed.pictures, given, filmed.poses, shown, filmed.camera, part_of("skin"))
    assert found is not None
    for name in MOVED:
        row = rig.names.index(name)
        lacks = (truth - given)[:, row] - (truth - given)[:, row].mean()
        found_of = found.change[:, row]
        assert torch.corrcoef(torch.stack([lacks, found_of]))[0, 1] > 0.93
        assert 0.15 < found_of @ lacks / lacks.square().sum() < 1.1  # less than all: solutions are seldom so far off
    off, left = ((weights - truth).square().mean().sqrt() for weights in (given, found.applied(given)))
    assert left < 0.8 * off
    torch.testing.assert_close(found.change.mean(0), torch.zeros(len(rig.names)))
    blinks = [number for number, name in enumerate(rig.names) if name.startswith("eyeBlink")]
    assert not found.change[:, blinks].any()
    assert not torch.isfinite(found.deviation[blinks]).any()


def test_what_covers_skin_says_nothing(rig: BlendshapeRig, filmed: Film) -> None:
    shown = torch.ones(FRAMES, dtype=torch.bool)
    for part in ("glasses", "hand"):
        assert (
            skin_motion(rig, filmed.pictures, planted(rig.names), filmed.poses, shown, filmed.camera, part_of(part))
            is None
        )


def test_frames_without_a_face_change_nothing(rig: BlendshapeRig, filmed: Film) -> None:
    truth, shown = planted(rig.names), torch.arange(FRAMES) != 4
    pictures = [255 - picture if frame == 4 else picture for frame, picture in enumerate(filmed.pictures)]
    found = skin_motion(rig, pictures, truth, filmed.poses, shown, filmed.camera, part_of("skin"))
    assert found is not None
    assert not found.change[4].any()
    assert float(found.change.abs().max()) < 0.06  # weights that are right stay
    shown[:3] = False
    assert skin_motion(rig, pictures, truth, filmed.poses, shown, filmed.camera, part_of("skin")) is None


def test_skin_that_faces_the_camera_counts(rig: BlendshapeRig) -> None:
    face = FlatFace.of(rig, 1.5)
    there = face.counts[face.landmarks[:, 0], face.landmarks[:, 1]]
    assert there[27:36].all()  # the nose
    assert not there[[*range(36, 48), *range(60, 68)]].any()  # eyes and the mouth's inside
    middle = rig.vertices[rig.neutral.landmarks[17:]].detach().double().mean(0)
    for turn in (-50.0, 50.0):
        camera = look_at(middle, turn, 4.0, 260.0, WIDTH, HEIGHT)
        calibration = CameraCalibration(camera.intrinsics, torch.zeros(5).double(), WIDTH, HEIGHT)
        picture, pose = (
            torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8),
            (camera.rotation.float(), camera.translation.float()),
        )
        _, squarely, _ = face.seen_in(picture, torch.zeros(len(rig.names)), pose, calibration)
        sides = squarely[*face.landmarks[[3, 13]].T.numpy()]
        far, near = sorted(sides)
        assert far == 0
        assert near > 0.5


def test_places_beyond_the_picture_say_nothing(rig: BlendshapeRig, filmed: Film) -> None:
    """The picture's edge lies somewhere else on the face in each frame."""
    truth, shown = planted(rig.names), torch.ones(FRAMES, dtype=torch.bool)
    cut = [picture[:, :, :80].contiguous() for picture in filmed.pictures]
    found = skin_motion(rig, cut, truth, filmed.poses, shown, filmed.camera, part_of("skin"))
    assert found is not None
    assert float(found.change.abs().max()) < 0.045


def test_a_surface_that_correctives_move_is_the_rigs(rig: BlendshapeRig) -> None:
    both = torch.stack([rig.deltas[rig.names.index(name)] for name in MOVED[:2]]).sum(0)
    corrective = Correctives(-0.6 * both[None], (Corrective("brow", MOVED[:2]),))
    corrected = BlendshapeRig(rig.neutral, rig.deltas, rig.names, corrective)
    truth, film = planted(rig.names), film_of(corrected)
    changes = [
        skin_motion(one, film.pictures, truth, film.poses, torch.ones(FRAMES) > 0, film.camera, part_of("skin"))
        for one in (rig, corrected)
    ]
    without, right = (float(found.change.abs().mean()) for found in changes)
    assert right < 0.8 * without


def test_a_temporary_folder_that_is_full_is_said(
    rig: BlendshapeRig, filmed: Film, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = torch.ones(FRAMES, dtype=torch.bool)
    monkeypatch.setattr(module, "TemporaryFile", lambda **_: FullFile())
    with pytest.raises(FileFormatError, match=r"no space \(No space left on device\).* 12 frames, expected 0\.\d MB"):
        skin_motion(rig, filmed.pictures, planted(rig.names), filmed.poses, shown, filmed.camera, part_of("skin"))


def test_weights_rise_where_they_would_be_below_nothing() -> None:
    curve = 0.2 * torch.linspace(0, 12.6, 200).sin()
    change = torch.stack([curve, curve], 1)
    lifted = SkinMotion(change, torch.tensor([0.02, 0.5])).applied(torch.full((200, 2), 0.1))
    assert lifted.min() >= 0
    assert lifted.max() <= 1
    assert 0.15 < lifted[:, 0].mean() < 0.22  # 0.2 is the least that leaves the curve whole
    torch.testing.assert_close(lifted[:, 1], (0.1 + curve).clamp(min=0))  # noise, for all that is known


def test_a_face_at_rest_draws_weights_to_nothing() -> None:
    """A curve that dips in few frames leaves the others, at rest, nearer to 0 than they would be without."""
    curve = torch.where(torch.arange(200) % 50 < 5, -0.27, 0.03)[:, None]
    motion, weights = SkinMotion(curve, torch.tensor([0.02])), torch.full((200, 1), 0.1)
    free, rested = motion.applied(weights), motion.applied(weights, (curve[:, 0] > 0).float())
    assert rested[10, 0] < free[10, 0] - 0.02
    assert rested[10, 0] > 0.13  # where the dips, too, count


@pytest.mark.real
def test_real_skin_takes_back_weights_that_are_made_up(rig: BlendshapeRig, data: Path) -> None:
    clip = open_video(data / "video" / "single_face.mp4")
    count = 24
    marks = torch.from_numpy(np.load(data / "landmarks" / "mediapipe_68.npz")["single_face"])[:count].double()
    calibration = assumed_calibration(clip.width, clip.height)
    rest = rig.vertices[rig.neutral.landmarks].detach().double()
    poses = measure_poses(rest, marks, calibration.intrinsics.double())
    pictures = [frame for _, frame in zip(range(count), clip.color_frames(), strict=False)]
    row = [rig.names.index(name) for name in ("browOuterUpLeft", "browOuterUpRight")]
    given = torch.full((2, count, len(rig.names)), 0.0)
    given[:, :, row] = 0.4
    wave = 0.3 * torch.linspace(0, 9.4, count).sin()
    given[1, :, row] += wave[:, None]
    changes = [
        skin_motion(
            rig, pictures, weights, (poses.rotation, poses.translation), poses.found, calibration, part_of("skin")
        )
        for weights in given
    ]
    taken_back = (changes[0].change - changes[1].change)[:, row].mean(1)
    wave = wave - wave.mean()
    assert torch.corrcoef(torch.stack([taken_back, wave]))[0, 1] > 0.9
    assert 0.3 < taken_back @ wave / wave.square().sum() < 1.2
