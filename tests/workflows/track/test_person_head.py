"""Without a rig the head of whoever is seen is solved with the take, and the weights on it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.photographed_heads import aligned_error
from torchface import BlendshapeRig, Take, Track, load_rig, save_rig
from torchface.errors import TopologyError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.similarity import similarity_transform
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.synthetic import draw_identities, performer
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_video import track_video

COUNT, WIDTH, HEIGHT = 12, 640, 480
SHAPES = ["jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp"]


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    """Nobody's head that the zoo's model has learned from."""
    return performer(draw_identities(1, torch.Generator().manual_seed(9))[0], texture=False)


@pytest.fixture(scope="module")
def take(actor: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tensor]:
    """A table of the actor's landmarks as the head rotates and the face moves, and the weights."""
    phase = torch.linspace(0, 2 * torch.pi, COUNT)
    weights = torch.zeros(COUNT, len(actor.names))
    weights[:, actor.names.index("jawOpen")] = 0.3 - 0.3 * (2 * phase).cos()
    weights[:, actor.index(SHAPES[1:3])] = (0.35 - 0.35 * phase.cos())[:, None]
    weights[:, actor.names.index("browInnerUp")] = 0.3 + 0.3 * (phase + 1).sin()
    marks, intrinsics = actor.neutral.landmarks, assumed_calibration(WIDTH, HEIGHT).intrinsics
    pixels = []
    for row, yaw in zip(weights, 35 * phase.sin(), strict=True):
        points = actor(row[None])[0, marks].double()
        camera = look_at(points.mean(0), float(yaw), 0.0, 600.0, WIDTH, HEIGHT)
        seen = points @ camera.rotation.T + camera.translation
        pixels.append(seen[:, :2] / seen[:, 2:] * intrinsics.diagonal()[:2] + intrinsics[:2, 2])
    folder = tmp_path_factory.mktemp("take")
    names = tuple(str(i) for i in range(68))
    save_landmarks_csv(Take(25.0, landmarks=Track(names, torch.stack(pixels).float())), folder / "take.csv")
    return folder / "take.csv", weights


def test_the_head_is_solved_with_the_take(actor: BlendshapeRig, take: tuple[Path, Tensor], tmp_path: Path) -> None:
    table, weights = take
    settings = TrackSettings(landmarks=table, size=(WIDTH, HEIGHT), heads="head")
    tracked = track_video(None, None, tmp_path / "out", settings)
    made, mean = load_rig(tmp_path / "out" / "head.glb"), performer(texture=False)
    assert made.names == actor.names
    skin = actor.neutral.annotations.regions["face"]
    true = actor.vertices[skin]
    assert aligned_error(made.vertices[skin], true) < 0.6 * aligned_error(mean.vertices[skin], true)
    ahead = similarity_transform(*(one.vertices[mean.neutral.landmarks][None].double() for one in (made, mean)))
    assert float(ahead.rotation[0].diagonal().sum()) > 3 - 1e-6  # it stands as the mean head, else gaze is off
    for camera, posed, seen in zip(
        tracked.head.fit.cameras, tracked.head.fit.posed, tracked.head.fit.landmarks, strict=True
    ):
        inner = posed.vertices[mean.neutral.landmarks[36:48]].double()
        assert float((camera.project(inner) - seen[36:48]).norm(dim=1).max()) < 3  # pixels: cameras went along
    assert tracked.products["head"] == tmp_path / "out" / "head.glb"
    animation = (tmp_path / "out" / "animation.glb").read_bytes()
    assert re.search(rb'"path": ?"rotation"', animation)  # the head turns
    assert any(line.startswith("head: solved from") for line in tracked.lines())
    save_rig(mean, tmp_path / "mean.glb")
    strangers = track_video(None, tmp_path / "mean.glb", tmp_path / "strangers", settings)
    columns = actor.index(SHAPES)
    ours, theirs = (
        float((one.solution.weights - weights)[:, columns].square().mean().sqrt()) for one in (tracked, strangers)
    )
    assert ours < theirs
    assert "head" not in strangers.products
    # Another take goes on with both files.
    known = replace(settings, offsets=tmp_path / "out" / "landmark_offsets.json")
    other = track_video(None, tmp_path / "out" / "head.glb", tmp_path / "other", known)
    assert torch.equal(other.offsets.millimetres, tracked.offsets.millimetres)


def test_a_rig_of_another_topology_is_refused(
    dome_rig: BlendshapeRig, take: tuple[Path, Tensor], tmp_path: Path
) -> None:
    save_rig(dome_rig, tmp_path / "dome.glb")
    settings = TrackSettings(landmarks=take[0], size=(WIDTH, HEIGHT), anybody=True, heads="head")
    with pytest.raises(TopologyError, match="expected the model's 6419"):
        track_video(None, tmp_path / "dome.glb", tmp_path / "out", settings)
