"""What the stage films is what it says it filmed."""

from dataclasses import replace

import pytest
import torch

from torchface.io import load_take
from torchface.io.action_labels import load_action_labels
from torchface.io.video import open_video
from torchface.synthetic import performer
from train.filmed_performers.action_performance import ACTION_UNITS, MOVES
from train.filmed_performers.camera_stage import SIDE_MARKERS, RecordedSession, render_video, stage_markers
from train.filmed_performers.head_camera_images import HeadCameraRenderer
from train.filmed_performers.helmet_camera import HELMET_POINT, CameraFlaws, helmet_camera, shaken_cameras
from train.filmed_performers.reflective_paint import reflective_paint

STILL = CameraFlaws(noise=0.0, blur=0.0, shake_rotation=0.0, shake_translation=0.0)


@pytest.fixture(scope="module")
def session(filmed_session: RecordedSession) -> RecordedSession:
    return filmed_session


def test_video_markers_and_labels_lie_beside_each_other(session: RecordedSession) -> None:
    video, take, labels = open_video(session.video.path), load_take(session.take_path), session.labels
    assert (video.width, video.height, video.fps) == (128, 170, 20.0)
    assert video.count == len(take) == labels.frames == len(session.performance.weights)
    assert abs(take.fps - video.fps) < 1e-6
    assert set(SIDE_MARKERS) < set(take.markers.names)
    assert load_action_labels(session.labels_path).performed == session.performance.performed
    assert set(labels.units) == set(ACTION_UNITS)


def test_labels_say_where_things_are(session: RecordedSession) -> None:
    """The helmet's bolt has a dark middle in a bright rim; markers are the brightest; regions hold paint."""
    frame = session.video.frame(session.labels.neutral).float() / 255
    column, row = (round(v) for v in session.labels.helmet)
    assert frame[row, column] < 0.6 * frame[row - 3 : row + 4, column - 3 : column + 4].max()
    for x, y in session.labels.markers:
        around = frame[round(y) - 1 : round(y) + 2, round(x) - 1 : round(x) + 2]
        assert around.max() > 0.7
    for name, (left, top, right, bottom) in session.labels.regions.items():
        box = frame[round(top) : round(bottom), round(left) : round(right)]
        share = (box > 0.65).float().mean()
        assert 0.03 < share < 0.6, name


def test_intensities_are_what_moves_the_face(session: RecordedSession) -> None:
    performance = session.performance
    for a, unit in enumerate(ACTION_UNITS):
        alone = [s for s in performance.performed if s.units == (unit,)]
        assert len(alone) == 2
        rows = slice(alone[0].first, alone[0].last)
        curve = performance.intensities[rows, a]
        assert 0.8 < curve.max() <= 1.0
        assert performance.intensities[rows].sum(1).allclose(curve)
        for shape, weight in MOVES[unit].items():
            moved = performance.weights[rows, performance.names.index(shape)]
            assert torch.corrcoef(torch.stack([moved, curve]))[0, 1] > 0.95
            assert moved.max() > 0.5 * weight
    outside = torch.ones(len(performance.weights), dtype=torch.bool)
    for stretch in performance.performed:
        outside[stretch.first : stretch.last] = False
    assert performance.intensities[outside].abs().max() == 0
    assert performance.weights[outside].max() < 0.5  # the eyes wander


def test_the_paint_moves_with_the_skin() -> None:
    """Raised brows lift the strokes over them in the picture by as much as the skin's points rise."""
    rig = performer()
    camera = helmet_camera(192, 256)
    weights = torch.zeros(2, len(rig.names))
    for shape in MOVES["1+2"]:
        weights[1, rig.names.index(shape)] = 1.0
    generator = torch.Generator().manual_seed(0)
    rotation, translation = shaken_cameras(camera, 2, 60.0, STILL, generator)
    markers = stage_markers(rig, 20).select(SIDE_MARKERS)
    scene = HeadCameraRenderer(rig, reflective_paint(512), markers)
    pictures = list(render_video(scene, weights, camera, rotation, translation, STILL, generator))
    skin = rig(weights)
    stroke = ((rig.vertices - torch.tensor([14.0, 34.0, 90.0])).norm(dim=1)).argmin()
    pixels = camera.project(skin[:, stroke].double())
    rise = float(pixels[0, 1] - pixels[1, 1])
    column = slice(round(float(pixels[0, 0])) - 4, round(float(pixels[0, 0])) + 5)
    rows = torch.arange(35.0, 85.0)  # below the helmet's rim, above the lids

    def centre(picture: torch.Tensor) -> float:
        paint = (picture[35:85, column] - 0.6).clamp(min=0).sum(1)
        return float((paint * rows).sum() / paint.sum())

    assert rise > 5
    assert centre(pictures[0]) - centre(pictures[1]) == pytest.approx(rise, abs=2.0)


def test_a_loose_camera_moves_helmet_and_markers_alike() -> None:
    camera = helmet_camera()
    flaws = CameraFlaws(shake_rotation=0.5, shake_translation=1.0)
    rotation, translation = shaken_cameras(camera, 200, 60.0, flaws, torch.Generator().manual_seed(0))
    points = torch.tensor([HELMET_POINT, (60.0, -4.0, 44.0), (-60.0, -4.0, 44.0)], dtype=torch.float64)
    pixels = torch.stack([
        replace(camera, rotation=r, translation=t).project(points) for r, t in zip(rotation, translation, strict=True)
    ])  # fmt: skip
    motion = pixels - camera.project(points)
    assert 1.0 < motion.norm(dim=-1).max() < 8.0
    assert (motion - motion.mean(1, keepdim=True)).norm(dim=-1).max() < 0.5 * motion.norm(dim=-1).max()
    steps = (pixels[1:] - pixels[:-1]).norm(dim=-1)
    assert steps.max() < 1.0


def test_a_hand_that_is_not_steady_paints_a_little_off() -> None:
    steady = reflective_paint(256)
    other = reflective_paint(256, torch.Generator().manual_seed(0), 0.5)
    again = reflective_paint(256, torch.Generator().manual_seed(0), 0.5)
    assert torch.equal(other, again)
    assert 0.01 < steady.mean() < 0.1
    assert abs(float(other.mean() / steady.mean()) - 1) < 0.15
    assert 0.05 < (other - steady).abs().sum() / steady.sum() < 1.0
