"""A filmed performer comes back as weights; what cannot be tracked is told."""

import json
import shlex
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.io.video.test_film_sound import EVEN, film
from tests.workflows.track.conftest import FRAMES, QUICK, Done, Filmed
from torchface import BlendshapeRig, load_rig, load_take, save_rig
from torchface.errors import FileFormatError, ValueRangeError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.distortion import undistort_image
from torchface.geometry.rotations import rotation_matrix
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.video import VideoFile, open_video, write_video
from torchface.shape_names import ARKIT
from torchface.synthetic.head.performer import performer
from torchface.workflows.head_rotations import head_angles
from torchface.workflows.track.overlay_video import head_window, mesh_drawer
from torchface.workflows.track.take_solution import known_offsets
from torchface.workflows.track.track_inputs import TrackInputs, TrackSettings
from torchface.workflows.track.track_models import TrackModels
from torchface.workflows.track.track_page import write_track_page
from torchface.workflows.track.track_video import track_video


def test_a_filmed_performer_comes_back(done: Done, filmed: Filmed) -> None:
    tracked = done.tracked
    assert tracked.seen.all()
    off = (tracked.reading.landmarks - filmed.landmarks).norm(dim=2)[:, 17:]
    assert float(off.mean()) < 0.05 * float((filmed.landmarks[0, 36] - filmed.landmarks[0, 45]).norm())
    turned = tracked.solution.rotation.double() @ filmed.rotation.transpose(1, 2)
    angle = torch.rad2deg((((turned.diagonal(dim1=1, dim2=2).sum(1)) - 1) / 2).clamp(-1, 1).acos())
    assert float(angle.mean()) < 7  # landmarks of so small a face are off by 4 % of the distance of the eyes
    marks = filmed.actor.neutral.landmarks
    true = filmed.actor(filmed.weights)[:, marks]
    still = (true - filmed.actor.vertices[marks]).norm(dim=2).mean()
    error = (filmed.actor(tracked.solution.weights)[:, marks] - true).norm(dim=2).mean()
    assert float(error) < 0.6 * float(still)
    jaw = filmed.actor.names.index("jawOpen")
    assert float(torch.corrcoef(torch.stack([tracked.solution.weights[:, jaw], filmed.weights[:, jaw]]))[0, 1]) > 0.9


def test_every_file_tells_the_same(done: Done) -> None:
    tracked, out = done.tracked, done.out
    own = load_take(out / "weights.csv")
    assert own.fps == 30.0
    torch.testing.assert_close(own.weights.values[..., 0], tracked.solution.weights.float())
    played = read_gltf_weights(out / "animation.glb")
    torch.testing.assert_close(played.weights.values, own.weights.values)
    unreal = load_take(out / "live_link.csv")
    assert {name.lower() for name in unreal.weights.names} == {name.lower() for name in ARKIT}
    angles = head_angles(tracked.solution.rotation.double())
    for i, name in enumerate(("HeadYaw", "HeadPitch", "HeadRoll")):
        torch.testing.assert_close(unreal.extras["columns"][name], angles[:, i], atol=1e-6, rtol=0)
    marks = load_take(out / "landmarks.csv")
    torch.testing.assert_close(marks.landmarks.values, tracked.reading.landmarks)
    depth = marks.extras["columns"]["pose_Tz"]
    torch.testing.assert_close(depth, tracked.solution.translation[:, 2].double(), atol=1e-3, rtol=0)
    drawn = open_video(out / "overlay.mp4")
    assert drawn.height == 480
    assert drawn.width == 2 * head_window(tracked).width
    assert len(list(drawn.frames())) == FRAMES
    told = json.loads((out / "summary.json").read_text())
    assert told["found"] == FRAMES
    assert told["camera_assumed"] is False
    assert told["intrinsics"][0][0] == told["focal_px"]
    assert len(told["distortion"]) == 5
    assert not list(out.rglob("*.part*"))


def test_the_report_shows_frames_and_curves(done: Done, tmp_path: Path) -> None:
    page = write_track_page(done.tracked, tmp_path).read_text()
    for picture in ("frames.png", "landmarks.png", "error.png", "pose.png", "weights1.png"):
        assert picture in page
        assert (tmp_path / picture).is_file()
    assert "from camera.toml, 0.10 px off when it was made" in page
    assert "frames with a face" in page
    assert '<video src="overlay.mp4"' in page
    assert "landmark_network" in page


def test_the_mesh_and_the_landmarks_are_drawn_where_they_are(done: Done, filmed: Filmed) -> None:
    tracked = done.tracked
    frame = next(open_video(filmed.video).color_frames())
    x, y = tracked.reading.landmarks[0, [30, 8]].round().long().T.tolist()
    drawn = mesh_drawer(tracked)(0, frame)
    assert drawn[1, y[0], x[0]] > 180  # a green dot
    cheek = (y[0] + y[1]) // 2, (x[0] + x[1]) // 2
    assert not torch.equal(drawn[:, cheek[0], cheek[1]], frame[:, cheek[0], cheek[1]])
    assert torch.equal(drawn[:, :, :10], frame[:, :, :10])
    assert torch.equal(undistort_image(frame, tracked.calibration), frame)


def test_head_angles_are_yaw_pitch_and_roll() -> None:
    facing = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    yaw, pitch, roll = 0.4, -0.3, 0.2

    def about(*vector: float) -> torch.Tensor:
        return rotation_matrix(torch.tensor(vector, dtype=torch.float64))

    turned = facing @ about(0, yaw, 0) @ about(pitch, 0, 0) @ about(0, 0, roll)
    torch.testing.assert_close(head_angles(turned), torch.tensor([yaw, pitch, roll], dtype=torch.float64))
    assert torch.isnan(head_angles(turned * torch.nan)).all()


def test_what_cannot_be_tracked_is_told_and_leaves_nothing(
    filmed: Filmed, dome_rig: BlendshapeRig, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    dome = tmp_path / "my dome's (2).glb"
    save_rig(dome_rig, dome)
    with pytest.raises(ValueRangeError, match=r"\(2\)\.glb: found no landmark vertices, expected the 68") as refused:
        track_video(filmed.video, dome, out, QUICK)
    advised = str(refused.value).split("torchface ")
    assert shlex.split(advised[1].split(" finds")[0]) == ["rig", str(dome), "--out", "NEW.glb"]
    assert shlex.split(advised[3].split(" carries")[0])[2:4] == ["--to", str(dome)]
    (tmp_path / "junk.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    with pytest.raises(FileFormatError, match=r"junk.mp4"):
        track_video(tmp_path / "junk.mp4", filmed.rig, out, QUICK)
    noise = (255 * torch.rand(6, 96, 128, generator=torch.Generator().manual_seed(0))).to(torch.uint8)
    write_video([noise], tmp_path / "noise.avi", 30.0)
    with pytest.raises(ValueRangeError, match=r"noise.avi: found no face in any of its 6 frames"):
        track_video(tmp_path / "noise.avi", filmed.rig, out, QUICK)
    (tmp_path / "camera.toml").write_text(
        'format = "torchface.camera/1"\nwidth = 300\nheight = 100\nfocal = [300, 300]\ncenter = [150, 50]\n'
    )
    with pytest.raises(ValueRangeError, match=r"camera.toml.*made for 300 x 100 pixels"):
        track_video(filmed.video, filmed.rig, out, TrackSettings(camera=tmp_path / "camera.toml"))
    assert not out.exists()


def test_a_take_shorter_than_the_window_is_told() -> None:
    class Short:
        window, fps = 8, 60.0

    take = VideoFile(Path("take.mp4"), 60.0, 160, 120, 9)
    models = TrackModels(None, dynamics=Short())
    inputs = TrackInputs(QUICK, take, performer(texture=False), assumed_calibration(160, 120), models)
    inputs.check_length(9)
    with pytest.raises(ValueRangeError, match=r"take.mp4: found 8 frames, expected more than the 8"):
        inputs.check_length(8)


def test_of_several_faces_the_one_asked_for_is_followed(filmed: Filmed, tmp_path: Path) -> None:
    frame = next(open_video(filmed.video).color_frames()).float()[None]
    small = torch.nn.functional.interpolate(frame, scale_factor=0.75, mode="bilinear", antialias=True)
    wide = torch.full((2, 3, 120, 300), 110.0)
    wide[..., :160] = frame
    wide[..., 15:105, 170:290] = small
    write_video([wide.round().to(torch.uint8)], tmp_path / "two.avi", 30.0)
    tracked = track_video(tmp_path / "two.avi", filmed.rig, tmp_path / "out", TrackSettings(face=1, overlay="none"))
    assert float(tracked.reading.landmarks[..., 0].min()) > 170
    assert tracked.faces == 2
    told = " ".join(tracked.lines())
    assert "2 faces in the first frame" in told
    assert "camera: none given; assumed a field of view of 60 degrees" in told


def test_a_camera_that_is_given_without_its_error_is_named(done: Done) -> None:
    inputs = done.tracked.inputs
    given = replace(inputs, calibration=replace(inputs.calibration, error=None))
    lines = " ".join(replace(done.tracked, inputs=given).lines())
    assert "camera: from camera.toml, of unknown error" in lines
    assert "none given" not in lines
    given = replace(inputs, calibration=replace(inputs.calibration, error=1.5, guessed=True))
    (line,) = (line for line in replace(done.tracked, inputs=given).lines() if line.startswith("camera: "))
    assert line == "camera: from camera.toml, its focal length a guess by a face, 1.50 px off when it was made"


def test_the_verdict_comes_first(done: Done) -> None:
    tracked = done.tracked
    assert tracked.lines()[0] == tracked.verdict()
    assert tracked.verdict().startswith(f"result: good, the face was found in {FRAMES} of {FRAMES} frames (100.0 %)")
    eyes = (tracked.landmarks[:, 36] - tracked.landmarks[:, 45]).norm(dim=1).median()
    shifted = replace(tracked.solution, errors=tracked.solution.errors + 0.05 * eyes)
    assert replace(tracked, solution=shifted).verdict().startswith("result: poor, the solved face lies ")
    long = replace(tracked, seconds={"landmarks": 90.0, "weights": 40.0, "overlay": 370.0})
    assert long.lines()[-1] == "the overlay took 74% of it; --overlay none skips it"
    marks = tracked.reading.landmarks.clone()
    marks[: FRAMES // 2] = torch.nan
    half = replace(tracked, reading=replace(tracked.reading, landmarks=marks))
    assert half.verdict().startswith(f"result: partly usable, the face was found in {FRAMES - FRAMES // 2} of {FRAMES}")


def test_sound_that_the_overlay_lacks_is_said(done: Done, tmp_path: Path) -> None:
    tracked = done.tracked
    spoken = film(tmp_path / "spoken.mov", "pcm_s16le", EVEN)
    clip = replace(tracked.video, path=spoken)
    said = replace(tracked, inputs=replace(tracked.inputs, clip=clip)).lines()
    assert sum(line.startswith("sound: .mp4 cannot hold spoken.mov's (pcm_s16le)") for line in said) == 1
    assert not any(line.startswith("sound:") for line in tracked.lines())


def test_offsets_of_another_person_are_said(done: Done, filmed: Filmed, tmp_path: Path) -> None:
    inputs, own = done.tracked.inputs, done.tracked.offsets
    assert (own.video, own.source) == (inputs.reading_key, "film.avi")
    generator = torch.Generator().manual_seed(0)
    other = replace(own, millimetres=own.millimetres + 2 * torch.randn(68, 3, generator=generator), video="another")
    other.save(tmp_path / "other.json")
    replace(other, millimetres=own.millimetres).save(tmp_path / "same.json")
    out = tmp_path / "out"
    shutil.copytree(done.out, out)
    settings = TrackSettings(camera=filmed.camera, overlay="none")
    with pytest.warns(UserWarning, match=r"other.json: the offsets of film.avi lie 3\.\d mm from those .* correlate"):
        tracked = track_video(filmed.video, filmed.rig, out, replace(settings, offsets=tmp_path / "other.json"))
    torch.testing.assert_close(tracked.offsets.millimetres, other.rounded().millimetres)  # as the user has it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        track_video(filmed.video, filmed.rig, out, replace(settings, offsets=tmp_path / "same.json"))
    assert known_offsets(inputs, done.out) is not None
    assert known_offsets(inputs, out) is None  # it holds those of another video now


def test_after_a_face_its_expression_stays_and_goes_to_rest_as_the_report_says(filmed: Filmed, tmp_path: Path) -> None:
    frames = torch.stack(list(open_video(filmed.video).color_frames()))
    write_video([frames, torch.full((45, *frames.shape[1:]), 90, dtype=torch.uint8)], tmp_path / "gone.avi", 30.0)
    tracked = track_video(tmp_path / "gone.avi", filmed.rig, tmp_path / "out", QUICK)
    said = "the expression stays for a third of a second and is at rest a second later"
    assert any(line.startswith("45 frames without a face") and said in line for line in tracked.lines())
    jaw = tracked.solution.weights[:, filmed.actor.names.index("jawOpen")]
    assert jaw[FRAMES - 1] > 0.5
    assert (jaw[FRAMES : FRAMES + 9] > 0.9 * jaw[FRAMES - 1]).all()
    assert jaw[FRAMES + 40] < 0.05 * jaw[FRAMES - 1]
    rows = [line.split(",") for line in (tmp_path / "out" / "landmarks.csv").read_text().splitlines()]
    lost = [int(row[0]) for row in rows[1:] if row[rows[0].index("success")] == "0"]
    assert lost == list(range(FRAMES + 1, FRAMES + 46))  # from 1


def test_a_cut_to_another_face_is_said_and_not_solved(filmed: Filmed, tmp_path: Path) -> None:
    """The other one has a longer face of another colour, under another light."""
    frames = torch.stack(list(open_video(filmed.video).color_frames()))
    longer = torch.nn.functional.interpolate(frames.float(), scale_factor=(1.1, 1.0), mode="bilinear", antialias=True)
    light = torch.tensor([0.7, 0.8, 1.0])[:, None, None] * torch.linspace(1, 0.35, frames.shape[3])
    other = (longer[:, :, 6 : 6 + frames.shape[2]] * light).round().to(torch.uint8)
    write_video([frames, other], tmp_path / "cut.avi", 30.0)
    tracked = track_video(tmp_path / "cut.avi", filmed.rig, tmp_path / "out", QUICK)
    assert [(span.first, span.last) for span in tracked.others] == [(FRAMES, 2 * FRAMES - 1)]
    assert f"frames {FRAMES} to {2 * FRAMES - 1} show another face" in "\n".join(tracked.lines())
    assert (FRAMES, 2 * FRAMES - 1, "another face") in tracked.suspect_spans()
    found = f"the face was found in {FRAMES} of {2 * FRAMES} frames (50.0 %), another face in {FRAMES}"
    assert tracked.verdict().startswith(f"result: partly usable, {found}")
    confidence = load_take(tmp_path / "out" / "confidence.csv").weights
    assert confidence.values[:FRAMES].mean() > 0.5
    assert (confidence.values[FRAMES:] == 0).all()
    insisted = track_video(tmp_path / "cut.avi", filmed.rig, tmp_path / "out", replace(QUICK, one_person=True))
    assert not insisted.others
    assert insisted.reused == 2 * FRAMES
    assert insisted.solution.confidence[FRAMES:].mean() > 0.5


def test_the_command_says_what_is_missing(filmed: Filmed, messages_of: Callable[..., str]) -> None:
    for words, told in (
        (("--rig", filmed.rig), "found no VIDEO, expected one"),
        ((filmed.video, "--rig", filmed.rig), "no folder for the results"),
    ):
        assert told in messages_of("track", *map(str, words), status=2)


@pytest.mark.real
def test_a_real_face_is_tracked_in_every_frame(data: Path, filmed: Filmed, tmp_path: Path) -> None:
    tracked = track_video(data / "video" / "single_face.mp4", filmed.rig, tmp_path, QUICK)
    assert tracked.seen.all()
    assert tracked.jitter < 1.0
    assert float((tracked.solution.weights >= 1 - 1e-3).float().mean()) < 0.2
    assert load_rig(tmp_path / "animation.glb").names == filmed.actor.names
