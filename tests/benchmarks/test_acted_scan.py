"""Claim: where real skin acts a real take, `track` is nearer to the truth than MediaPipe, and the skin helps its brows.

The real scan as a rig of ICT-FaceKit's topology, 75 frames each of three takes in 640 x 480 pixels, the head turning by
25 degrees, noise and H.264; and 120 frames each of three others, smaller, turning less, in dim light from one side.
Eyes look ahead, so gaze is not counted. Heads are measured as in `test_photographed_scan`.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pytest
import torch
import trimesh
from expression_methods import Clip, live, mediapipe
from test_photographed_scan import face_error, upright
from torch import Tensor

from torchface import load_rig, load_take, zoo
from torchface.capture.anybody.skin_follower import SkinFollower
from torchface.geometry.cameras.pinhole import look_at
from torchface.modeling.photographs import multiple_views
from torchface.rendering.clay_shading import render
from torchface.shape_names import ARKIT, mapping
from torchface.viz.figures.region_colors import as_seen
from torchface.workflows.rig.actor_rig import rig_actor
from torchface.workflows.track import track_video
from torchface.workflows.track.track_inputs import TrackSettings
from train.morphable import ict_head_model

pytestmark = pytest.mark.real

WIDTH, HEIGHT, FOCAL, FPS = 640, 480, 576.0, 30
SHOWN = [number for number, name in enumerate(ARKIT) if "Look" not in name]
BROWS = [number for number, name in enumerate(ARKIT) if name.startswith("brow")]
FOLLOWED = track_video.followed_weights
_MOVES = 0.03  # deviation of a weight from which its correlation counts


@dataclass(frozen=True)
class Act:
    """How a take is acted and filmed."""

    number: int  # of the take
    first: float  # second of it
    frames: int = 75
    face: float = 165.0  # pixels
    turn: float = 25.0  # degrees
    compression: str = "20"  # constant rate factor of H.264
    darkest: float = 1.0  # of the light, at the picture's left edge


def dim(number: int, first: float) -> Act:
    return Act(number, first, 120, 130.0, 15.0, "26", 0.45)


ACTS = (Act(2, 21.6), Act(0, 23.0), Act(1, 7.76), dim(3, 10.76), dim(4, 6.26), dim(5, 4.76))


def acted(data: Path, ict: Path, out: Path, act: Act) -> Tensor:
    """Writes the film; gives its true weights (T,52)."""
    james = data / "scans" / "james"
    rig_actor(james / "james.obj", ict, out / "james.glb", james / "james.ljson")
    rig, take = load_rig(out / "james.glb"), load_take(sorted((data / "performances").glob("*.csv"))[act.number])
    rows = [round((act.first + frame / FPS) * take.fps) for frame in range(act.frames)]
    given = take.weights.values[rows, :, 0].float()
    weights = given @ mapping(take.weights.names, rig.names).T
    middle = rig.vertices[rig.neutral.landmarks[17:]].double().mean(0)
    field, high = math.degrees(2 * math.atan(HEIGHT / 2 / FOCAL)), 150.0 * HEIGHT / act.face
    random, across = np.random.default_rng(0), np.linspace(0, 1, WIDTH) ** 1.2
    light = (act.darkest + (1 - act.darkest) * across)[:, None]
    with av.open(str(out / "film.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=FPS, options={"crf": act.compression})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame, row in enumerate(weights):
            phase = 2 * math.pi * frame / act.frames
            camera = look_at(
                middle, act.turn * math.sin(phase), 3 + 5 * math.sin(2 * phase + 0.5), high, WIDTH, HEIGHT, field
            )
            head = as_seen(rig.neutral.with_vertices(rig(row[None])[0]))
            picture = 255 * render(head, camera)[:3].permute(1, 2, 0).numpy()
            noisy = np.clip(light * (picture + random.normal(0, 2.5, picture.shape)), 0, 255).astype(np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(noisy, format="rgb24")))
        file.mux(stream.encode())
    return given @ mapping(take.weights.names, ARKIT).T


def figures(weights: Tensor, truth: Tensor) -> list[float]:
    """Error, and the median correlation of what moves: of all, of brows."""

    def typical(columns: list[int]) -> float:
        moving = [k for k in columns if float(truth[:, k].std()) > _MOVES]
        each = [torch.corrcoef(torch.stack([weights[:, k], truth[:, k]]))[0, 1].nan_to_num(0.0) for k in moving]
        return float(torch.stack(each).median()) if each else math.nan

    return [float((weights - truth)[:, SHOWN].square().mean().sqrt()), typical(SHOWN), typical(BROWS)]


@pytest.mark.parametrize("act", ACTS)
def test_a_scan_that_acts(
    data: Path, ict_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Act
) -> None:
    torch.set_num_threads(1)
    truth = acted(data, ict_folder, tmp_path, act)
    film, rows = tmp_path / "film.mp4", {}
    with monkeypatch.context() as unfollowed:
        unfollowed.setattr(SkinFollower, "followed", lambda _, picture, state, *__: state.weights)
        rows["live, landmarks alone"] = figures(live(Clip(film))[0], truth)
    for name, method in {"live": live, "MediaPipe": mediapipe(data / "peers" / "face_landmarker.task")}.items():
        rows[name] = figures(method(Clip(film))[0].nan_to_num(0.0).float(), truth)
    mesh, places = upright(data)
    scan, heads = trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False), {}
    card = zoo.ModelCard("MIT", data="ICT-FaceKit", metrics={}, recipe="ict_head_model")
    zoo.save_model(ict_head_model(ict_folder), tmp_path / "people", card)
    for name, most in {"track, landmarks alone": 0.0, "track": multiple_views._MOST_OFF}.items():
        monkeypatch.setattr(multiple_views, "_MOST_OFF", most)
        monkeypatch.setattr(
            track_video, "followed_weights", FOLLOWED if most else lambda _, solved, *__: solved.weights
        )
        tracked = track_video.track_video(
            film, None, tmp_path / name, TrackSettings(overlay="none", heads=tmp_path / "people")
        )
        solved = load_take(tmp_path / name / "live_link.csv").weights
        rows[name] = figures(solved.values[..., 0].float() @ mapping(solved.names, ARKIT).T, truth)
        assert tracked.head is not None
        heads[name] = face_error(tracked.head.fit.mesh, scan, places).tolist()
    rows["nothing moves"] = figures(torch.zeros_like(truth), truth)
    print(f"\n{'':26s}{'error':>8s}{'r':>8s}{'brows':>8s}{'head: mean, median, mm':>26s}")
    for name, row in rows.items():
        print(f"{name:26s}" + "".join(f"{value:8.3f}" for value in row + heads.get(name, [])))
    assert rows["track"][0] < rows["track, landmarks alone"][0]
    assert rows["track"][1] > rows["track, landmarks alone"][1] + (0.05 if act.darkest == 1 else 0.0)
    assert rows["track"][0] < 0.9 * rows["MediaPipe"][0]
    assert rows["track"][2] > (0.8 if act.darkest == 1 else 0.5)  # brows
    assert rows["live"][1] > rows["live, landmarks alone"][1] - 0.05
    assert rows["live"][0] < 0.95 * rows["MediaPipe"][0]
