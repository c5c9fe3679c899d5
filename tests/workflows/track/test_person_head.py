"""Without a rig the head of whoever is seen is solved with the take, and the weights on it."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from planted.photographed_heads import aligned_error, bent, to_surface
from torchface import BlendshapeRig, Take, Track, load_rig, load_take, save_rig
from torchface.errors import TopologyError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.similarity import similarity_transform
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.io.video import write_video
from torchface.landmarks import FaceReading
from torchface.progress import silent
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import character, draw_identities, performer
from torchface.workflows.track import person_head as module
from torchface.workflows.track.person_head import HeadFrames, person_head
from torchface.workflows.track.track_inputs import TrackSettings, load_inputs
from torchface.workflows.track.track_result import Tracked
from torchface.workflows.track.track_video import track_video

COUNT, WIDTH, HEIGHT, SIDE = 12, 640, 480, 360
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


@pytest.fixture(scope="module")
def settings(take: tuple[Path, Tensor]) -> TrackSettings:
    return TrackSettings(landmarks=take[0], size=(WIDTH, HEIGHT), heads="head")


@pytest.fixture(scope="module")
def solved(settings: TrackSettings, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tracked]:
    """A folder and what was written into it."""
    out = tmp_path_factory.mktemp("solved") / "out"
    return out, track_video(None, None, out, settings)


def test_the_head_is_solved_with_the_take(
    actor: BlendshapeRig, settings: TrackSettings, solved: tuple[Path, Tracked], tmp_path: Path
) -> None:
    out, tracked = solved
    made, mean = load_rig(out / "head.glb"), performer(texture=False)
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
    assert tracked.products["head"] == out / "head.glb"
    animation = (out / "animation.glb").read_bytes()
    assert re.search(rb'"path": ?"rotation"', animation)  # the head turns
    assert any(line.startswith("head: solved from") for line in tracked.lines())
    # Another take goes on with both files.
    known = replace(settings, offsets=out / "landmark_offsets.json")
    other = track_video(None, out / "head.glb", tmp_path / "other", known)
    assert torch.equal(other.offsets.millimetres, tracked.offsets.millimetres)
    assert "head" not in other.products


@pytest.mark.bench  # the take is solved again
def test_the_weights_on_the_solved_head_are_nearer_than_those_on_the_mean_head(
    actor: BlendshapeRig,
    take: tuple[Path, Tensor],
    settings: TrackSettings,
    solved: tuple[Path, Tracked],
    tmp_path: Path,
) -> None:
    save_rig(performer(texture=False), tmp_path / "mean.glb")
    strangers = track_video(None, tmp_path / "mean.glb", tmp_path / "strangers", settings)
    columns = actor.index(SHAPES)
    ours, theirs = (
        float((one.solution.weights - take[1])[:, columns].square().mean().sqrt()) for one in (solved[1], strangers)
    )
    assert ours < theirs
    assert "head" not in strangers.products


def test_a_rig_of_another_topology_is_refused(
    dome_rig: BlendshapeRig, take: tuple[Path, Tensor], tmp_path: Path
) -> None:
    save_rig(dome_rig, tmp_path / "dome.glb")
    settings = TrackSettings(landmarks=take[0], size=(WIDTH, HEIGHT), anybody=True, heads="head")
    with pytest.raises(TopologyError, match="expected the model's 6419"):
        track_video(None, tmp_path / "dome.glb", tmp_path / "out", settings)


def test_the_head_is_fitted_to_pictures_of_the_frames_that_differ(
    take: tuple[Path, Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the skin in several pictures does to a fit is tried in test_multiple_views.py."""
    colors = 255 * torch.rand(COUNT, 3, 6, 8, generator=torch.Generator().manual_seed(0))
    film = interpolate(colors, size=(HEIGHT, WIDTH), mode="bilinear").to(torch.uint8)
    write_video([film], tmp_path / "film.mkv", 25.0)
    inputs = load_inputs(tmp_path / "film.mkv", None, TrackSettings(landmarks=take[0], heads="head"))
    marks, sure = load_take(take[0]).landmarks.values.double(), torch.ones(COUNT, 68)
    reading = FaceReading(marks, sure, sure, sure[:, 0])
    filmed = HeadFrames.of(inputs, marks, reading)
    fitted: list[tuple[Any, ...]] = []
    monkeypatch.setattr(module, "fit_images", lambda *given, **_: fitted.append(given) or SimpleNamespace(mesh=None))
    monkeypatch.setattr(module, "transfer_with_report", lambda rig, *_, **__: SimpleNamespace(rig=rig))
    for some in (HeadFrames(filmed.numbers), filmed):
        person_head(inputs, inputs.heads, some, marks, reading, silent)
    (*_, without), (*_, pictures) = fitted
    assert without is None
    assert 2 < len(pictures) < COUNT
    for number, picture in zip(filmed.numbers.tolist(), pictures, strict=True):
        assert float((picture - film[number] / 255).abs().mean()) < 0.01


@pytest.mark.bench  # ten seconds
def test_the_skin_that_frames_show_moves_the_head(tmp_path: Path) -> None:
    """Of a face whose form the model does not know."""
    known = character(performer(draw_identities(1, torch.Generator().manual_seed(21))[0]), size=512).rig.neutral
    true = known.with_vertices(known.vertices + bent(known).float())
    focal = float(assumed_calibration(SIDE, SIDE).intrinsics[0, 0])
    middle, field = true.vertices[true.landmarks[27:]].double().mean(0), math.degrees(2 * math.atan(SIDE / 2 / focal))
    cameras = [look_at(middle, yaw, 3.0, 280.0, SIDE, SIDE, field) for yaw in (-24.0, 0.0, 24.0)]
    frames = [render(true, camera, lighting=Lighting(occlusion_rays=0))[:3] for camera in cameras]
    write_video([frame[None] for frame in frames], tmp_path / "film.mkv", 25.0)
    marks = torch.stack([camera.project(true.vertices[true.landmarks].double()) for camera in cameras])
    names = tuple(str(i) for i in range(68))
    save_landmarks_csv(Take(25.0, landmarks=Track(names, marks.float())), tmp_path / "take.csv")
    inputs = load_inputs(tmp_path / "film.mkv", None, TrackSettings(landmarks=tmp_path / "take.csv", heads="head"))
    reading = FaceReading(marks, torch.ones(3, 68), torch.ones(3, 68), torch.ones(3))
    filmed = HeadFrames.of(inputs, marks, reading)
    assert filmed.numbers.tolist() == [0, 1, 2]
    for picture, frame in zip(filmed.pictures, frames, strict=True):
        assert float((picture / 255 - frame).abs().mean()) < 0.01
    heads = [
        person_head(inputs, inputs.heads, some, marks, reading, silent).fit
        for some in (HeadFrames(filmed.numbers), filmed)
    ]
    assert [one.agreement is None for one in heads] == [True, False]
    before, after = (
        to_surface(one.vertices[bent(one).norm(dim=1) > 0.5].double(), true) for one in (heads[0].mesh, heads[1].mesh)
    )
    assert after < 0.85 * before
