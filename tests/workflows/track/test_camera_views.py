"""Films of one take by two cameras: brought together and solved in one; what does not fit is refused."""

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import pytest
import torch
from torch import Tensor

from planted.light_stage import LightStageSettings, render_lit_video
from torchface import BlendshapeRig, load_rig, load_take, save_rig
from torchface.cli import main
from torchface.errors import FileFormatError, TorchfaceError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration, PlacedCamera
from torchface.geometry.rotations import rotation_matrix
from torchface.io.camera_files import load_cameras, save_calibration, save_cameras
from torchface.io.video import open_video, write_video
from torchface.landmarks import FaceReading
from torchface.rendering.point_light import PointLight
from torchface.synthetic import performer
from torchface.workflows.track import camera_views, track_video
from torchface.workflows.track.track_inputs import TrackInputs, TrackSettings, load_inputs
from torchface.workflows.track.track_state import TrackState

NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "mouthLeft", "mouthPucker")
K = torch.tensor([[300.0, 0, 79.5], [0, 300.0, 59.5], [0, 0, 1]], dtype=torch.float64)
ONE = CameraCalibration(K, torch.zeros(5, dtype=torch.float64), 160, 120, 0.1)
TURN = rotation_matrix(torch.tensor([[0.0, 0.6, 0.0]], dtype=torch.float64))[0]
PLACE = -TURN @ torch.tensor([280.0, 0.0, 70.0], dtype=torch.float64)
FILMS = {"left": (30.0, 12, 0.0), "right": (25.0, 9, 0.06)}  # rate, frames, when it begins


def cameras(offset: float | None, calibration: CameraCalibration = ONE) -> list[PlacedCamera]:
    first = PlacedCamera(ONE, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), "left")
    return [first, PlacedCamera(calibration, TURN, PLACE, "right", offset)]


def performed(seconds: Tensor) -> Tensor:
    return 0.4 + 0.3 * torch.sin(5 * seconds[:, None] + torch.arange(len(NAMES)))


def seen(rig: BlendshapeRig, which: str) -> Tensor:
    """Landmarks of all frames of a film, (T,68,2)."""
    rate, frames, begin = FILMS[which]
    seconds = begin + torch.arange(frames, dtype=torch.float64) / rate
    marks = rig(performed(seconds).float())[:, rig.neutral.landmarks].double()
    placed = marks * torch.tensor([1.0, -1, -1]) + torch.tensor([5.0, -4.0, 420.0])
    placed = placed if which == "left" else placed @ TURN.T + PLACE
    return ((placed @ K.T)[..., :2] / (placed @ K.T)[..., 2:]).float()


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two films of nothing, a rig, and where the cameras lie."""
    folder = tmp_path_factory.mktemp("films")
    for name, (rate, frames, _) in FILMS.items():
        write_video([torch.full((frames, 120, 160), 0.4)], folder / f"{name}.avi", rate)
    save_rig(performer(texture=False).select(NAMES), folder / "rig.glb")
    save_cameras(cameras(0.06), folder / "cameras.toml")
    return folder


@pytest.fixture
def planted(films: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Tensor]:
    """What the films show to whoever reads them, by name; a test may change it."""
    rig = load_rig(films / "rig.glb")
    marks = {name: seen(rig, name) for name in FILMS}

    def read(inputs: TrackInputs, *rest: object) -> tuple[FaceReading, int]:
        found = marks[inputs.clip.path.stem]
        sure = torch.isfinite(found).all(2).float()
        return FaceReading.of_confidence(found, sure, sure, sure.amax(1), torch.tensor([40.0, 20, 80, 80])), 1

    for module in (camera_views, track_video):
        monkeypatch.setattr(module, "read_frames", read)
    monkeypatch.setattr(TrackState, "looks", lambda state: torch.zeros(0))
    return marks


def of(folder: Path, ending: str = "avi") -> TrackSettings:
    settings = TrackSettings(prior="none", overlay="none", one_person=True, whole_take=True)
    return replace(settings, beside=(folder / f"right.{ending}",), cameras=folder / "cameras.toml")


def track(films: Path, out: Path) -> Tensor:
    done = track_video.track_video(films / "left.avi", films / "rig.glb", out, of(films))
    assert "camera right: right.avi, 289 mm from the first, its film begins +0.060 s" in "\n".join(done.lines())
    return done.solution.weights.double()


@pytest.fixture(scope="module")
def ready(films: Path) -> TrackInputs:
    return load_inputs(films / "left.avi", films / "rig.glb", of(films))


def test_a_second_camera_shows_what_the_first_does_not_see(
    films: Path, planted: dict[str, Tensor], tmp_path: Path
) -> None:
    """The left camera sees no mouth, and no face in three frames; the right one, of another rate, begins later."""
    planted["left"][:, 48:] = torch.nan
    planted["left"][4:7] = torch.nan
    rate, frames, _ = FILMS["left"]
    truth = performed(torch.arange(frames) / rate)
    both = (track(films, tmp_path / "both") - truth).abs()
    planted["right"][1:] = torch.nan
    with pytest.warns(UserWarning, match=r"right\.avi: the face was found in 1 of its 9 frames: this camera"):
        one = (track(films, tmp_path / "one") - truth).abs()
    assert float(both[2:].mean()) < 0.12 < 0.3 < float(one[2:].mean())  # the right one sees from frame 2 on
    assert float(both[4:7].mean()) < 0.12


def test_where_cameras_lie_otherwise_the_result_asks_for_their_file(
    films: Path, planted: dict[str, Tensor], tmp_path: Path
) -> None:
    """OpenCV's place, taken the other way round."""
    right = replace(cameras(0.06)[1], rotation=TURN.T.contiguous(), translation=-TURN.T @ PLACE)
    save_cameras([cameras(None)[0], right], tmp_path / "turned.toml")
    settings = replace(of(films), cameras=tmp_path / "turned.toml")
    done = track_video.track_video(films / "left.avi", films / "rig.glb", tmp_path / "out", settings)
    assert done.verdict().startswith("result: poor")
    assert "do the cameras lie as turned.toml says" in done.verdict()


def test_the_command_line_takes_a_film_of_each_camera(
    films: Path, planted: dict[str, Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first film shows no mouth: without the second one its shapes would be unknown."""
    planted["left"][:, 48:] = torch.nan
    words = ["--video", films / "left.avi", "--video", films / "right.avi", "--cameras", films / "cameras.toml"]
    words += ["--rig", films / "rig.glb", "--out", tmp_path / "out", "--prior", "none", "--overlay", "none"]
    main(["track", *map(str, words), "--one-person", "--whole-take"])
    assert "camera right: right.avi, 289 mm from the first" in " ".join(capsys.readouterr().err.split())
    take = load_take(tmp_path / "out" / "weights.csv")
    assert take.weights is not None
    rate, frames, _ = FILMS["left"]
    found = take.weights.select(NAMES).values[2:, :, 0]
    assert float((found - performed(torch.arange(frames) / rate)[2:]).abs().mean()) < 0.12


@pytest.mark.parametrize("begins", [("10:00:00:00", "10:00:01:15"), ("23:59:59:15", "00:00:01:00")])
def test_films_are_brought_together_by_timecodes(begins: tuple[str, str], ready: TrackInputs, tmp_path: Path) -> None:
    for name, begin in zip(("left", "right"), begins, strict=True):
        with av.open(str(tmp_path / f"{name}.mov"), "w") as container:
            stream = container.add_stream("mpeg4", rate=Fraction(30))
            stream.width, stream.height, stream.metadata["timecode"] = 160, 120, begin
            for _ in range(60):
                frame = av.VideoFrame(160, 120, "yuv420p")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    save_cameras(cameras(None), tmp_path / "cameras.toml")
    first, others = camera_views.other_cameras(
        replace(ready, clip=open_video(tmp_path / "left.mov"), settings=of(tmp_path, "mov"))
    )
    assert others[0].begin == pytest.approx(1.5)
    assert float(first.calibration.intrinsics[0, 0]) == 300.0


def test_what_does_not_fit_is_refused(films: Path, ready: TrackInputs, tmp_path: Path) -> None:
    def refused(text: str, error: type[TorchfaceError] = ValueRangeError, **changes: Any) -> None:
        with pytest.raises(error, match=text):
            camera_views.other_cameras(replace(ready, settings=replace(ready.settings, **changes)))

    save_cameras(cameras(60.0), tmp_path / "late.toml")
    refused("no common frame: it begins 60.00 s after left.avi", cameras=tmp_path / "late.toml")
    save_cameras(cameras(0.0, replace(ONE, width=200)), tmp_path / "wide.toml")
    refused("right, right.avi: calibration: made for 200 x 120", cameras=tmp_path / "wide.toml")
    refused(r"found 2 cameras \(left, right\) and 1 films", beside=())
    refused("several films of one take, expected --cameras", cameras=None)
    refused("with --camera, expected films", camera=tmp_path / "own.toml")
    refused("none.toml", FileFormatError, cameras=tmp_path / "none.toml")
    (tmp_path / "turned.toml").write_text((films / "cameras.toml").read_text().replace("0.825", "0.9"))
    refused("expected a rotation matrix", FileFormatError, cameras=tmp_path / "turned.toml")
    assert load_cameras(films / "cameras.toml")[1].offset == 0.06


@pytest.mark.bench
def test_two_rendered_films_show_more_than_one(tmp_path: Path) -> None:
    """A performer rendered from the front and from 25 degrees aside, read by the zoo's network."""
    actor = performer(texture=True)
    weights = torch.zeros(16, len(actor.names))
    ramp = torch.linspace(0, 1, 16)
    for name, size in {"jawOpen": 0.7, "mouthPucker": 0.8, "mouthSmileLeft": 0.7, "mouthSmileRight": 0.7}.items():
        weights[:, actor.names.index(name)] = size * (ramp if name == "jawOpen" else (math.pi * ramp).sin())
    light = PointLight(torch.full((3,), 0.35), torch.full((3,), 0.7), torch.tensor([-500.0, -700.0, 100.0]))
    settings = LightStageSettings(width=320, height=240, samples=1, turn=0.0)
    turn = rotation_matrix(torch.tensor([[0.0, math.radians(25), 0.0]]))[0]
    turned = BlendshapeRig(actor.neutral.with_vertices(actor.vertices @ turn.T), actor.deltas @ turn.T, actor.names)
    seen = []
    for name, rig in (("left", actor), ("right", turned)):
        generator = torch.Generator().manual_seed(0)
        film = render_lit_video(tmp_path / f"{name}.avi", rig, weights, light, 30.0, generator, settings)
        seen.append(film.cameras[0])
    save_rig(actor, tmp_path / "rig.glb")
    (R, t), (R2, t2) = ((one.rotation.double(), one.translation.double()) for one in seen)
    beside = R2 @ turn.double() @ R.T
    own = CameraCalibration(seen[0].intrinsics.double(), torch.zeros(5).double(), 320, 240, 0.1)
    nowhere = torch.eye(3).double(), torch.zeros(3).double()
    placed = [PlacedCamera(own, *nowhere, "left"), PlacedCamera(own, beside, t2 - beside @ t, "right", 0.0)]
    save_cameras(placed, tmp_path / "cameras.toml")
    two = TrackSettings(overlay="none", beside=(tmp_path / "right.avi",), cameras=tmp_path / "cameras.toml")
    (tmp_path / "one").mkdir()
    save_calibration(own, tmp_path / "left.toml")
    off = {}
    for name, chosen in (("two", two), ("one", TrackSettings(overlay="none", camera=tmp_path / "left.toml"))):
        done = track_video.track_video(tmp_path / "left.avi", tmp_path / "rig.glb", tmp_path / name, chosen)
        found = actor(done.solution.weights) - actor(weights)
        off[name] = float(found.norm(dim=2)[:, actor.neutral.landmarks].mean())
        print(name, off[name], "mm;", float((done.solution.translation - t).abs().mean(0)[2]), "mm in depth")
    assert off["two"] < off["one"]
